//! Which kernel shape an adapter is fastest with, and whether a software adapter is faster than the CPU backend: measured once by training
//! a small generated scene with each, and remembered in the user's cache folder (`shapes.json`) for the adapter, its driver and this
//! program's version.

use crate::density::State;
use crate::engine::{Engine, Exposure, StepOptions, TargetImage, pack};
use crate::gpu::{Gpu, adapters};
use crate::gpu_engine::GpuEngine;
use crate::native::CpuEngine;
use crate::shape::Shape;
use crate::{Channels, Result, Step, View};
use fastlgs_core::gaussians::BASE_CHANNELS;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, fs};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Gaussians of the scene that is trained.
const GAUSSIANS: usize = 20_000;
/// Its picture, in pixels along x and y.
const SIZE: u32 = 256;
/// Timed steps; the fastest counts, because other programs only ever slow one down.
const STEPS: usize = 6;

/// A shape takes the place of the present one only if it is faster by this factor. Shapes sum in different orders, so that the same
/// training gives other bytes with each: a busy moment must not change it.
const CLEARLY: f64 = 1.25;

/// Milliseconds of a training step with each shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tuning {
    /// The one that is used: the fastest, or the one before it where that is hardly slower.
    pub shape: Shape,
    /// With each.
    pub step_ms: BTreeMap<Shape, f64>,
    /// The CPU backend on the same machine, where the adapter is a software one.
    #[serde(default)]
    pub cpu_ms: Option<f64>,
}

type Table = BTreeMap<String, Tuning>;

fn table_path() -> PathBuf {
    fs::cache_dir().join("shapes.json")
}

fn key(identity: &str) -> String {
    format!("{identity}, fastlgs {}", env!("CARGO_PKG_VERSION"))
}

/// The table; empty where there is none. A damaged one is measured anew.
fn table(path: &Path) -> Table {
    if !path.is_file() {
        return Table::new();
    }
    fs::read_json(path).unwrap_or_else(|e| {
        tracing::warn!("{e}; kernel shapes will be measured again");
        Table::new()
    })
}

/// The shape that was fastest on this adapter, if it was ever measured.
pub(crate) fn remembered(identity: &str) -> Option<Shape> {
    table(&table_path()).get(&key(identity)).map(|t| t.shape)
}

/// Milliseconds of a step on a software adapter, at its best, and on the CPU backend, if they were ever measured.
pub(crate) fn against_cpu(identity: &str) -> Option<[f64; 2]> {
    let tuning = table(&table_path()).remove(&key(identity))?;
    Some([*tuning.step_ms.get(&tuning.shape)?, tuning.cpu_ms?])
}

/// Measures the adapter's shapes, and the CPU backend beside a software adapter, unless that was done before; engines opened later use
/// the fastest. `None` for `cpu`, which has no shapes, and for `auto` where there is no adapter. `again` measures in any case.
///
/// # Errors
/// When there is no such adapter, or it fails.
pub fn tune(device: &str, again: bool) -> Result<Option<Tuning>> {
    tune_at(&table_path(), device, again)
}

fn tune_at(path: &Path, device: &str, again: bool) -> Result<Option<Tuning>> {
    if device == "cpu" || (device == "auto" && adapters().is_empty()) {
        return Ok(None);
    }
    let gpu = Gpu::open(device)?;
    let key = key(&gpu.identity);
    let known = table(path).remove(&key);
    let complete = |t: &Tuning| (t.cpu_ms.is_some() || !gpu.software) && Shape::ALL.iter().all(|shape| t.step_ms.contains_key(shape));
    if let Some(known) = known.clone().filter(|t| complete(t) && !again) {
        return Ok(Some(known));
    }
    tracing::info!("measuring which kernels '{}' is fastest with; this is done once", gpu.name);
    let mut step_ms = BTreeMap::new();
    for shape in Shape::ALL {
        let mut gpu = Gpu::open(device)?;
        gpu.shape = shape;
        step_ms.insert(shape, measure(&mut GpuEngine::new(gpu))?);
    }
    let cpu_ms = if gpu.software { Some(measure(&mut CpuEngine::new())?) } else { None };
    let present = known.map_or(gpu.shape, |t| t.shape);
    let tuning = Tuning { shape: chosen(present, &step_ms), step_ms, cpu_ms };
    tracing::debug!(?tuning, "measured");
    let mut table = table(path);
    table.insert(key, tuning.clone());
    // Without a place to remember it, the measurement still serves this run's report.
    if let Err(e) = fs::write_json(path, &table) {
        tracing::warn!("{e}; the fastest kernels cannot be remembered");
    }
    Ok(Some(tuning))
}

/// The fastest shape, or the present one unless that is clearly slower.
fn chosen(present: Shape, step_ms: &BTreeMap<Shape, f64>) -> Shape {
    let fastest = step_ms.iter().min_by(|a, b| a.1.total_cmp(b.1)).expect("every adapter has shapes");
    if step_ms.get(&present).is_some_and(|ms| *ms <= CLEARLY * fastest.1) { present } else { *fastest.0 }
}

/// Milliseconds of the fastest training step.
fn measure(engine: &mut dyn Engine) -> Result<f64> {
    let mut rng = Rng::new(0, "tuning");
    let mut scene = Gaussians::default();
    for i in 0..GAUSSIANS {
        let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        scene.push_sphere(mean, 0.03, rng.range(0.1, 0.9), [rng.uniform(), rng.uniform(), rng.uniform()]);
        scene.log_scales[i] += Vec3::new(rng.range(-1.0, 0.5), rng.range(-1.0, 0.5), rng.range(-1.0, 0.5));
    }
    engine.set_state(&State::of(&scene))?;
    let camera = Camera::look_at("tuning", Vec3::new(0.0, 0.0, -4.0), Vec3::ZERO, Vec3::Y, SIZE, SIZE, 0.9);
    let view = View::new(&camera, scene.len(), 0);
    let gray = vec![pack([128; 3], true); view.pixels()];
    engine.set_target(0, TargetImage { size: view.size, color: gray.clone(), feature: gray })?;
    let options = StepOptions { channels: Channels::Both, lambda: 0.2, feature_weight: 1.0, exposure: Exposure::default() };
    let still = Step::new(1, 0..BASE_CHANNELS, &[0.0; BASE_CHANNELS + 1]);
    let mut fastest = f64::INFINITY;
    for round in 0..=STEPS {
        let started = Instant::now();
        engine.step(view.trained(), 0, &options, &still)?;
        engine.losses()?;
        // The first compiles the kernels.
        if round > 0 {
            fastest = fastest.min(1e3 * started.elapsed().as_secs_f64());
        }
    }
    Ok(fastest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_measured_once_and_remembered() {
        let Some(gpu) = crate::tests::gpu() else { return };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("shapes.json");
        std::fs::write(&path, "{").unwrap();
        tune_at(&path, "auto", false).unwrap();
        // What an earlier version measured can be read, and is measured again.
        let old = std::fs::read_to_string(&path).unwrap().replace("lanes32", "shared").replace("lanes64", "subgroups");
        std::fs::write(&path, old).unwrap();
        assert_eq!(table(&path).remove(&key(&gpu.identity)).unwrap().step_ms.len(), 2);
        let first = tune_at(&path, "auto", false).unwrap().unwrap();
        assert_eq!(first.step_ms.len(), Shape::ALL.len());
        assert!(first.step_ms.values().all(|ms| CLEARLY * ms >= first.step_ms[&first.shape]));
        assert_eq!(first.cpu_ms.is_some(), gpu.software, "a software adapter competes with the processor that it runs on");
        let known = table(&path).remove(&key(&gpu.identity)).unwrap();
        assert_eq!(known.shape, first.shape);
        assert_eq!(tune_at(&path, "auto", false).unwrap(), Some(known));
        assert_eq!(tune_at(&path, "cpu", false).unwrap(), None);
    }

    #[test]
    fn a_shape_stays_unless_another_is_clearly_faster() {
        let ms = |wide, lanes| BTreeMap::from([(Shape::Wide, wide), (Shape::Lanes32, lanes)]);
        assert_eq!(chosen(Shape::Wide, &ms(140.5, 139.5)), Shape::Wide);
        assert_eq!(chosen(Shape::Lanes32, &ms(74.0, 107.0)), Shape::Wide);
        assert_eq!(chosen(Shape::Lanes64, &ms(74.0, 70.0)), Shape::Lanes32, "what was not measured does not stay");
    }
}
