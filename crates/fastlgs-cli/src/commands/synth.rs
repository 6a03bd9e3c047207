//! `fastlgs synth`: scenes with exact answers.

use crate::scene::parse_size;
use crate::{Outcome, report, ui};
use anyhow::{Result, bail};
use fastlgs_core::synth::{self, Room};
use fastlgs_vision::models;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs synth room -o photos/room --views 40 --size 320x240")]
pub struct Args {
    /// Kind of scene: `room` (four blocks with pictures in a brick room).
    #[arg(value_parser = ["room"])]
    kind: String,
    /// Folder to write: images/, transforms.json, masks/, depth/, labels/.
    #[arg(short, long)]
    output: PathBuf,
    /// Number of photos.
    #[arg(long, default_value_t = 40)]
    views: usize,
    /// Size of the photos.
    #[arg(long, default_value = "320x240", value_parser = parse_size)]
    size: (u32, u32),
    /// Folder of the pictures, instead of the installed ones.
    #[arg(long)]
    pictures: Option<PathBuf>,
    /// Every N-th view is labelled, to be held out.
    #[arg(long, default_value_t = 8)]
    holdout: usize,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    if args.views < 4 {
        bail!("--views {}: at least 4 are needed", args.views);
    }
    let pictures = args.pictures.clone().unwrap_or_else(models::pictures_dir);
    let room = Room::new(&pictures, common.seed)?;
    let cameras = Room::cameras(args.views, args.size.0, args.size.1);
    let bar = ui::bar(common, args.views as u64, "synth");
    synth::write(&args.output, &room, &cameras, args.holdout, || bar.inc(1))?;
    bar.finish_and_clear();
    let value = serde_json::json!({
        "kind": args.kind,
        "photos": args.output,
        "views": args.views,
        "size": format!("{}x{}", args.size.0, args.size.1),
        "objects": room.names(),
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}
