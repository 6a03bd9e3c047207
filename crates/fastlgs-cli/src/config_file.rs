//! `--config FILE`: options of a command from a TOML file, and `--print-config`, which writes one.
//!
//! A key is the long name of an option, with `_` or `-`; tables only group keys. An option on the
//! command line overrides the file.

use anyhow::{Context, Result, bail};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use std::ffi::{OsStr, OsString};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Options that this module handles itself. A file cannot set them.
pub const CONFIG_OPTIONS: [&str; 2] = ["config", "print_config"];
/// Options of a single call, which a printed file leaves out.
const NOT_PRINTED: [&str; 5] = ["help", "version", "json", "verbose", "quiet"];

/// Inserts the options of `--config FILE` into `arguments`, before those of the user.
///
/// # Errors
/// A file that cannot be read, is no TOML, or sets an option that the command does not have.
pub fn expand(arguments: Vec<OsString>, program: &Command) -> Result<Vec<OsString>> {
    let names_command =
        |word: &OsString| word.to_str().and_then(|name| program.find_subcommand(name));
    let Some((command_index, command)) = arguments
        .iter()
        .enumerate()
        .skip(1)
        .find_map(|(k, word)| Some((k, names_command(word)?)))
    else {
        return Ok(arguments);
    };
    let Some(path) = path_of(&arguments) else {
        return Ok(arguments);
    };
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("{}: the configuration cannot be read", path.display()))?;
    let table: Table = text
        .parse()
        .with_context(|| format!("{}: it is not TOML", path.display()))?;
    let mut options = Vec::new();
    collect(&table, command, &arguments, &path, &mut options)?;
    let (before, after) = arguments.split_at(command_index + 1);
    Ok([before, &options, after].concat())
}

/// The path that `--config` names.
fn path_of(arguments: &[OsString]) -> Option<PathBuf> {
    let words = || arguments.iter().take_while(|word| *word != "--");
    let joined =
        words().find_map(|word| word.to_str()?.strip_prefix("--config=").map(PathBuf::from));
    let apart = || {
        words()
            .position(|word| word == "--config")
            .and_then(|k| arguments.get(k + 1))
            .map(PathBuf::from)
    };
    joined.or_else(apart)
}

/// Adds the options of `table` and its subtables to `out`, without those that `arguments` set.
/// `path` is named in errors.
fn collect(
    table: &Table,
    command: &Command,
    arguments: &[OsString],
    path: &Path,
    out: &mut Vec<OsString>,
) -> Result<()> {
    for (key, value) in table {
        if let Value::Table(group) = value {
            collect(group, command, arguments, path, out)?;
            continue;
        }
        let id = key.replace('-', "_");
        let option = command.get_arguments().find(|arg| {
            arg.get_long()
                .is_some_and(|long| long.replace('-', "_") == id)
        });
        let Some(option) = option.filter(|_| !CONFIG_OPTIONS.contains(&id.as_str())) else {
            let name = command.get_name();
            bail!(
                "{}: '{key}' is not an option of fastlgs {name}; 'fastlgs {name} --print-config' lists them",
                path.display()
            );
        };
        if !is_given(option, arguments) {
            out.extend(to_arguments(option, key, value, path)?);
        }
    }
    Ok(())
}

/// Whether the user set the option on the command line.
fn is_given(option: &Arg, arguments: &[OsString]) -> bool {
    let longs = option.get_long_and_visible_aliases().unwrap_or_default();
    let is_long = |word: &str| {
        let name = word
            .strip_prefix("--")
            .map(|rest| rest.split('=').next().unwrap_or(rest));
        name.is_some_and(|name| longs.contains(&name))
    };
    let is_short = |word: &str| {
        !word.starts_with("--")
            && option
                .get_short()
                .is_some_and(|short| word.starts_with(&format!("-{short}")))
    };
    arguments
        .iter()
        .take_while(|word| *word != "--")
        .filter_map(|word| word.to_str())
        .any(|word| is_long(word) || is_short(word))
}

/// The option as words of a command line.
fn to_arguments(option: &Arg, key: &str, value: &Value, path: &Path) -> Result<Vec<OsString>> {
    let long = option.get_long().unwrap_or_default();
    let takes_value = matches!(option.get_action(), ArgAction::Set | ArgAction::Append);
    let plain = |value: &Value| -> Result<String> {
        Ok(match value {
            Value::String(text) => text.clone(),
            Value::Integer(number) => number.to_string(),
            Value::Float(number) => number.to_string(),
            Value::Boolean(on) if takes_value => on.to_string(),
            other => bail!("{}: '{key}' cannot be {other}", path.display()),
        })
    };
    let word = |value: String| OsString::from(format!("--{long}={value}"));
    match value {
        Value::Boolean(on) if !takes_value => Ok(if *on {
            vec![format!("--{long}").into()]
        } else {
            Vec::new()
        }),
        _ if !takes_value => bail!("{}: '{key}' is either true or false", path.display()),
        Value::Array(items) => {
            let items = items.iter().map(plain).collect::<Result<Vec<_>>>()?;
            Ok(match option.get_value_delimiter() {
                Some(delimiter) => vec![word(items.join(&delimiter.to_string()))],
                None => items.into_iter().map(word).collect(),
            })
        }
        single => Ok(vec![word(plain(single)?)]),
    }
}

/// Returns a configuration file with every option of `command`. Options that have their default
/// value, or none, are comments.
pub fn print(command: &Command, matches: &ArgMatches) -> String {
    let mut out = format!("# Options of fastlgs {}.\n", command.get_name());
    for option in command.get_arguments() {
        let (Some(long), id) = (option.get_long(), option.get_id().as_str()) else {
            continue;
        };
        if CONFIG_OPTIONS.contains(&id) || NOT_PRINTED.contains(&id) {
            continue;
        }
        if let Some(help) = option.get_help() {
            let _ = write!(out, "\n# {}\n", help.to_string().replace('\n', " "));
        }
        let is_set = matches
            .value_source(id)
            .is_some_and(|source| source != ValueSource::DefaultValue);
        let mark = if is_set { "" } else { "# " };
        let values = values(matches, id);
        let value = match option.get_action() {
            ArgAction::SetTrue => matches.get_flag(id).to_string(),
            ArgAction::Append => format!("[{}]", values.join(", ")),
            _ => values.into_iter().next().unwrap_or_default(),
        };
        let _ = writeln!(
            out,
            "{}",
            format!("{mark}{} = {value}", long.replace('-', "_")).trim_end()
        );
    }
    out
}

/// The values of an option as TOML.
fn values(matches: &ArgMatches, id: &str) -> Vec<String> {
    let toml = |raw: &OsStr| {
        let text = raw.to_string_lossy();
        let is_number = text.parse::<i64>().is_ok()
            || (text.parse::<f64>().is_ok_and(f64::is_finite) && text.contains('.'));
        if is_number {
            text.into_owned()
        } else {
            Value::String(text.into_owned()).to_string()
        }
    };
    matches
        .get_raw(id)
        .map(|raw| raw.map(toml).collect())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn program() -> Command {
        let mut program = crate::program::command();
        program.build();
        program
    }

    /// Expands `words` with a configuration file of this text.
    fn expanded(text: &str, words: &[&str]) -> Result<Vec<String>> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join("options.toml");
        std::fs::write(&path, text)?;
        let mut arguments: Vec<OsString> = ["fastlgs"]
            .iter()
            .chain(words)
            .map(OsString::from)
            .collect();
        arguments.extend(["--config".into(), path.clone().into()]);
        let all = expand(arguments, &program())?;
        let own = |word: &OsString| *word != *path && *word != *"--config";
        Ok(all
            .iter()
            .filter(|word| own(word))
            .map(|word| word.to_string_lossy().into_owned())
            .collect())
    }

    #[test]
    fn the_command_line_overrides_the_file() {
        let text = "iterations = 12\nantialias = true\nfreeze = false\n[mapping_options]\ncues = [\"color\", \"keypoints\"]\n";
        let words = expanded(text, &["-v", "train", "SCENE"]).unwrap();
        let set = ["--iterations=12", "--antialias", "--cues=color,keypoints"];
        assert_eq!(words[..3], ["fastlgs", "-v", "train"]);
        assert!(
            set.iter().all(|word| words.iter().any(|w| w == word)) && words.len() == 7,
            "{words:?}"
        );
        let words = expanded(text, &["train", "SCENE", "--iterations", "5"]).unwrap();
        assert!(!words.contains(&"--iterations=12".to_owned()), "{words:?}");
        let words = expanded("output = \"b\"", &["preprocess", "PHOTOS", "-o", "a"]).unwrap();
        assert!(!words.contains(&"--output=b".to_owned()), "{words:?}");
    }

    #[test]
    fn a_wrong_file_is_refused_in_one_sentence() {
        for (text, expected) in [
            (
                "iteration = 12",
                "'iteration' is not an option of fastlgs train",
            ),
            ("config = \"x\"", "'config' is not an option"),
            ("antialias = 3", "'antialias' is either true or false"),
            ("= 3", "it is not TOML"),
        ] {
            let message = expanded(text, &["train", "SCENE"]).unwrap_err().to_string();
            assert!(
                message.contains(expected) && message.contains("options.toml"),
                "{message}"
            );
        }
    }

    #[test]
    fn a_printed_file_gives_the_same_options() {
        let words = [
            "fastlgs",
            "train",
            "SCENE",
            "--iterations",
            "12",
            "--background",
            "0,0.5,1",
            "--cues",
            "color",
            "--freeze",
        ];
        let printed = |words: &[String]| {
            let matches = program().ignore_errors(true).get_matches_from(words);
            let (name, matches) = matches.subcommand().expect("a command");
            print(program().find_subcommand(name).expect("a command"), matches)
        };
        let first = printed(&words.map(str::to_owned));
        assert!(
            first.contains("\niterations = 12\n") && first.contains("\n# preset = \"standard\"\n"),
            "{first}"
        );
        assert_eq!(
            printed(&expanded(&first, &["train", "SCENE"]).unwrap()),
            first
        );
    }
}
