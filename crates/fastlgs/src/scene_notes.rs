//! Notes that the stages record in `scene.json`, in addition to the fields of the manifest.

use crate::preprocess::Brightness;
use crate::train::TrainReport;
use crate::{Error, Result};
use fastlgs_core::scene_folder::Manifest;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// Notes of the stages of a scene. A stage that runs again removes the notes of later stages.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct SceneNotes {
    /// Brightness of the photos, measured by `preprocess`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub brightness: Option<Brightness>,
    /// Report of the training.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train: Option<TrainReport>,
    /// Options and photos of `make`, if it made the scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub made: Option<Value>,
    /// Objects that `remove` removed, in order.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub removed: Vec<String>,
}

impl SceneNotes {
    /// Reads the notes of a manifest. `root` is the scene folder.
    ///
    /// # Errors
    /// Notes that cannot be read. Without them, background and filter of renders would be wrong.
    pub fn read(manifest: &Manifest, root: &Path) -> Result<Self> {
        let notes: Value = manifest.notes.clone().into_iter().collect();
        serde_json::from_value(notes).map_err(|error| {
            let root = root.display();
            Error::Invalid(format!(
                "{root}/scene.json: its notes cannot be read ({error}); run 'fastlgs preprocess' and 'fastlgs train' again"
            ))
        })
    }

    /// Replaces the notes of a manifest.
    pub fn store(&self, manifest: &mut Manifest) -> Result<()> {
        manifest.notes = serde_json::from_value(serde_json::to_value(self)?)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notes_round_trip_and_damaged_ones_are_refused() {
        let mut manifest: Manifest = serde_json::from_value(serde_json::json!({
            "version": "0.1.0", "photos": "p", "holdout": 8, "segmenter": "offline", "encoder": "offline", "seed": 0,
            "warnings": [],
        }))
        .unwrap();
        let empty = SceneNotes::read(&manifest, Path::new("s")).unwrap();
        assert!(empty.train.is_none() && empty.removed.is_empty());
        let notes = SceneNotes {
            train: Some(TrainReport {
                gaussians: 7,
                ..TrainReport::default()
            }),
            removed: vec!["cup".to_owned()],
            ..SceneNotes::default()
        };
        notes.store(&mut manifest).unwrap();
        let again = SceneNotes::read(&manifest, Path::new("s")).unwrap();
        assert_eq!(
            (again.train.unwrap().gaussians, again.removed),
            (7, vec!["cup".to_owned()])
        );
        manifest.notes.insert(
            "train".to_owned(),
            serde_json::json!({ "gaussians": "many" }),
        );
        let message = SceneNotes::read(&manifest, Path::new("s"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("s/scene.json"), "{message}");
    }
}
