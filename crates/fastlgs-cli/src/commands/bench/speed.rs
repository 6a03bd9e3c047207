//! `fastlgs bench speed`: milliseconds of every pass over Gaussians x resolutions.
//!
//! Every setting renders and trains the same views of the scene with learning rates of zero, so that all steps cost the
//! same; kernels are compiled before the clock starts.

use crate::scene::parse_size;
use crate::{Outcome, report, ui};
use anyhow::{Result, bail};
use fastlgs_core::gaussians::{BASE_CHANNELS, channels};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, SceneFolder};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, Exposure, Step, StepOptions, TargetImage, View, pack};
use glam::Vec3;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench speed scenes/fox --gaussians 20000,50000 --size 270x480")]
pub struct Args {
    /// Trained scene; without it a generated cloud.
    scene: Option<PathBuf>,
    /// Numbers of Gaussians, separated by commas; the scene's are thinned out or repeated with a little noise.
    #[arg(long, value_delimiter = ',')]
    gaussians: Vec<usize>,
    /// Sizes of the pictures as WIDTHxHEIGHT, separated by commas; the scene's own by default.
    #[arg(long, value_delimiter = ',', value_parser = parse_size)]
    size: Vec<(u32, u32)>,
    /// Training steps that are timed in each setting.
    #[arg(long, default_value_t = 20)]
    steps: u32,
}

/// Views that take turns.
const VIEWS: usize = 4;
/// Rounds over the views in which passes are timed.
const ROUNDS: usize = 5;

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let (scene, cameras) = match &args.scene {
        Some(root) => {
            let folder = SceneFolder::open(root)?;
            (folder.gaussians()?, folder.cameras()?)
        }
        None => generated(common.seed),
    };
    if scene.is_empty() || cameras.is_empty() || args.steps == 0 {
        bail!("nothing to time: the scene has no Gaussians or no views, or --steps is 0");
    }
    let counts = if args.gaussians.is_empty() { vec![scene.len()] } else { args.gaussians.clone() };
    let sizes = if args.size.is_empty() { vec![(cameras[0].width, cameras[0].height)] } else { args.size.clone() };
    let mut engine = fastlgs_raster::open_engine(&common.device)?;
    let stride = cameras.len().div_ceil(VIEWS);
    let mut rows = Vec::new();
    for &count in &counts {
        let resized = resampled(&scene, count, common.seed);
        engine.set_state(&State::of(&resized))?;
        for &(w, h) in &sizes {
            let views: Vec<View> = cameras.iter().step_by(stride).map(|c| View::new(&c.resized(w, h), count, resized.sh_degree)).collect();
            rows.push(setting(engine.as_mut(), &views, args.steps)?);
        }
    }
    let value = json!({
        "scene": args.scene,
        "adapter": engine.name(),
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
        "sh_degree": 0,
        "settings": rows,
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}

/// Times one number of Gaussians at one resolution.
fn setting(engine: &mut dyn Engine, views: &[View], steps: u32) -> Result<Value> {
    let pixels = views[0].pixels();
    let zero = [0.0; BASE_CHANNELS + 1];
    let degree = views[0].sh_degree;
    let frozen = Step::new(1, 14..BASE_CHANNELS, &zero);
    let step = Step::new(1, 0..channels(degree), &zero);
    let options = |channels: Channels| StepOptions { channels, lambda: 0.2, feature_weight: 1.0, exposure: Exposure::default() };
    let full = options(Channels::Both);
    let target = TargetImage { size: views[0].size, color: vec![pack([128; 3], true); pixels], feature: vec![pack([128; 3], true); pixels] };
    (0..views.len()).try_for_each(|id| engine.set_target(id, &target))?;
    let (mut pairs, mut walked) = (0.0, 0.0);
    for (id, view) in views.iter().enumerate() {
        let frame = engine.render(*view, Channels::Both)?;
        pairs += f64::from(frame.pairs) / views.len() as f64;
        walked += frame.channels(7, 8).iter().map(|w| f64::from(*w)).sum::<f64>() / (pixels * views.len()) as f64;
        engine.step(*view, id, &full, &step)?;
        engine.step(*view, id, &options(Channels::Color), &step)?;
        engine.step(*view, id, &options(Channels::Feature), &frozen)?;
    }
    engine.losses()?;
    let mut timed = |channels: Channels, step: &Step| -> Result<f64> {
        let started = Instant::now();
        for k in 0..steps as usize {
            engine.step(views[k % views.len()], k % views.len(), &options(channels), step)?;
        }
        engine.losses()?;
        Ok(started.elapsed().as_secs_f64() / f64::from(steps))
    };
    let full_seconds = timed(Channels::Both, &step)?;
    let color_seconds = timed(Channels::Color, &step)?;
    let feature_seconds = timed(Channels::Feature, &frozen)?;
    let started = Instant::now();
    for k in 0..steps {
        engine.render(views[k as usize % views.len()], Channels::Both)?;
    }
    let render_seconds = started.elapsed().as_secs_f64() / f64::from(steps);
    let mut passes: BTreeMap<&str, f64> = BTreeMap::new();
    if engine.set_profiling(true) {
        // Other programs on the machine only ever slow a pass down: the fastest of some rounds is its time.
        for _ in 0..ROUNDS {
            let mut round: BTreeMap<&str, f64> = BTreeMap::new();
            for (id, view) in views.iter().enumerate() {
                engine.step(*view, id, &full, &step)?;
                for (name, seconds) in engine.take_profile()? {
                    *round.entry(name).or_default() += 1e3 * seconds / views.len() as f64;
                }
            }
            for (name, ms) in round {
                passes.entry(name).and_modify(|best| *best = best.min(ms)).or_insert(ms);
            }
        }
        engine.set_profiling(false);
    }
    Ok(json!({
        "gaussians": engine.len(),
        "size": format!("{}x{}", views[0].size[0], views[0].size[1]),
        "pairs": pairs,
        "evaluated_per_pixel": walked,
        "train_iterations_per_second": 1.0 / full_seconds,
        "train_color_only_iterations_per_second": 1.0 / color_seconds,
        "train_feature_only_iterations_per_second": 1.0 / feature_seconds,
        "render_ms": 1e3 * render_seconds,
        "train_ms": 1e3 * full_seconds,
        "train_pass_ms": passes,
    }))
}

/// Exactly `count` Gaussians that look like the scene's.
fn resampled(scene: &Gaussians, count: usize, seed: u64) -> Gaussians {
    let mut rng = Rng::new(seed, "bench resampling");
    let mut order: Vec<usize> = (0..scene.len()).collect();
    rng.shuffle(&mut order);
    let chosen: Vec<usize> = (0..count).map(|i| order[i % order.len()]).collect();
    let mut out = scene.select(&chosen);
    for i in scene.len().min(count)..count {
        // A copy beside its original, no farther than its own size.
        let noise = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        out.means[i] += noise * out.log_scales[i].max_element().exp().min(1.0);
    }
    out
}

/// A ball of anisotropic Gaussians seen from four sides.
fn generated(seed: u64) -> (Gaussians, Vec<Camera>) {
    let mut rng = Rng::new(seed, "bench cloud");
    let mut scene = Gaussians::default();
    for i in 0..50_000 {
        let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        scene.push_sphere(mean, 0.02, rng.range(0.1, 0.95), [rng.uniform(), rng.uniform(), rng.uniform()]);
        scene.log_scales[i] += Vec3::new(rng.range(-1.0, 0.5), rng.range(-1.0, 0.5), rng.range(-1.0, 0.5));
        scene.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
    }
    let from = |k: usize| {
        let angle = k as f32 * std::f32::consts::FRAC_PI_2;
        Camera::look_at("bench", 4.0 * Vec3::new(angle.cos(), 0.3, angle.sin()), Vec3::ZERO, Vec3::Y, 480, 360, 0.9)
    };
    (scene, (0..VIEWS).map(from).collect())
}
