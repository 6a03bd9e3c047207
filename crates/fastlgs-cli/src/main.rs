//! The `fastlgs` binary: wiring of the stages, progress, logging and exit codes.

mod again;
mod cache;
mod commands;
mod eyes;
mod report;
mod scene;
mod serve;
mod ui;

use clap::{CommandFactory, Parser, Subcommand};
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
    /// Photos (with poses) -> masks, embeddings, key points and the object grid.
    Preprocess(commands::preprocess::Args),
    /// Trains Gaussians: colour and semantic field together.
    Train(commands::train::Args),
    /// Makes scenes of several folders of photos.
    Batch(commands::batch::Args),
    /// Renders views: colour PNG, depth, feature and objects.
    Render(commands::render::Args),
    /// Finds what a text names: mask, heat map, JSON.
    Query(commands::query::Args),
    /// Shows a scene in the browser, with an HTTP interface.
    Serve(commands::serve::Args),
    /// Measures accuracy on held-out views against labels.
    Eval(commands::eval::Args),
    /// Measures speed.
    Bench(commands::bench::Args),
    /// Writes a trained scene as PLY or SPZ, or as a small folder for queries.
    Export(commands::export::Args),
    /// Makes a scene with exact poses, depths and masks.
    Synth(commands::synth::Args),
    /// Lists or installs encoders.
    Models(commands::models::Args),
    /// Shows the machine's devices, or what is in a scene.
    Info(commands::info::Args),
    /// Prints a script that completes commands in a shell.
    Completions(commands::shell::Completions),
    /// Writes the manual pages.
    Man(commands::shell::Man),
}

/// How a command ended when it did not fail.
pub enum Outcome {
    /// Done.
    Done,
    /// A query that nothing in the scene matches.
    NotFound,
}

fn main() -> ExitCode {
    // SAFETY: nothing else runs yet; no other thread can read the environment.
    // Mesa's device chooser talks to a desktop session and complains on stderr where there is none.
    unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    let cli = Cli::parse();
    ui::start_logging(&cli.common);
    let common = cli.common;
    let result = match cli.command {
        Command::Preprocess(args) => commands::preprocess::run(&args, &common),
        Command::Train(args) => commands::train::run(&args, &common),
        Command::Batch(args) => commands::batch::run(&args, &common),
        Command::Render(args) => commands::render::run(&args, &common),
        Command::Query(args) => commands::query::run(&args, &common),
        Command::Serve(args) => commands::serve::run(&args, &common),
        Command::Eval(args) => commands::eval::run(&args, &common),
        Command::Bench(args) => commands::bench::run(&args, &common),
        Command::Export(args) => commands::export::run(&args, &common),
        Command::Synth(args) => commands::synth::run(&args, &common),
        Command::Models(args) => commands::models::run(&args, &common),
        Command::Info(args) => commands::info::run(&args, &common),
        Command::Completions(args) => commands::shell::completions(&args, Cli::command()),
        Command::Man(args) => commands::shell::man(&args, Cli::command()),
    };
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::NotFound) => ExitCode::from(3),
        Err(error) => {
            eprintln!("error: {}", one_sentence(&error));
            ExitCode::from(1)
        }
    }
}

/// The chain of causes in one line; a cause that its parent already quotes is not repeated.
fn one_sentence(error: &anyhow::Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}
