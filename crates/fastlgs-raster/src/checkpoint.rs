//! Checkpoints: a JSON header that names a file of tensors.
//!
//! The header is replaced after the new tensors are written, so a complete checkpoint exists at any
//! time.

use crate::Result;
use crate::budget::Removal;
use crate::density::State;
use crate::exposure::{Learned, LearnedExposure};
use crate::schedule::TrainerConfig;
use fastlgs_core::fs;
use fastlgs_core::gaussians::channels;
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::{load_tensors, save_tensors};
use glam::Mat4;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The state of a training run, except its tensors.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct TrainingState {
    pub config: TrainerConfig,
    pub iteration: u32,
    pub gaussians: usize,
    pub order: Vec<usize>,
    pub rng: Rng,
    pub removals: Vec<Removal>,
    pub exposures: Vec<LearnedExposure>,
    pub background: Learned<6>,
    /// Names and sizes in pixels of the training views.
    #[serde(default)]
    pub views: Vec<(String, [u32; 2])>,
    /// Fingerprint of the target images and the first Gaussians; 0 if unknown.
    #[serde(default)]
    pub shown: u64,
    /// Poses of the training views, world to camera.
    pub poses: Vec<Mat4>,
    /// PSNR gain of the validation views by alignment, in dB; `None` until it is measured.
    pub alignment_gain: Option<f64>,
    /// Whether the feature loss already moves geometry.
    #[serde(default)]
    pub coupled: bool,
}

fn tensors_path(path: &Path, iteration: u32) -> PathBuf {
    path.with_extension(format!("{iteration}.safetensors"))
}

/// Writes `path.json` and the tensor file that it names, then removes older tensor files.
pub(crate) fn save(
    path: &Path,
    training: &TrainingState,
    state: &State,
    stats: &[f32],
) -> Result<()> {
    let n = state.len();
    let shape = vec![channels(state.sh_degree), n];
    let tensors = [
        ("params", shape.clone(), state.params.as_slice()),
        ("moment1", shape.clone(), &state.moment1),
        ("moment2", shape, &state.moment2),
        ("stats", vec![2, n], stats),
    ];
    let keep = tensors_path(path, training.iteration);
    save_tensors(&keep, &tensors)?;
    fs::write_json(&path.with_extension("json"), training)?;
    tensors_of(path)
        .filter(|old| *old != keep)
        .for_each(|old| drop(std::fs::remove_file(old)));
    Ok(())
}

/// Returns the tensor files of a checkpoint: `NAME.ITERATION.safetensors` beside `path`.
fn tensors_of(path: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = std::fs::read_dir(path.parent().unwrap_or(Path::new(".")))
        .into_iter()
        .flatten()
        .flatten();
    let name = path
        .file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    entries.map(|entry| entry.path()).filter(move |file| {
        let own = file.file_name().unwrap_or_default().to_string_lossy();
        let iteration = own
            .strip_prefix(&name)
            .and_then(|rest| rest.strip_prefix('.')?.strip_suffix(".safetensors"));
        iteration
            .is_some_and(|digits| !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit()))
    })
}

/// Removes the files of a checkpoint and no others.
pub fn remove(path: &Path) {
    let _ = std::fs::remove_file(path.with_extension("json"));
    tensors_of(path).for_each(|file| drop(std::fs::remove_file(file)));
}

/// Reads a checkpoint. Returns `None` if there is none.
pub(crate) fn load(path: &Path) -> Result<Option<(TrainingState, State, Vec<f32>)>> {
    let header = path.with_extension("json");
    if !header.is_file() {
        return Ok(None);
    }
    let training: TrainingState = fs::read_json(&header)?;
    let tensors_path = tensors_path(path, training.iteration);
    let mut tensors = load_tensors(&tensors_path)?;
    let mut take = |name: &str, rows: usize| {
        let found = tensors
            .remove(name)
            .filter(|t| t.0 == [rows, training.gaussians])
            .map(|t| t.1);
        found.ok_or_else(|| {
            fastlgs_core::Error::format(
                &tensors_path,
                format!("tensor '{name}' is missing or has the wrong shape; delete the checkpoint"),
            )
        })
    };
    let sh_degree = training.config.degree(training.iteration);
    let rows = channels(sh_degree);
    let state = State {
        sh_degree,
        params: take("params", rows)?,
        moment1: take("moment1", rows)?,
        moment2: take("moment2", rows)?,
    };
    let stats = take("stats", 2)?;
    Ok(Some((training, state, stats)))
}
