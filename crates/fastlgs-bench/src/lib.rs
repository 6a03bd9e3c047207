//! `fastlgs bench`: what the program costs and what it gives. Each bench writes its files into a folder and returns its figures.

mod autoencoder;
mod baseline;
mod chart;
mod command;
mod disturb;
mod growth;
mod labelled;
mod names;
mod paper;
mod plot;
mod report;
mod size;
mod speed;
mod stability;
mod table;
mod teach;
mod trial;
mod vision;
mod ways;

use anyhow::Result;
use fastlgs::Run;
use serde_json::Value;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench speed scenes/fox --gaussians 50000 --size 270x480")]
/// Which bench, with its options.
pub struct Args {
    #[command(subcommand)]
    what: What,
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
    /// Seconds and memory of global mapping as photos, masks and Gaussians grow.
    Growth(growth::Args),
    /// What texts give on scenes that nothing was chosen on, and how much more where they were seen.
    Names(names::Args),
    /// Whether what is taught by a click in one view is found by its name in other views and scenes.
    Teach(teach::Args),
    /// The other benches' results and sample pictures in one HTML file.
    Report(report::Args),
    /// Masks and embeddings alone, on labelled photos.
    Vision(vision::Args),
}

/// Runs a bench; its figures.
///
/// # Errors
/// What a stage of the pipeline refuses, or a folder that cannot be written.
pub fn run(args: &Args, run: &Run) -> Result<Value> {
    match &args.what {
        What::Speed(args) => speed::run(args, run),
        What::Baseline(args) => baseline::run(args, run),
        What::Chart(args) => chart::run(args, run),
        What::Size(args) => size::run(args, run),
        What::Stability(args) => stability::run(args, run),
        What::Paper(args) => paper::run(args, run),
        What::Growth(args) => growth::run(args, run),
        What::Names(args) => names::run(args, run),
        What::Teach(args) => teach::run(args, run),
        What::Report(args) => report::run(args, run),
        What::Vision(args) => vision::run(args, run),
    }
}
