//! Trained scenes with their labels, as benches of texts take them.

use anyhow::{Result, bail};
use std::path::{Path, PathBuf};

/// Scenes with their labels.
#[derive(clap::Args)]
pub struct Labelled {
    /// Trained scene folders of one encoder.
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Their folders of labels, in the same order.
    #[arg(long, required = true, value_delimiter = ',')]
    labels: Vec<PathBuf>,
}

impl Labelled {
    /// Each scene with its folder of labels.
    ///
    /// # Errors
    /// Another number of folders than of scenes.
    pub fn pairs(&self) -> Result<Vec<(&Path, &Path)>> {
        if self.scenes.len() != self.labels.len() {
            bail!("{} scenes and {} folders of labels: name one for each scene", self.scenes.len(), self.labels.len());
        }
        Ok(self.scenes.iter().zip(&self.labels).map(|(scene, labels)| (scene.as_path(), labels.as_path())).collect())
    }
}
