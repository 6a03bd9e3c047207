//! Report of `train`, which the manifest also stores.

use super::config::{FeatureMode, Mapping, Preset};
use crate::objects;
use crate::progress::TrainStep;
use fastlgs_core::{Camera, Gaussians};
use fastlgs_raster::budget::Removal;
use fastlgs_raster::{Choice, View};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Report of `train`. The manifest stores it as a note.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct TrainReport {
    /// The scene folder.
    pub scene: PathBuf,
    /// Preset of the run.
    pub preset: Preset,
    /// Mapping of the run.
    pub mapping: Mapping,
    /// Feature mode of the run.
    pub feature_mode: FeatureMode,
    /// Number of objects, parts included.
    pub objects: usize,
    /// Seconds spent on finding objects.
    pub mapping_seconds: f64,
    /// Summary of global mapping; `None` with another mapping.
    pub mapping_summary: Option<objects::Summary>,
    /// Number of iterations.
    pub iterations: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Iterations per second.
    pub iterations_per_second: f64,
    /// Number of Gaussians at the end.
    pub gaussians: usize,
    /// Number of transparent Gaussians, which represent transparent objects.
    pub clear: usize,
    /// Removals by the automatic budget.
    pub removals: Vec<Removal>,
    /// SH degree of the written scene.
    pub sh_degree: u32,
    /// Whether exposures were learned.
    pub exposure: bool,
    /// PSNR that validation views gained by aligning their cameras, in dB, if it was measured.
    pub alignment_gain: Option<f64>,
    /// Whether the cameras of the training photos were moved.
    pub aligned: bool,
    /// Whether masks guided training at the borders of objects.
    pub borders: bool,
    /// Whether the 2-D Mip filter was on.
    pub antialias: bool,
    /// RGB background colour, 0 to 1.
    pub background: [f32; 3],
    /// Size of the first view, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Mean PSNR of the held-out views in dB.
    pub psnr_held_out: Option<f64>,
    /// PSNR of held-out views during training, if `curve` is set.
    pub curve: Vec<CurvePoint>,
    /// Name of the device.
    pub adapter: String,
    /// Device that was chosen, and the reason.
    pub device: Choice,
}

/// A point of the curve of held-out PSNR.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Number of iterations so far.
    pub iteration: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Mean PSNR of the held-out views in dB.
    pub psnr: Option<f64>,
    /// Number of Gaussians.
    pub gaussians: usize,
}

impl From<TrainStep> for CurvePoint {
    fn from(step: TrainStep) -> Self {
        Self {
            iteration: step.iteration,
            seconds: step.seconds,
            psnr: step.psnr_held_out,
            gaussians: step.gaussians,
        }
    }
}

impl TrainReport {
    /// Returns the view of a camera, with the background and filter of the training.
    pub fn view(&self, camera: &Camera, scene: &Gaussians) -> View {
        self.view_of(camera, scene.len(), scene.sh_degree)
    }

    /// The same for `gaussians` Gaussians with colour of degree `sh_degree`.
    pub(crate) fn view_of(&self, camera: &Camera, gaussians: usize, sh_degree: u32) -> View {
        View::new(camera, gaussians, sh_degree)
            .with_antialias(self.antialias)
            .with_background(self.background)
    }
}
