//! `fastlgs-bench`: speed, accuracy, stability and size of the program.
//!
//! Each bench writes its files into a folder and returns its figures.

mod autoencoder;
mod baseline;
mod chart;
mod command;
mod disturb;
mod labelled;
mod names;
mod paper;
mod plot;
mod size;
mod speed;
mod stability;
mod table;
mod trial;
mod ways;

use anyhow::Result;
use clap::Parser;
use fastlgs::Run;
use fastlgs_cli::{console::Console, report, ui};
use serde_json::Value;
use std::process::ExitCode;

/// Measures FastLGS.
#[derive(Parser)]
#[command(name = "fastlgs-bench", version, after_help = "Example: fastlgs-bench speed scenes/fox --gaussians 50000 --size 270x480")]
struct Cli {
    #[command(subcommand)]
    what: What,
    #[command(flatten)]
    common: ui::Common,
}

#[derive(clap::Subcommand)]
enum What {
    /// Milliseconds of every pass, frames and training iterations a second.
    Speed(speed::Args),
    /// Other ways to a field of language on the same Gaussians and masks, to compare with.
    Baseline(baseline::Args),
    /// Accuracy against time, for the ways from masks to a field that answers.
    Chart(chart::Args),
    /// What accuracy and colour lose as a model gets smaller, and where `--budget auto` ends.
    Size(size::Args),
    /// What remains of accuracy when the input is disturbed, and on scenes that methods fail at.
    Stability(stability::Args),
    /// The paper's ablations, with its own figures beside ours.
    Paper(paper::Args),
    /// What texts give on scenes that nothing was chosen on, and how much more where they were seen.
    Names(names::Args),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    fastlgs_cli::start(&cli.common);
    let console = Console::new(&cli.common);
    let figures = bench(&cli.what, &cli.common.run(&console));
    fastlgs_cli::end(figures.and_then(|figures| report::give(&cli.common, &figures)))
}

/// Runs a bench and returns its figures.
fn bench(what: &What, run: &Run) -> Result<Value> {
    match what {
        What::Speed(args) => speed::run(args, run),
        What::Baseline(args) => baseline::run(args, run),
        What::Chart(args) => chart::run(args, run),
        What::Size(args) => size::run(args, run),
        What::Stability(args) => stability::run(args, run),
        What::Paper(args) => paper::run(args, run),
        What::Names(args) => names::run(args, run),
    }
}
