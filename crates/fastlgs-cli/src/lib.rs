//! The `fastlgs` command line: arguments, messages, progress bars and exit codes for the pipeline.
//!
//! `fastlgs-bench` shares its options, progress bars and reports.

mod commands;
mod config_file;
pub mod console;
mod outcome;
mod program;
#[cfg(test)]
mod reference;
pub mod report;
pub mod ui;
mod words;

use anyhow::Context;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
pub use outcome::Outcome;
use std::ffi::OsString;
use std::process::ExitCode;

/// Builds 3-D scenes from photos and finds objects in them by text.
#[derive(Parser)]
#[command(name = "fastlgs", version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: ui::Common,
    /// Read options from a TOML file; `--print-config` prints one with all options of the command.
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<std::path::PathBuf>,
    /// Print a configuration file with all options of the command and their values.
    #[arg(long, global = true, hide = true)]
    print_config: bool,
}

#[derive(Subcommand)]
enum Command {
    /// Make a queryable scene from photos or a video: preprocess and train in one step.
    #[command(
        after_help = "Example: fastlgs make photos/fox -o scenes/fox --max-side 480\n\n\
Run again, it keeps a finished scene and continues an interrupted run. It rebuilds the scene if photos or options have changed."
    )]
    Make(fastlgs::make::MakeConfig),
    /// Prepare a scene from photos, with or without poses: cameras, masks, key points and initial
    /// points.
    #[command(after_help = "Example: fastlgs preprocess photos/fox -o scenes/fox --max-side 480")]
    Preprocess(fastlgs::preprocess::PreprocessConfig),
    /// Train Gaussians, then find the objects among them.
    Train(commands::train::Args),
    /// Render views: colour, depth, feature and object images.
    #[command(
        after_help = "Example: fastlgs render scenes/fox --view 0027.jpg --what color,depth,feature,objects -o pictures"
    )]
    Render(fastlgs::render::RenderConfig),
    /// Find the objects that a text, a picture or a pixel names; write masks, heat maps and
    /// Gaussians.
    Query(commands::query::Args),
    /// List the objects of a scene: ids, likeliest names, views and sizes.
    #[command(after_help = "Example: fastlgs objects scenes/fox -o lists")]
    Objects(fastlgs::listing::ListConfig),
    /// Remove an object from a scene and fill the area behind it.
    #[command(after_help = "Example: fastlgs remove scenes/room \"coffee mug\" -o scenes/tidy")]
    Remove(fastlgs::remove::RemoveConfig),
    /// Teach a name by an example; all scenes with the same encoder then know it.
    #[command(
        after_help = "Example: fastlgs teach \"my mug\" scenes/desk --view 0003.jpg --point 210,144"
    )]
    Teach(fastlgs::teach::TeachConfig),
    /// List, remove, export or import taught names.
    Names(commands::names::Args),
    /// Show a scene in the browser, with an HTTP interface.
    Serve(commands::serve::Args),
    /// Measure accuracy on held-out views against labels.
    #[command(after_help = "Example: fastlgs eval scenes/fox --labels photos/fox/labels --json -")]
    Eval(fastlgs::eval::EvalConfig),
    /// Print how to run fastlgs-bench, which has the benchmarks.
    #[command(hide = true)]
    Bench {
        /// Ignored.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Write a trained scene as PLY, SPZ, SOG or glTF, as a small folder for queries, or as a web
    /// page.
    #[command(
        after_help = "Examples: fastlgs export scenes/fox fox.spz\n          fastlgs export scenes/fox small/fox\n          fastlgs export scenes/fox cameras.json\n          fastlgs export scenes/fox page/fox --html"
    )]
    Export(commands::export::Args),
    /// Generate photos of a synthetic scene with exact poses, depths and masks.
    #[command(
        after_help = "Example: fastlgs synth table -o photos/table --views 40 --size 320x240"
    )]
    Synth(fastlgs::synth::SynthConfig),
    /// List, install, download or calibrate encoders and segmenters.
    Models(commands::models::Args),
    /// Show the devices of this machine, or the contents of a scene.
    Info(commands::info::Args),
    /// Print a shell completion script.
    Completions(commands::shell::Completions),
    /// Write the manual pages.
    Man(commands::shell::Man),
}

/// Runs the command line with the arguments of this process.
pub fn main() -> ExitCode {
    let arguments = std::env::args_os().collect();
    let mut program = program::command();
    program.build();
    let arguments = match config_file::expand(arguments, &program) {
        Ok(arguments) => arguments,
        Err(error) => return exit_code(Err(error)),
    };
    if arguments.iter().any(|word| word == "--print-config") {
        return exit_code(print_config(program, arguments));
    }
    let matches = program.get_matches_from(arguments);
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    init_process(&cli.common);
    exit_code(run(cli.command, &cli.common))
}

/// Prints a configuration file of the command that `arguments` name.
fn print_config(program: clap::Command, arguments: Vec<OsString>) -> anyhow::Result<Outcome> {
    let matches = program
        .clone()
        .ignore_errors(true)
        .get_matches_from(arguments);
    let Some((name, matches)) = matches.subcommand() else {
        anyhow::bail!("name a command: fastlgs COMMAND --print-config");
    };
    let command = program.find_subcommand(name).context("a command")?;
    ui::write_line(format_args!(
        "{}",
        config_file::print(command, matches).trim_end()
    ))?;
    Ok(Outcome::Done)
}

/// Starts logging, chooses the hardware for models, and sets the environment variables of graphics
/// drivers.
pub fn init_process(common: &ui::Common) {
    // SAFETY: no other thread runs yet, so none can read the environment.
    // Mesa's device selection layer contacts the desktop session and prints errors without one.
    unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    ui::start_logging(common);
    common.onnx.choose();
}

/// Converts the result of a command to an exit code. Prints an error as one sentence.
pub fn exit_code(result: anyhow::Result<Outcome>) -> ExitCode {
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::NotFound) => ExitCode::from(3),
        Err(error) => {
            eprintln!("error: {}", sentence(&error));
            ExitCode::from(1)
        }
    }
}

/// Returns an error as one sentence. Fields of configurations get the names of their flags.
fn sentence(error: &anyhow::Error) -> String {
    let option = error.chain().find_map(|cause| match cause.downcast_ref() {
        Some(fastlgs::Error::Option { option, reason }) => Some((option, reason)),
        _ => None,
    });
    match option {
        Some((option, reason)) => format!("--{}: {reason}", option.replace('_', "-")),
        None => fastlgs::one_sentence(error.as_ref()),
    }
}

fn run(command: Command, common: &ui::Common) -> anyhow::Result<Outcome> {
    let console = console::Console::new(common);
    let run = &common.run(&console);
    match command {
        Command::Make(config) => commands::make::run(&config, common, run),
        Command::Preprocess(config) => report::write_summary(
            common,
            &fastlgs::preprocess(&config, run)?,
            words::preprocess,
        ),
        Command::Train(args) => commands::train::run(&args, common, &console),
        Command::Render(config) => {
            report::write_summary(common, &fastlgs::render(&config, run)?, words::render)
        }
        Command::Query(args) => commands::query::run(&args, common, run),
        Command::Objects(config) => {
            report::write_summary(common, &fastlgs::list(&config, run)?, words::objects)
        }
        Command::Remove(config) => {
            report::write_summary(common, &fastlgs::remove(&config, run)?, words::remove)
        }
        Command::Teach(lesson) => {
            report::write_summary(common, &fastlgs::teach::teach(&lesson, run)?, words::teach)
        }
        Command::Names(args) => commands::names::run(&args, common),
        Command::Serve(args) => commands::serve::run(&args, common),
        Command::Eval(config) => {
            report::write_summary(common, &fastlgs::eval(&config, run)?, words::eval)
        }
        Command::Bench { arguments } => {
            let arguments = arguments.join(" ");
            anyhow::bail!(
                "benchmarks are in a separate program: run 'fastlgs-bench {arguments}', or install it with 'cargo install --path crates/fastlgs-bench'"
            )
        }
        Command::Export(args) => commands::export::run(&args, common, run),
        Command::Synth(config) => {
            report::write_summary(common, &fastlgs::synth(&config, run)?, words::synth)
        }
        Command::Models(args) => commands::models::run(&args, common, run),
        Command::Info(args) => commands::info::run(&args, common),
        Command::Completions(args) => commands::shell::completions(&args, Cli::command()),
        Command::Man(args) => commands::shell::man(&args, Cli::command()),
    }
}
