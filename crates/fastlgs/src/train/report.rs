//! What `train` reports, and the scene remembers.

use super::config::{FeatureMode, Mapping, Preset};
use crate::progress::TrainStep;
use crate::{Error, Result, objects};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians};
use fastlgs_raster::budget::Removal;
use fastlgs_raster::{Choice, View};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What training found; also the manifest's note of it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Report {
    /// The scene folder.
    pub scene: PathBuf,
    /// As asked for.
    pub preset: Preset,
    /// As asked for.
    pub mapping: Mapping,
    /// As asked for.
    pub feature_mode: FeatureMode,
    /// Objects and parts.
    pub objects: usize,
    /// Seconds from Gaussians to objects.
    pub mapping_seconds: f64,
    /// What global mapping found.
    pub mapping_summary: Option<objects::Summary>,
    /// Steps done.
    pub iterations: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Steps a second.
    pub iterations_per_second: f64,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Those of them that are clear: they stand for what photos see through.
    pub clear: usize,
    /// What the automatic budget removed.
    pub removals: Vec<Removal>,
    /// SH degree of the written scene.
    pub sh_degree: u32,
    /// Whether exposures were learned.
    pub exposure: bool,
    /// What photos that were kept aside gained by aligning their cameras, in dB, where that was looked at.
    pub alignment_gain: Option<f64>,
    /// Whether the cameras of the training photos were moved.
    pub aligned: bool,
    /// Whether masks told Gaussians where things end.
    pub borders: bool,
    /// Whether the 2-D Mip filter was on.
    pub antialias: bool,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Size of the first view.
    pub size: String,
    /// Mean PSNR of the held-out views in dB.
    pub psnr_held_out: Option<f64>,
    /// Where `curve` asked for it.
    pub curve: Vec<CurvePoint>,
    /// The device's name.
    pub adapter: String,
    /// What `--device` meant, and why.
    pub device: Choice,
}

/// A point of the curve of held-out PSNR.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Steps done.
    pub iteration: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Mean PSNR of the held-out views in dB.
    pub psnr: Option<f64>,
    /// Gaussians.
    pub gaussians: usize,
}

impl From<TrainStep> for CurvePoint {
    fn from(step: TrainStep) -> Self {
        Self { iteration: step.iteration, seconds: step.seconds, psnr: step.psnr_held_out, gaussians: step.gaussians }
    }
}

/// The manifest's note of training.
const NOTE: &str = "train";

impl Report {
    /// How the scene in a folder was trained; nothing where it was not, or was preprocessed again since.
    ///
    /// # Errors
    /// A note that cannot be read: without it the scene would be drawn with another background and filter.
    pub fn of(manifest: &Manifest, root: &Path) -> Result<Option<Self>> {
        let Some(note) = manifest.notes.get(NOTE) else { return Ok(None) };
        let read = serde_json::from_value(note.clone()).map_err(|error| {
            let root = root.display();
            Error::Invalid(format!(
                "{root}/scene.json: the note of its training cannot be read ({error}); run 'fastlgs train {root}' again"
            ))
        });
        read.map(Some)
    }

    /// The frame of a camera, in the way the scene was trained.
    pub fn view(&self, camera: &Camera, scene: &Gaussians) -> View {
        let mut view = View::new(camera, scene.len(), scene.sh_degree);
        view.antialias = u32::from(self.antialias);
        view.background_color[..3].copy_from_slice(&self.background);
        view
    }

    /// Notes it in the manifest.
    pub(super) fn note(&self, manifest: &mut Manifest) -> Result<()> {
        manifest.notes.insert(NOTE.to_owned(), serde_json::to_value(self)?);
        Ok(())
    }
}
