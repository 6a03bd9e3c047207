//! `fastlgs bench`: what the program costs and what it gives.

mod chart;
mod plot;
mod speed;
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
    /// Accuracy against time, for the ways from masks to a field that answers.
    Chart(chart::Args),
    /// Masks and embeddings alone, on labelled photos.
    Vision(vision::Args),
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    match &args.what {
        What::Speed(args) => speed::run(args, common),
        What::Chart(args) => chart::run(args, common),
        What::Vision(args) => vision::run(args, common),
    }
}
