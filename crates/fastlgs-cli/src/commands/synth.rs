//! `fastlgs synth`: scenes with exact answers.

use crate::scene::parse_size;
use crate::{Outcome, report, ui};
use anyhow::{Result, bail};
use clap::builder::PossibleValue;
use fastlgs_core::synth::{self, KINDS, Kind};
use fastlgs_vision::models;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs synth table -o photos/table --views 40 --size 320x240")]
pub struct Args {
    /// Kind of scene.
    #[arg(value_parser = kinds())]
    kind: String,
    /// Folder to write: images/, transforms.json, masks/ of three levels, depth/, labels/.
    #[arg(short, long)]
    output: PathBuf,
    /// Number of photos; by default 40 for most kinds.
    #[arg(long)]
    views: Option<usize>,
    /// Size of the photos.
    #[arg(long, default_value = "320x240", value_parser = parse_size)]
    size: (u32, u32),
    /// Folder of the room's pictures, instead of the installed ones.
    #[arg(long)]
    pictures: Option<PathBuf>,
    /// Every N-th view is labelled, to be held out.
    #[arg(long, default_value_t = 8)]
    holdout: usize,
}

fn kinds() -> Vec<PossibleValue> {
    KINDS.iter().map(|(name, _, about)| PossibleValue::new(name).help(about)).collect()
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let kind = Kind::of(&args.kind).expect("clap knows the kinds");
    let views = args.views.unwrap_or(kind.views());
    if views < 4 {
        bail!("--views {views}: at least 4 are needed");
    }
    let pictures = args.pictures.clone().unwrap_or_else(models::pictures_dir);
    let world = kind.world(&pictures, views, args.size, common.seed)?;
    let bar = ui::bar(common, views as u64, "synth");
    synth::write(&args.output, &world, args.holdout, || bar.inc(1))?;
    bar.finish_and_clear();
    let value = serde_json::json!({
        "kind": args.kind,
        "photos": args.output,
        "views": views,
        "size": format!("{}x{}", args.size.0, args.size.1),
        "objects": world.things.iter().map(|t| &t.name).collect::<Vec<_>>(),
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}
