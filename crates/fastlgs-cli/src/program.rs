//! The command line as clap sees it, and which options the help shows.

use crate::Cli;
use clap::{Arg, Command, CommandFactory};

/// Options that the help of a command shows, besides the global ones. All others work as well; they
/// are in `--config` files and in `docs/reference/commands.md`.
const VISIBLE_OPTIONS: [(&str, &[&str]); 6] = [
    (
        "make",
        &[
            "output",
            "max_side",
            "holdout",
            "poses",
            "segmenter",
            "encoder",
            "effort",
        ],
    ),
    (
        "preprocess",
        &[
            "output",
            "max_side",
            "holdout",
            "poses",
            "segmenter",
            "encoder",
            "levels",
        ],
    ),
    (
        "train",
        &[
            "preset",
            "iterations",
            "budget",
            "init",
            "mapping",
            "resume",
            "serve",
        ],
    ),
    (
        "query",
        &[
            "output",
            "view",
            "point",
            "object",
            "heatmap",
            "export",
            "scenes_below",
        ],
    ),
    (
        "render",
        &[
            "output",
            "view",
            "all_views",
            "camera",
            "path",
            "size",
            "what",
        ],
    ),
    (
        "eval",
        &[
            "labels",
            "false_alarms",
            "absent",
            "clip_text",
            "depth",
            "depth_unit",
        ],
    ),
];

/// Returns the command line, with rarely used options hidden in the help.
pub fn command() -> Command {
    let mut program = Cli::command();
    let names: Vec<String> = program
        .get_subcommands()
        .map(|command| command.get_name().to_owned())
        .collect();
    // `mut_subcommand` moves a command to the end of the list. All commands are changed, so that
    // their order stays.
    for name in names {
        let shown = VISIBLE_OPTIONS
            .iter()
            .find(|(command, _)| **command == name)
            .map(|(_, ids)| ids);
        let is_hidden = |arg: &Arg| {
            let id = arg.get_id().as_str();
            !arg.is_positional() && shown.is_some_and(|ids| !ids.contains(&id))
        };
        program = program.mut_subcommand(&name, |command| {
            command.mut_args(|arg| if is_hidden(&arg) { arg.hide(true) } else { arg })
        });
    }
    program.mut_arg("seed", |arg| arg.hide(true))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_command_shows_more_than_twelve_options() {
        let mut program = command();
        program.build();
        for command in program.get_subcommands() {
            let shown = |arg: &&Arg| {
                let id = arg.get_id().as_str();
                arg.get_long().is_some() && !arg.is_hide_set() && !["help", "version"].contains(&id)
            };
            let names: Vec<&str> = command
                .get_arguments()
                .filter(shown)
                .filter_map(|arg| arg.get_long())
                .collect();
            assert!(
                names.len() <= 12,
                "fastlgs {}: {names:?}",
                command.get_name()
            );
        }
        for (name, shown) in VISIBLE_OPTIONS {
            let command = program.find_subcommand(name).expect("a command");
            for id in shown {
                assert!(
                    command.get_arguments().any(|arg| arg.get_id() == id),
                    "fastlgs {name} has no option {id}"
                );
            }
        }
    }
}
