//! `fastlgs-bench`: measures speed, accuracy, stability and size of FastLGS.
//!
//! Each bench writes its files into a folder and returns its figures as JSON.

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

/// Measures speed, accuracy, stability and size of FastLGS.
#[derive(Parser)]
#[command(
    name = "fastlgs-bench",
    version,
    after_help = "Example: fastlgs-bench speed scenes/fox --gaussians 50000 --size 270x480"
)]
struct Cli {
    #[command(subcommand)]
    what: What,
    #[command(flatten)]
    common: ui::Common,
}

#[derive(clap::Subcommand)]
enum What {
    /// Time every pass, rendering and training.
    Speed(speed::Args),
    /// Evaluate another kind of language field on the same Gaussians and masks.
    Baseline(baseline::Args),
    /// Plot accuracy against time for several methods of making a language field.
    Chart(chart::Args),
    /// Measure accuracy and PSNR of smaller models, and check `--budget auto`.
    Size(size::Args),
    /// Measure how accuracy changes when the input is disturbed, and on difficult generated scenes.
    Stability(stability::Args),
    /// Repeat the paper's ablations and list the paper's figures for comparison.
    Paper(paper::Args),
    /// Evaluate text queries with a calibration from other scenes, and from all scenes.
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
