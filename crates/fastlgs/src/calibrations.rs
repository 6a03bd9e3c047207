//! What the cosines of a scene's encoder are worth: known for the offline encoder, kept beside the model for others.

use crate::Result;
use crate::error::Context;
use fastlgs_core::fs;
use fastlgs_core::scene_folder::{Manifest, ModelFile};
use fastlgs_grid::calibration::Calibration;
use fastlgs_vision::crops::Background;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The manifest's name of the encoder that comes with the program.
pub(crate) const OFFLINE: &str = "offline";

/// What cosines with texts, and cosines with other pictures, are worth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibrations {
    /// Of masks with texts.
    pub texts: Calibration,
    /// Of masks with pictures and with things that were shown.
    pub pictures: Calibration,
}

/// A measurement as it is kept beside the model, with the files that it holds for.
#[derive(Serialize, Deserialize)]
pub(crate) struct Kept {
    /// Of image and text tower.
    pub sha256: [String; 2],
    /// What should stand around masks: that with which names tell things apart best.
    pub background: Background,
    /// With each of them.
    pub calibrations: BTreeMap<Background, Calibrations>,
}

/// SHA-256 of the towers among some model files.
pub(crate) fn sums(files: &BTreeMap<String, ModelFile>) -> [String; 2] {
    ["clip_image", "clip_text"].map(|role| files.get(role).map(|file| file.sha256.clone()).unwrap_or_default())
}

/// What was measured with these towers, if it was.
fn kept(files: &BTreeMap<String, ModelFile>) -> Option<Kept> {
    let path = beside(&files.get("clip_image")?.path);
    let kept = path.is_file().then(|| fs::read_json::<Kept>(&path))?;
    // What another version measured was measured for other rules.
    if kept.is_err() {
        tracing::warn!("{}: it is of another version and does not count; run 'fastlgs models calibrate' again", path.display());
    }
    kept.ok().filter(|kept| kept.sha256 == sums(files))
}

/// What stands around the masks that a scene's encoder saw; a word that this program does not know is refused.
pub(crate) fn background_of(manifest: &Manifest) -> Result<Background> {
    if manifest.crops.is_empty() {
        return Ok(Background::default());
    }
    let known = serde_json::from_value(manifest.crops.clone().into()).ok();
    known.with_context(|| {
        format!("scene.json: 'crops' is '{}', which this program does not know; preprocess the photos again", manifest.crops)
    })
}

/// The word that a scene remembers for it.
pub(crate) fn word_of(background: Background) -> String {
    match background {
        Background::Grey => String::new(),
        other => serde_json::to_value(other).ok().and_then(|word| Some(word.as_str()?.to_owned())).unwrap_or_default(),
    }
}

/// Whether a measurement of this version lies beside an image tower.
pub fn is_measured(image_tower: &Path) -> bool {
    fs::read_json::<Kept>(&beside(image_tower)).is_ok()
}

/// What should stand around the masks that these towers see.
pub(crate) fn best_background(files: &BTreeMap<String, ModelFile>) -> Background {
    kept(files).map(|kept| kept.background).unwrap_or_default()
}

/// Where the measurement of a CLIP is kept.
pub fn beside(image_tower: &Path) -> PathBuf {
    image_tower.with_extension("calibration.json")
}

impl Calibrations {
    /// The offline encoder's.
    pub const OFFLINE: Self = Self { texts: Calibration::OFFLINE, pictures: Calibration::OFFLINE_PICTURES };

    /// What is assumed of a CLIP that was not measured.
    pub const CLIP: Self = Self { texts: Calibration::CLIP, pictures: Calibration::CLIP_PICTURES };

    /// Those of the encoder that made a scene's embeddings.
    pub fn of(manifest: &Manifest) -> Self {
        if manifest.encoder == OFFLINE {
            return Self::OFFLINE;
        }
        let known = background_of(manifest).ok().and_then(|background| kept(&manifest.models)?.calibrations.remove(&background));
        known.unwrap_or(Self::CLIP)
    }
}
