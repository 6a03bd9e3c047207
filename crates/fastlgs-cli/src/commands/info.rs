//! `fastlgs info`: shows the devices of this machine, or the contents of a scene.

use crate::outcome::Outcome;
use crate::{report, ui, words};
use anyhow::Result;
use fastlgs_core::SceneFolder;
use fastlgs_sfm::keypoints;
use fastlgs_vision::{Provider, model_paths, models, provider};
use serde_json::json;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs info scenes/fox")]
pub struct Args {
    /// Scene folder; without it, the devices of this machine are shown.
    scene: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    match &args.scene {
        None => machine(common),
        Some(root) => scene(root, common),
    }
}

/// Reports versions, devices and models of this machine.
fn machine(common: &ui::Common) -> Result<Outcome> {
    let (version, adapters, auto) = (
        env!("CARGO_PKG_VERSION"),
        fastlgs_raster::adapters(),
        fastlgs_raster::choice("auto"),
    );
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let (sift, installed) = (keypoints::backend(), models::offline_installed());
    let knows_names = models::names_installed();
    // Without ONNX Runtime there are none.
    let providers = provider::built_in().unwrap_or_default();
    let providers: Vec<&str> = providers.into_iter().map(Provider::name).collect();
    let runtime = model_paths::runtime_library().ok();
    let value = json!({
        "version": version,
        "adapters": adapters,
        "auto": auto,
        "cores": cores,
        "sift": sift,
        "offline_models": installed,
        "everyday_names": knows_names,
        "onnx_runtime": runtime,
        "onnx_providers": providers,
    });
    report::write_summary(common, &value, |_| {
        words::table(&[
            ("fastlgs", format!("{version}, key points by {sift}")),
            ("cpu", format!("{cores} cores")),
            (
                "adapters",
                if adapters.is_empty() {
                    "none".to_owned()
                } else {
                    adapters.join(", ")
                },
            ),
            ("auto device", format!("{} ({})", auto.device, auto.why)),
            (
                "models run on",
                if providers.is_empty() {
                    "nothing; ONNX Runtime is missing: run fastlgs models install-offline"
                        .to_owned()
                } else {
                    format!("{} (--onnx)", providers.join(", "))
                },
            ),
            (
                "encoders",
                if installed && knows_names {
                    "installed"
                } else if installed {
                    "installed, but the detector of everyday objects is missing, so fewer names are answered; run fastlgs models install-offline"
                } else {
                    "missing; run fastlgs models install-offline"
                }
                .to_owned(),
            ),
        ])
    })
}

/// Reports the contents of a scene.
fn scene(root: &Path, common: &ui::Common) -> Result<Outcome> {
    let folder = SceneFolder::open(root)?;
    let (manifest, cameras) = (folder.manifest()?, folder.cameras()?);
    let objects = fastlgs_grid::Grid::load(&folder)
        .map(|g| g.objects.len())
        .ok();
    let gaussians = folder.gaussians().map(|g| g.len()).ok();
    let held_out = manifest.held_out(&cameras).len();
    let bytes = |name: &str| std::fs::metadata(root.join(name)).map(|m| m.len()).ok();
    let value = json!({
        "scene": root,
        "views": cameras.len(),
        "held_out": held_out,
        "objects": objects,
        "gaussians": gaussians,
        "bytes": { "scene.ply": bytes("scene.ply"), "grid.safetensors": bytes("grid.safetensors"), "grid.json": bytes("grid.json") },
        "made_by": manifest,
    });
    let count_or_hint = |count: Option<usize>| {
        let hint = || "none yet; run fastlgs train".to_owned();
        count.map_or_else(hint, words::thousands)
    };
    let (path, version, seed) = (root.display(), &manifest.version, manifest.seed);
    let (photos, source) = (cameras.len(), manifest.photos.display());
    let (segmenter, encoder) = (&manifest.segmenter, &manifest.encoder);
    let needed = words::megabytes(fastlgs::scene::query_file_bytes(root));
    let rows = [
        (
            "scene",
            format!("{path}, made by fastlgs {version}, seed {seed}"),
        ),
        (
            "photos",
            format!("{photos} from {source}, {held_out} of them held out"),
        ),
        (
            "models",
            format!("masks: {segmenter}, embeddings: {encoder}"),
        ),
        ("Gaussians", count_or_hint(gaussians)),
        ("objects", count_or_hint(objects)),
        ("queries", format!("need {needed}")),
        ("warnings", manifest.warnings.join("\n          ")),
    ];
    report::write_summary(common, &value, |_| words::table(&rows))
}
