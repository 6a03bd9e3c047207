//! The `fastlgs` command line: arguments, messages, progress bars and exit codes around the pipeline.
//!
//! `fastlgs-bench` shares its options, progress bars and reports.

mod commands;
pub mod console;
mod outcome;
pub mod report;
pub mod ui;
mod words;

use clap::{CommandFactory, Parser, Subcommand};
pub use outcome::Outcome;
use std::process::ExitCode;

/// Posed photos in, a 3-D scene that answers text out.
#[derive(Parser)]
#[command(name = "fastlgs", version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: ui::Common,
}

#[derive(Subcommand)]
enum Command {
    /// Makes a scene that answers, from photos or a video: preprocess and train in one.
    #[command(after_help = "Example: fastlgs make photos/fox -o scenes/fox --max-side 480\n\n\
Called again, it keeps what is there, goes on where it was broken off, or makes anew what other photos or options ask for.")]
    Make(fastlgs::make::Config),
    /// Photos, with or without poses -> cameras, masks, key points and first points.
    #[command(after_help = "Example: fastlgs preprocess photos/fox -o scenes/fox --max-side 480")]
    Preprocess(fastlgs::preprocess::Config),
    /// Trains Gaussians and finds the objects among them.
    Train(commands::train::Args),
    /// Renders views: colour PNG, depth, feature and objects.
    #[command(after_help = "Example: fastlgs render scenes/fox --view 0027.jpg --what color,depth,feature,objects -o pictures")]
    Render(fastlgs::render::Config),
    /// Finds what a text, a picture or a point names: masks, heat maps, Gaussians.
    Query(commands::query::Args),
    /// Takes a thing out of a scene and fills its place.
    #[command(after_help = "Example: fastlgs remove scenes/room \"coffee mug\" -o scenes/tidy")]
    Remove(fastlgs::remove::Config),
    /// Teaches a name by showing a thing; every scene of the same encoder then answers to it.
    #[command(after_help = "Example: fastlgs teach \"my mug\" scenes/desk --view 0003.jpg --point 210,144")]
    Teach(fastlgs::teach::Lesson),
    /// Lists, forgets, exports or imports the names that were taught.
    Names(commands::names::Args),
    /// Shows a scene in the browser, with an HTTP interface.
    Serve(commands::serve::Args),
    /// Measures accuracy on held-out views against labels.
    #[command(after_help = "Example: fastlgs eval scenes/fox --labels photos/fox/labels --json -")]
    Eval(fastlgs::eval::Config),
    /// Names the program that measures: fastlgs-bench.
    #[command(hide = true)]
    Bench {
        /// Ignored.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Writes a trained scene as PLY, SPZ, SOG or glTF, as a small folder for queries, or as a page for any web server.
    #[command(
        after_help = "Examples: fastlgs export scenes/fox fox.spz\n          fastlgs export scenes/fox small/fox\n          fastlgs export scenes/fox cameras.json\n          fastlgs export scenes/fox page/fox --html"
    )]
    Export(commands::export::Args),
    /// Makes a scene with exact poses, depths and masks.
    #[command(after_help = "Example: fastlgs synth table -o photos/table --views 40 --size 320x240")]
    Synth(fastlgs::synth::Config),
    /// Lists or installs encoders.
    Models(commands::models::Args),
    /// Shows the machine's devices, or what is in a scene.
    Info(commands::info::Args),
    /// Prints a script that completes commands in a shell.
    Completions(commands::shell::Completions),
    /// Writes the manual pages.
    Man(commands::shell::Man),
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    start(&cli.common);
    end(run(cli.command, &cli.common))
}

/// Prepares the process: logging, and the environment of graphics drivers.
pub fn start(common: &ui::Common) {
    // SAFETY: nothing else runs yet; no other thread can read the environment.
    // Mesa's device chooser talks to a desktop session and complains on stderr where there is none.
    unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    ui::start_logging(common);
}

/// Turns the result of a command into an exit code; an error is printed in one sentence.
pub fn end(result: anyhow::Result<Outcome>) -> ExitCode {
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::NotFound) => ExitCode::from(3),
        Err(error) => {
            eprintln!("error: {}", fastlgs::one_sentence(error.as_ref()));
            ExitCode::from(1)
        }
    }
}

fn run(command: Command, common: &ui::Common) -> anyhow::Result<Outcome> {
    let console = console::Console::new(common);
    let run = &common.run(&console);
    match command {
        Command::Make(config) => commands::make::run(&config, common, run),
        Command::Preprocess(config) => report::tell(common, &fastlgs::preprocess(&config, run)?, words::preprocess),
        Command::Train(args) => commands::train::run(&args, common, &console),
        Command::Render(config) => report::tell(common, &fastlgs::render(&config, run)?, words::render),
        Command::Query(args) => commands::query::run(&args, common, run),
        Command::Remove(config) => report::tell(common, &fastlgs::remove(&config, run)?, words::remove),
        Command::Teach(lesson) => report::tell(common, &fastlgs::teach::teach(&lesson, run)?, words::teach),
        Command::Names(args) => commands::names::run(&args, common),
        Command::Serve(args) => commands::serve::run(&args, common),
        Command::Eval(config) => report::tell(common, &fastlgs::eval(&config, run)?, words::eval),
        Command::Bench { arguments } => {
            let arguments = arguments.join(" ");
            anyhow::bail!("benches are a program of their own: run 'fastlgs-bench {arguments}', or install it with 'cargo install --path crates/fastlgs-bench'")
        }
        Command::Export(args) => commands::export::run(&args, common, run),
        Command::Synth(config) => report::tell(common, &fastlgs::synth(&config, run)?, words::synth),
        Command::Models(args) => commands::models::run(&args, common, run),
        Command::Info(args) => commands::info::run(&args, common),
        Command::Completions(args) => commands::shell::completions(&args, Cli::command()),
        Command::Man(args) => commands::shell::man(&args, Cli::command()),
    }
}
