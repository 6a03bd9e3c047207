//! `fastlgs info`: devices, or what is in a scene.

use crate::outcome::Outcome;
use crate::{report, ui};
use anyhow::Result;
use fastlgs_core::SceneFolder;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs info scenes/fox")]
pub struct Args {
    /// Scene folder; without it the machine's devices are listed.
    scene: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let value = match &args.scene {
        None => serde_json::json!({
            "version": env!("CARGO_PKG_VERSION"),
            "adapters": fastlgs_raster::adapters(),
            "auto": fastlgs_raster::choice("auto"),
            "cores": std::thread::available_parallelism().map_or(1, usize::from),
            "sift": fastlgs_vision::keypoints::backend(),
            "offline_models": fastlgs_vision::models::offline_installed(),
        }),
        Some(root) => {
            let folder = SceneFolder::open(root)?;
            let (manifest, cameras) = (folder.manifest()?, folder.cameras()?);
            let objects = fastlgs_grid::Grid::load(&folder).map(|g| g.objects.len()).ok();
            let held_out = manifest.held_out(&cameras).len();
            let bytes = |name: &str| std::fs::metadata(root.join(name)).map(|m| m.len()).ok();
            serde_json::json!({
                "scene": root,
                "views": cameras.len(),
                "held_out": held_out,
                "objects": objects,
                "gaussians": folder.gaussians().map(|g| g.len()).ok(),
                "bytes": { "scene.ply": bytes("scene.ply"), "grid.safetensors": bytes("grid.safetensors"), "grid.json": bytes("grid.json") },
                "made_by": manifest,
            })
        }
    };
    report::give(common, &value)
}
