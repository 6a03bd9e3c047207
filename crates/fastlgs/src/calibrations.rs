//! What the cosines of a scene's encoder are worth: known for the offline encoder, kept beside the model for others.

use crate::eyes;
use fastlgs_core::fs;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::calibration::Calibration;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

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
    pub sha256: [String; 2],
    #[serde(flatten)]
    pub calibrations: Calibrations,
}

/// Where the measurement of a CLIP is kept.
pub fn beside(image_tower: &Path) -> PathBuf {
    image_tower.with_extension("calibration.json")
}

impl Calibrations {
    /// The offline encoder's.
    pub const OFFLINE: Self = Self { texts: Calibration::OFFLINE, pictures: Calibration::OFFLINE_PICTURES };

    /// What is assumed of a CLIP that was not measured: pictures about as far from each other as with the offline encoder.
    pub const CLIP: Self = Self { texts: Calibration::CLIP, pictures: Calibration { measured: false, ..Calibration::OFFLINE_PICTURES } };

    /// Those of the encoder that made a scene's embeddings.
    pub fn of(manifest: &Manifest) -> Self {
        if manifest.encoder == eyes::OFFLINE {
            return Self::OFFLINE;
        }
        let (image, text) = (manifest.models.get("clip_image"), manifest.models.get("clip_text"));
        let path = image.map(|image| beside(&image.path)).filter(|path| path.is_file());
        // What another version measured was measured for other rules.
        let kept: Option<Kept> = path.and_then(|path| {
            let kept = fs::read_json(&path);
            if kept.is_err() {
                tracing::warn!("{}: it is of another version and does not count; run 'fastlgs models calibrate' again", path.display());
            }
            kept.ok()
        });
        let same = |kept: &Kept| [image, text].iter().zip(&kept.sha256).all(|(file, sum)| file.is_some_and(|f| f.sha256 == *sum));
        kept.filter(same).map_or(Self::CLIP, |kept| kept.calibrations)
    }
}
