//! `docs/reference/commands.md`, generated from the command line.

use crate::{config_file, program};
use clap::{Arg, ArgAction, Command};
use std::fmt::Write as _;
use std::path::Path;

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
    arg.get_id() == "seed" || config_file::CONFIG_OPTIONS.contains(&arg.get_id().as_str())
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

#[test]
fn the_reference_page_is_current() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/commands.md");
    if std::env::var_os("FASTLGS_UPDATE_DOCS").is_some() {
        std::fs::write(&path, reference()).expect("a writable page");
    }
    let page = std::fs::read_to_string(&path).expect("the page");
    assert!(
        page == reference(),
        "run FASTLGS_UPDATE_DOCS=1 cargo test -p fastlgs-cli reference, and look at the page"
    );
}
