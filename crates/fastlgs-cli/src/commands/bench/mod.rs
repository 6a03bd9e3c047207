//! `fastlgs bench`: what the program costs and what it gives.

mod autoencoder;
mod baseline;
mod chart;
mod disturb;
mod plot;
mod report;
mod size;
mod speed;
mod stability;
mod table;
mod trial;
mod vision;

use crate::{Outcome, ui};
use anyhow::Result;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench speed scenes/fox --gaussians 50000 --size 270x480")]
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
    /// What accuracy and colour lose as a model gets smaller, and where `--budget auto` stops.
    Size(size::Args),
    /// What remains of accuracy when the input is disturbed, and on scenes that methods fail at.
    Stability(stability::Args),
    /// The other benches' results and sample pictures in one HTML file.
    Report(report::Args),
    /// Masks and embeddings alone, on labelled photos.
    Vision(vision::Args),
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    match &args.what {
        What::Speed(args) => speed::run(args, common),
        What::Baseline(args) => baseline::run(args, common),
        What::Chart(args) => chart::run(args, common),
        What::Size(args) => size::run(args, common),
        What::Stability(args) => stability::run(args, common),
        What::Report(args) => report::run(args, common),
        What::Vision(args) => vision::run(args, common),
    }
}
