//! Calibrations of encoders: constants for the offline encoder, a file beside the model for others.

use crate::Result;
use crate::error::Context;
use fastlgs_core::fs;
use fastlgs_core::scene_folder::{Manifest, ModelFile};
use fastlgs_grid::calibration::Calibration;
use fastlgs_vision::clip;
use fastlgs_vision::crops::Background;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the offline encoder in the manifest.
pub(crate) const OFFLINE: &str = "offline";

/// Calibrations of an encoder for texts and for pictures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibrations {
    /// For cosines of masks with texts.
    pub texts: Calibration,
    /// For cosines of masks with pictures and with examples.
    pub pictures: Calibration,
}

/// Calibration file beside a model, with the hashes of the towers for which it is valid.
#[derive(Serialize, Deserialize)]
pub(crate) struct CalibrationFile {
    /// SHA-256 of image and text tower.
    pub sha256: [String; 2],
    /// Background around masks with which the cosines of names separate the objects best.
    pub background: Background,
    /// Calibrations by background.
    pub calibrations: BTreeMap<Background, Calibrations>,
}

/// Returns the SHA-256 of image and text tower among model files; empty if one is missing.
pub(crate) fn tower_hashes(files: &BTreeMap<String, ModelFile>) -> [String; 2] {
    ["clip_image", "clip_text"].map(|role| {
        files
            .get(role)
            .map(|file| file.sha256.clone())
            .unwrap_or_default()
    })
}

/// Reads the calibration file of these towers. Returns `None` if it is missing, unreadable, or for
/// towers with other hashes.
fn read_calibration(files: &BTreeMap<String, ModelFile>) -> Option<CalibrationFile> {
    let path = calibration_path(&files.get("clip_image")?.path);
    let kept = path
        .is_file()
        .then(|| fs::read_json::<CalibrationFile>(&path))?;
    // A file that cannot be parsed comes from another version, whose values are not comparable.
    if kept.is_err() {
        tracing::warn!(
            "{}: another version wrote this calibration, so it is ignored; run 'fastlgs models calibrate' again",
            path.display()
        );
    }
    let kept = kept.ok()?;
    if kept.sha256 == tower_hashes(files) {
        return Some(kept);
    }
    tracing::warn!(
        "{}: this calibration was measured with other files of image or text tower, so it is ignored; run 'fastlgs models calibrate' again",
        path.display()
    );
    None
}

/// Returns the background around masks in the crops of a scene.
///
/// # Errors
/// A background that this version does not know.
pub(crate) fn background_of(manifest: &Manifest) -> Result<Background> {
    if manifest.crops.is_empty() {
        return Ok(Background::default());
    }
    let known = serde_json::from_value(manifest.crops.clone().into()).ok();
    known.with_context(|| {
        format!("scene.json: this version does not know the value '{}' of 'crops'; run 'fastlgs preprocess' again", manifest.crops)
    })
}

/// Returns the word for a background in the manifest; empty for grey.
pub(crate) fn background_name(background: Background) -> String {
    match background {
        Background::Grey => String::new(),
        other => serde_json::to_value(other)
            .ok()
            .and_then(|word| Some(word.as_str()?.to_owned()))
            .unwrap_or_default(),
    }
}

/// Returns whether a readable calibration file lies beside an image tower.
pub fn has_calibration_file(image_tower: &Path) -> bool {
    fs::read_json::<CalibrationFile>(&calibration_path(image_tower)).is_ok()
}

/// Returns the best measured background for these towers; the default without calibration file.
pub(crate) fn best_background(files: &BTreeMap<String, ModelFile>) -> Background {
    read_calibration(files)
        .map(|kept| kept.background)
        .unwrap_or_default()
}

/// Returns the path of the calibration file of a CLIP image tower.
pub fn calibration_path(image_tower: &Path) -> PathBuf {
    image_tower.with_extension("calibration.json")
}

impl Calibrations {
    /// Calibrations of the offline encoder.
    pub const OFFLINE: Self = Self {
        texts: Calibration::OFFLINE,
        pictures: Calibration::OFFLINE_PICTURES,
    };

    /// Calibrations of OpenCLIP's models, and of all others without calibration file.
    pub const CLIP: Self = Self {
        texts: Calibration::CLIP,
        pictures: Calibration::CLIP_PICTURES,
    };

    /// Calibrations of OpenAI's models without calibration file.
    pub const OPENAI_CLIP: Self = Self {
        texts: Calibration::OPENAI_CLIP,
        pictures: Calibration::CLIP_PICTURES,
    };

    /// Returns the calibrations of a CLIP tower without calibration file.
    pub(crate) fn of_tower(tower: &Path) -> Self {
        if clip::is_openai(tower) {
            Self::OPENAI_CLIP
        } else {
            Self::CLIP
        }
    }

    /// Returns the calibrations of the encoder that made a scene's embeddings.
    pub fn of(manifest: &Manifest) -> Self {
        if manifest.encoder == OFFLINE {
            return Self::OFFLINE;
        }
        let known = background_of(manifest).ok().and_then(|background| {
            read_calibration(&manifest.models)?
                .calibrations
                .remove(&background)
        });
        known.unwrap_or_else(|| {
            let tower = manifest.models.get("clip_text");
            tower.map_or(Self::CLIP, |file| Self::of_tower(&file.path))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_calibration_file_is_used_only_for_its_towers() {
        let dir = tempfile::tempdir().unwrap();
        let tower = dir.path().join("image.onnx");
        let file = |sha256: &str| ModelFile {
            path: tower.clone(),
            bytes: 0,
            sha256: sha256.to_owned(),
        };
        let files = |sha256: &str| {
            ["clip_image", "clip_text"]
                .map(|role| (role.to_owned(), file(sha256)))
                .into_iter()
                .collect::<BTreeMap<_, _>>()
        };
        let background = Background::ALL[1];
        let calibration = CalibrationFile {
            sha256: tower_hashes(&files("a")),
            background,
            calibrations: BTreeMap::new(),
        };
        assert!(!has_calibration_file(&tower));
        fs::write_json(&calibration_path(&tower), &calibration).unwrap();
        assert!(has_calibration_file(&tower));
        assert_eq!(best_background(&files("a")), background);
        assert_eq!(best_background(&files("b")), Background::default());
    }

    #[test]
    fn backgrounds_have_names_in_the_manifest() {
        for background in Background::ALL {
            let manifest = Manifest {
                crops: background_name(background),
                ..Manifest::default()
            };
            assert_eq!(background_of(&manifest).unwrap(), background);
        }
        let unknown = Manifest {
            crops: "plaid".to_owned(),
            ..Manifest::default()
        };
        assert!(background_of(&unknown).is_err());
    }
}
