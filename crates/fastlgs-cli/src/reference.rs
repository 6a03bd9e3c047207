//! `docs/reference/commands.md`, `docs/reference/reports.md` and the option types of the Python
//! package, generated from the program.

use crate::{config_file, program};
use clap::{Arg, ArgAction, Command};
use std::any::TypeId;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Global options that the help shows.
const GLOBAL: [&str; 5] = ["verbose", "quiet", "json", "device", "config"];

/// Returns `docs/reference/commands.md`.
fn reference() -> String {
    let mut program = program::command();
    program.build();
    let mut out = String::from(
        "# Commands\n\nGenerated from the program; `fastlgs COMMAND --help` shows the common options.\n\
         Every option also works in a `--config` file, without the dashes and with `_` for `-`.\n\n",
    );
    out.push_str("## Options of every command\n\n");
    let global = |arg: &&Arg| GLOBAL.contains(&arg.get_id().as_str()) || is_hidden_global(arg);
    table(&mut out, program.get_arguments().filter(global));
    let visible = program
        .get_subcommands()
        .filter(|c| !c.is_hide_set() && c.get_name() != "help");
    for command in visible {
        section(
            &mut out,
            command,
            &format!("fastlgs {}", command.get_name()),
        );
        for nested in command.get_subcommands().filter(|c| c.get_name() != "help") {
            section(
                &mut out,
                nested,
                &format!("fastlgs {} {}", command.get_name(), nested.get_name()),
            );
        }
    }
    out
}

fn is_hidden_global(arg: &Arg) -> bool {
    ["seed", "onnx"].contains(&arg.get_id().as_str())
        || config_file::CONFIG_OPTIONS.contains(&arg.get_id().as_str())
}

fn section(out: &mut String, command: &Command, name: &str) {
    let about = command
        .get_about()
        .map(ToString::to_string)
        .unwrap_or_default();
    let _ = write!(out, "\n## {name}\n\n{about}\n\n");
    let own = |arg: &&Arg| {
        let id = arg.get_id().as_str();
        !GLOBAL.contains(&id) && !is_hidden_global(arg) && !["help", "version"].contains(&id)
    };
    let (rare, common): (Vec<&Arg>, Vec<&Arg>) = command
        .get_arguments()
        .filter(own)
        .partition(|arg| arg.is_hide_set());
    table(out, common.into_iter());
    if !rare.is_empty() {
        out.push_str("\nFurther options:\n\n");
        table(out, rare.into_iter());
    }
    if let Some(example) = command.get_after_help() {
        let lines: Vec<String> = example
            .to_string()
            .lines()
            .map(|line| line.trim().to_owned())
            .collect();
        let _ = write!(out, "\n{}\n", lines.join("\n"));
    }
}

fn table<'a>(out: &mut String, options: impl Iterator<Item = &'a Arg>) {
    let mut options = options.peekable();
    if options.peek().is_none() {
        return;
    }
    out.push_str("| option | meaning |\n|---|---|\n");
    for option in options {
        let help = option
            .get_help()
            .map(ToString::to_string)
            .unwrap_or_default();
        let help = help.replace('\n', " ").replace('|', "\\|");
        let defaults: Vec<String> = option
            .get_default_values()
            .iter()
            .map(|v| v.to_string_lossy().into_owned())
            .collect();
        let default = match option.get_action() {
            ArgAction::Set | ArgAction::Append if !defaults.is_empty() => {
                format!(" Default: {}.", defaults.join(","))
            }
            _ => String::new(),
        };
        let help = if help.ends_with('.') || help.is_empty() {
            help
        } else {
            format!("{help}.")
        };
        let _ = writeln!(out, "| `{}` | {help}{default} |", usage(option));
    }
}

/// The option as it is typed, with its possible values.
fn usage(option: &Arg) -> String {
    let values: Vec<String> = option
        .get_possible_values()
        .iter()
        .map(|value| value.get_name().to_owned())
        .collect();
    let takes_value = matches!(option.get_action(), ArgAction::Set | ArgAction::Append);
    let name = option
        .get_value_names()
        .and_then(|names| names.first())
        .map(ToString::to_string);
    let name = name
        .unwrap_or_else(|| option.get_id().as_str().to_uppercase())
        .replace('|', "\\|");
    let value = if values.is_empty() {
        name
    } else {
        values.join("\\|")
    };
    match (option.get_short(), option.get_long()) {
        (_, None) => value,
        (short, Some(long)) => {
            let short = short.map(|short| format!("-{short}, ")).unwrap_or_default();
            format!(
                "{short}--{long}{}",
                if takes_value {
                    format!(" {value}")
                } else {
                    String::new()
                }
            )
        }
    }
}

/// Python types of options whose values have a type of their own in Rust.
const OWN_TYPES: [(&str, &str); 2] = [
    ("background", "Dict[str, Any]"),
    ("budget", "Optional[int]"),
];

/// Returns `fastlgs/options.py`: a `TypedDict` of the options of each stage. A key is a field of
/// the stage's configuration; its type and help are those of the command line.
fn python_options() -> String {
    let mut out = String::from(
        "\"\"\"Options of the stages, generated from the command line: keyword arguments of the functions.\"\"\"\n\n\
         from os import PathLike\n\
         from typing import Any, Dict, List, Literal, Optional, Tuple, TypedDict, Union\n\n\
         Path = Union[str, \"PathLike[str]\"]\n",
    );
    let stages = [
        (
            "Preprocess",
            "preprocess",
            fields(&fastlgs::PreprocessConfig::default()),
        ),
        ("Train", "train", fields(&fastlgs::TrainConfig::default())),
        ("Synth", "synth", fields(&fastlgs::SynthConfig::default())),
        (
            "Remove",
            "remove",
            fields(&fastlgs::RemoveConfig::default()),
        ),
        ("Evaluate", "eval", fields(&fastlgs::EvalConfig::default())),
    ];
    let mut program = program::command();
    program.build();
    for (class, name, mut fields) in stages {
        let command = program.find_subcommand(name).expect("a command");
        // These are arguments of the Python functions.
        for argument in [
            "photos", "scene", "output", "kind", "text", "object", "labels",
        ] {
            fields.retain(|field| field != argument);
        }
        let _ = write!(
            out,
            "\n\nclass {class}Options(TypedDict, total=False):\n    \"\"\"Options of `fastlgs {name}`.\"\"\"\n"
        );
        for field in fields {
            let option = command
                .get_arguments()
                .find(|arg| {
                    arg.get_long()
                        .is_some_and(|long| long.replace('-', "_") == field)
                })
                .unwrap_or_else(|| panic!("fastlgs {name} has no option for the field {field}"));
            let help = option
                .get_help()
                .map(ToString::to_string)
                .unwrap_or_default();
            for line in wrapped(&help, 90) {
                let _ = write!(out, "\n    # {line}");
            }
            let _ = writeln!(out, "\n    {field}: {}", python_type(option));
        }
    }
    out
}

/// Returns the fields of a configuration, in the order of their names.
fn fields(config: &impl serde::Serialize) -> Vec<String> {
    let value = serde_json::to_value(config).expect("a configuration is JSON");
    value
        .as_object()
        .expect("a struct")
        .keys()
        .cloned()
        .collect()
}

/// Returns the Python type of an option's value.
fn python_type(option: &Arg) -> String {
    let one = single_type(option);
    match option.get_action() {
        ArgAction::Append => format!("List[{one}]"),
        _ => one,
    }
}

fn single_type(option: &Arg) -> String {
    if !matches!(option.get_action(), ArgAction::Set | ArgAction::Append) {
        return "bool".to_owned();
    }
    let values = option.get_possible_values();
    if !values.is_empty() {
        let names = values.iter().map(|v| format!("\"{}\"", v.get_name()));
        return format!("Literal[{}]", names.collect::<Vec<_>>().join(", "));
    }
    let kind = option.get_value_parser().type_id();
    let of_rust = [
        (TypeId::of::<u16>(), "int"),
        (TypeId::of::<u32>(), "int"),
        (TypeId::of::<u64>(), "int"),
        (TypeId::of::<usize>(), "int"),
        (TypeId::of::<f32>(), "float"),
        (TypeId::of::<f64>(), "float"),
        (TypeId::of::<PathBuf>(), "Path"),
        (TypeId::of::<String>(), "str"),
        (TypeId::of::<(u32, u32)>(), "Tuple[int, int]"),
    ];
    let of_rust = of_rust
        .iter()
        .find(|known| kind == known.0)
        .map(|known| known.1);
    let own = || {
        OWN_TYPES
            .iter()
            .find(|own| option.get_id() == own.0)
            .map(|own| own.1)
    };
    let name = of_rust.or_else(own);
    name.unwrap_or_else(|| panic!("{}: add its Python type", option.get_id()))
        .to_owned()
}

/// Commands and the structs of their reports.
const REPORTS: [(&str, &str); 10] = [
    ("make", "MakeReport"),
    ("preprocess", "PreprocessReport"),
    ("train", "TrainReport"),
    ("query", "AnswerReport"),
    ("objects", "ListReport"),
    ("eval", "EvalReport"),
    ("export", "SceneReport"),
    ("remove", "RemoveReport"),
    ("teach", "TeachReport"),
    ("synth", "SynthReport"),
];

/// Returns `docs/reference/reports.md`: the fields of the reports, from the source of the pipeline.
fn reports(sources: &Path) -> String {
    let mut out = String::from(
        "# Reports\n\nGenerated from the program: the fields that `--json` prints, and that the functions of Python return.\n",
    );
    let mut files = vec![sources.to_owned()];
    let mut text = String::new();
    while let Some(path) = files.pop() {
        if path.is_dir() {
            let entries = path.read_dir().expect("a folder");
            let mut entries: Vec<PathBuf> = entries.map(|e| e.expect("an entry").path()).collect();
            entries.sort();
            files.extend(entries);
        } else {
            text += &std::fs::read_to_string(&path).expect("a source file");
        }
    }
    for (command, report) in REPORTS {
        let _ = write!(
            out,
            "\n## fastlgs {command}\n\n| field | meaning |\n|---|---|\n"
        );
        let head = format!("pub struct {report} {{\n");
        let (_, body) = text.split_once(&head).unwrap_or_else(|| panic!("{head}"));
        let (body, _) = body.split_once("\n}\n").expect("its end");
        let mut meaning: Vec<&str> = Vec::new();
        for line in body.lines().map(str::trim) {
            if let Some(words) = line.strip_prefix("/// ") {
                meaning.push(words);
            } else if let Some((field, _)) =
                line.strip_prefix("pub ").and_then(|f| f.split_once(':'))
            {
                let _ = writeln!(
                    out,
                    "| `{field}` | {} |",
                    meaning.join(" ").replace('|', "\\|")
                );
                meaning.clear();
            }
        }
    }
    out
}

/// Breaks a text into lines of at most `width` characters.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines
            .last_mut()
            .filter(|line| line.len() + 1 + word.len() <= width)
        {
            Some(line) => {
                line.push(' ');
                line.push_str(word);
            }
            None => lines.push(word.to_owned()),
        }
    }
    lines
}

#[test]
fn generated_files_are_current() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let files = [
        ("docs/reference/commands.md", reference()),
        (
            "docs/reference/reports.md",
            reports(&root.join("crates/fastlgs/src")),
        ),
        (
            "crates/fastlgs-py/python/fastlgs/options.py",
            python_options(),
        ),
    ];
    for (file, text) in files {
        let path = root.join(file);
        if std::env::var_os("FASTLGS_UPDATE_DOCS").is_some() {
            std::fs::write(&path, &text).expect("a writable file");
        }
        let current = std::fs::read_to_string(&path).expect("the file");
        assert!(
            current == text,
            "{file}: run FASTLGS_UPDATE_DOCS=1 cargo test -p fastlgs-cli reference, and look at the file"
        );
    }
}
