//! `fastlgs synth`: scenes with exact answers.

use crate::{Outcome, ui};
use anyhow::Result;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// Folder to write.
    #[arg(short, long)]
    output: PathBuf,
}

pub fn run(_args: &Args, _common: &ui::Common) -> Result<Outcome> {
    anyhow::bail!("not yet")
}
