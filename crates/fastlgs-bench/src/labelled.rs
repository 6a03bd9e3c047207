//! Command-line arguments for scenes with labels.

use anyhow::{Result, bail};
use std::path::{Path, PathBuf};

/// Trained scenes with their labels.
#[derive(clap::Args)]
pub struct Labelled {
    /// Trained scene folders, all with the same encoder.
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Label folders of the scenes, in the same order, separated by commas.
    #[arg(long, required = true, value_delimiter = ',')]
    labels: Vec<PathBuf>,
}

impl Labelled {
    /// Returns each scene with its label folder.
    ///
    /// # Errors
    /// The number of label folders differs from the number of scenes.
    pub fn pairs(&self) -> Result<Vec<(&Path, &Path)>> {
        if self.scenes.len() != self.labels.len() {
            bail!(
                "{} scenes but {} label folders; give --labels one folder for each scene",
                self.scenes.len(),
                self.labels.len()
            );
        }
        Ok(self
            .scenes
            .iter()
            .zip(&self.labels)
            .map(|(scene, labels)| (scene.as_path(), labels.as_path()))
            .collect())
    }
}
