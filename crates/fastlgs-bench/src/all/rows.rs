//! The measured rows.

use super::plan::Planned;
use anyhow::{Result, bail};
use fastlgs_core::fs;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// Version of the measured code: the last commit that changed anything but the bench.
const VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    ", commit ",
    env!("FASTLGS_COMMIT")
);

/// All measured rows. They are of one version.
#[derive(Serialize, Deserialize)]
pub struct Rows {
    pub version: String,
    /// Each row has `scene`, `way`, `seed` and `machine`, and figures.
    pub rows: Vec<Value>,
    /// Report of `fastlgs-bench clip`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip: Option<Value>,
}

impl Rows {
    /// Loads the rows of `file`; empty if it is missing.
    ///
    /// # Errors
    /// The file is damaged. If rows are to be added, it has rows of another version.
    pub fn load(file: &Path, to_add: bool) -> Result<Self> {
        if !file.is_file() {
            return Ok(Self {
                version: VERSION.to_owned(),
                rows: Vec::new(),
                clip: None,
            });
        }
        let rows: Self = fs::read_json(file)?;
        if to_add && rows.version != VERSION {
            bail!(
                "{}: these rows are of version {}, and this is {VERSION}; remove the file to measure all rows again",
                file.display(),
                rows.version
            );
        }
        Ok(rows)
    }

    pub fn has(&self, planned: &Planned) -> bool {
        self.rows.iter().any(|row| {
            row["scene"] == planned.scene.name.as_str()
                && row["way"] == planned.way.name
                && row["seed"] == planned.seed
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::ways::{BASE, UNCHANGED};
    use super::*;
    use serde_json::json;

    pub fn row(scene: &str, way: &str, seed: u64, best: f64, train: f64) -> Value {
        json!({
            "scene": scene, "way": way, "seed": seed, "machine": "a processor", "adapter": "cpu", "size": "64x48",
            "oracle_miou": best, "miou": 0.5 * best, "psnr": 30.0, "gaussians": 1000, "objects": 9, "photos": 35,
            "scene_bytes": 2_000_000, "right": 2, "labels": 4, "absent_rejected": 40, "absent_texts": 40,
            "query_ms": 20.0, "seconds": { "preprocess": 1.0, "train": train, "objects": 2.0 },
        })
    }

    pub fn rows() -> Rows {
        Rows {
            version: "1.0.0, commit abc".to_owned(),
            clip: None,
            rows: vec![
                row("fox", BASE, 0, 0.8, 10.0),
                row("fox", BASE, 1, 0.9, 12.0),
                row("fox", "standard", 0, 0.7, 40.0),
                row("fox", UNCHANGED, 0, 0.9, 10.0),
                row("fox", "blur 2 px", 0, 0.6, 10.0),
                row("fox", "JPEG quality 15", 0, 0.89, 10.0),
                row("twins", "as it is", 0, 0.3, 10.0),
            ],
        }
    }

    #[test]
    fn rows_of_another_version_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("rows.json");
        let rows = Rows::load(&file, true).expect("no rows yet");
        assert!(rows.rows.is_empty() && rows.version == VERSION);
        let other = Rows {
            version: "0.0.1, commit 1234567".to_owned(),
            ..rows
        };
        fs::write_json(&file, &other).expect("written");
        let message = Rows::load(&file, true).err().expect("refused").to_string();
        assert!(Rows::load(&file, false).is_ok());
        assert!(
            message.contains("1234567") && message.contains("rows.json"),
            "{message}"
        );
    }
}
