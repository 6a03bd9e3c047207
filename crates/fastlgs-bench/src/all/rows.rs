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
mod tests {
    use super::*;

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
