//! `fastlgs-bench`: measures speed, accuracy, stability and size of FastLGS.
//!
//! Each bench writes its files into a folder and returns its figures as JSON.

mod all;
mod autoencoder;
mod baseline;
mod clip;
mod command;
mod disturb;
mod labelled;
mod names;
mod plot;
mod speed;
mod table;
mod trial;

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
    selected: Bench,
    #[command(flatten)]
    common: ui::Common,
}

#[derive(clap::Subcommand)]
enum Bench {
    /// Time every pass, rendering and training.
    Speed(speed::Args),
    /// Evaluate another kind of language field on the same Gaussians and masks.
    Baseline(baseline::Args),
    /// Measure accuracy against time, stability and size, and make all pages of the results.
    All(all::Args),
    /// Evaluate text queries with a calibration from other scenes, and from all scenes.
    Names(names::Args),
    /// Evaluate text queries on real CLIP embeddings of rooms, and measure their calibration.
    Clip(clip::Args),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    fastlgs_cli::init_process(&cli.common);
    let console = Console::new(&cli.common);
    let figures = bench(&cli.selected, &cli.common.run(&console));
    fastlgs_cli::exit_code(figures.and_then(|figures| report::write_fields(&cli.common, &figures)))
}

/// Runs a bench and returns its figures.
fn bench(what: &Bench, run: &Run) -> Result<Value> {
    match what {
        Bench::Speed(args) => speed::run(args, run),
        Bench::Baseline(args) => baseline::run(args, run),
        Bench::All(args) => all::run(args, run),
        Bench::Names(args) => names::run(args, run),
        Bench::Clip(args) => Ok(serde_json::to_value(clip::run(args)?)?),
    }
}
