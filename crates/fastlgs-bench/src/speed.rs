//! `fastlgs-bench speed`: milliseconds of every pass for each device, number of Gaussians and image
//! size.
//!
//! All settings render and train the same views with learning rates of zero, so that all steps cost
//! the same. Kernels are compiled before the measurement starts.

use crate::plot;
use anyhow::{Result, bail};
use fastlgs::Run;
use fastlgs::query::parse_size;
use fastlgs_core::gaussians::{BASE_CHANNELS, channels};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, SceneFolder};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, Exposure, Step, StepOptions, TargetImage, View, pack};
use glam::{DMat3, DVec3, Vec3};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs-bench speed scenes/fox --gaussians 20000,50000 --size 270x480"
)]
pub struct Args {
    /// Trained scene. Default: a generated cloud of Gaussians.
    scene: Option<PathBuf>,
    /// Numbers of Gaussians, separated by commas. Gaussians of the scene are dropped, or repeated
    /// with a little noise.
    #[arg(long, value_delimiter = ',')]
    gaussians: Vec<usize>,
    /// Image sizes as WIDTHxHEIGHT, separated by commas. Default: the size of the scene's photos.
    #[arg(long, value_delimiter = ',', value_parser = parse_size)]
    size: Vec<(u32, u32)>,
    /// Devices to compare, separated by commas. Overrides --device and takes the same values.
    #[arg(long, value_delimiter = ',')]
    devices: Vec<String>,
    /// Folder for speed.json and the chart as speed.svg and speed.png.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// SH degree of colour, 0 to 3. Default: that of the scene.
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=3))]
    sh_degree: Option<u32>,
    /// Training steps to time in each setting.
    #[arg(long, default_value_t = 20)]
    steps: u32,
}

/// Largest number of views that are rendered in turn.
const VIEWS: usize = 4;
/// Rounds over the views for the times of single passes.
const ROUNDS: usize = 5;

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let (scene, cameras) = match &args.scene {
        Some(root) => {
            let folder = SceneFolder::open(root)?;
            (folder.gaussians()?, folder.cameras()?)
        }
        None => generated(run.seed),
    };
    if scene.is_empty() || cameras.is_empty() || args.steps == 0 {
        bail!("nothing to measure: the scene has no Gaussians or no views, or --steps is 0");
    }
    let counts = if args.gaussians.is_empty() {
        vec![scene.len()]
    } else {
        args.gaussians.clone()
    };
    let sizes = if args.size.is_empty() {
        vec![(cameras[0].width, cameras[0].height)]
    } else {
        args.size.clone()
    };
    let scene = scene
        .clone()
        .with_sh_degree(args.sh_degree.unwrap_or(scene.sh_degree));
    let devices = if args.devices.is_empty() {
        vec![run.device.to_owned()]
    } else {
        args.devices.clone()
    };
    let stride = cameras.len().div_ceil(VIEWS);
    let (mut tables, mut lines) = (Vec::new(), Vec::new());
    for device in &devices {
        let mut engine = fastlgs_raster::open_engine(device)?;
        let mut settings = Vec::new();
        for &count in &counts {
            let resized = resampled(&scene, count, run.seed);
            engine.set_state(&State::of(&resized))?;
            for &(w, h) in &sizes {
                let views: Vec<View> = cameras
                    .iter()
                    .step_by(stride)
                    .map(|c| View::new(&c.resized(w, h), count, resized.sh_degree))
                    .collect();
                settings.push(Setting {
                    gaussians: count,
                    size: (w, h),
                    row: measure_setting(engine.as_mut(), &views, args.steps)?,
                });
            }
        }
        for &(w, h) in &sizes {
            let points = settings
                .iter()
                .filter(|s| s.size == (w, h))
                .map(|s| (s.gaussians as f64, s.number("train_iterations_per_second")));
            lines.push(plot::Line {
                name: format!("{}, {w}x{h}", engine.name()),
                points: points.collect(),
            });
        }
        tables.push(json!({
            "adapter": engine.name(),
            "growth": growth(&settings),
            "settings": settings.into_iter().map(|s| s.row).collect::<Vec<_>>(),
        }));
    }
    let value = json!({
        "scene": args.scene,
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
        "sh_degree": scene.sh_degree,
        "peak_process_bytes": peak_process_bytes(),
        "devices": tables,
    });
    if let Some(folder) = &args.output {
        fastlgs_core::fs::write_json(&folder.join("speed.json"), &value)?;
        let axes = plot::Axes {
            title: "Training speed: colour, features and D-SSIM",
            x: "Gaussians",
            y: "iterations per second",
        };
        plot::save(
            folder,
            "speed",
            &plot::Lines {
                axes,
                lines: &lines,
            },
        )?;
    }
    Ok(value)
}

/// The figures of one number of Gaussians at one image size.
struct Setting {
    gaussians: usize,
    size: (u32, u32),
    row: Value,
}

impl Setting {
    fn number(&self, field: &str) -> f64 {
        self.row[field].as_f64().unwrap_or(f64::NAN)
    }
}

/// Fits the exponents a and b of time ~ Gaussians^a * pixels^b, by least squares over the
/// logarithms. An exponent is null if all settings have the same value.
fn growth(settings: &[Setting]) -> Value {
    let exponents = |field: &str| -> Value {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for s in settings {
            let x = DVec3::new(
                1.0,
                (s.gaussians as f64).ln(),
                (f64::from(s.size.0) * f64::from(s.size.1)).ln(),
            );
            normal += DMat3::from_cols(x * x.x, x * x.y, x * x.z);
            right += x * s.number(field).ln();
        }
        let several =
            |f: &dyn Fn(&Setting) -> f64| settings.iter().any(|s| f(s) != f(&settings[0]));
        let (by_count, by_size) = (
            several(&|s| s.gaussians as f64),
            several(&|s| f64::from(s.size.0) * f64::from(s.size.1)),
        );
        // A constant quantity gets the exponent zero.
        if !by_count {
            normal.y_axis.y += 1e12;
        }
        if !by_size {
            normal.z_axis.z += 1e12;
        }
        let fit = normal.inverse() * right;
        json!({ "gaussians": by_count.then_some(fit.y), "pixels": by_size.then_some(fit.z) })
    };
    json!({ "train_ms": exponents("train_ms"), "render_ms": exponents("render_ms") })
}

/// Returns the peak memory of this process in bytes. `None` where `/proc` does not exist.
pub fn peak_process_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim()
        .strip_suffix(" kB")?
        .trim()
        .parse::<u64>()
        .ok()
        .map(|kib| 1024 * kib)
}

/// Measures one number of Gaussians at one image size.
fn measure_setting(engine: &mut dyn Engine, views: &[View], steps: u32) -> Result<Value> {
    let pixels = views[0].pixels();
    let zero = [0.0; BASE_CHANNELS + 1];
    let degree = views[0].sh_degree();
    let frozen = Step::new(1, 14..BASE_CHANNELS, &zero);
    let step = Step::new(1, 0..channels(degree), &zero);
    let options = |channels: Channels| StepOptions {
        channels,
        lambda: 0.2,
        feature_weight: 1.0,
        exposure: Exposure::default(),
        depth_weight: 0.0,
    };
    // The step of `train --feature-mode train`.
    let full = options(Channels::Coupled);
    let target = TargetImage {
        size: views[0].size(),
        color: vec![pack([128; 3], true); pixels],
        feature: vec![pack([128; 3], true); pixels],
        depth: Vec::new(),
    };
    (0..views.len()).try_for_each(|id| engine.set_target(id, target.clone()))?;
    let (mut pairs, mut splats_per_pixel) = (0.0, 0.0);
    for (id, view) in views.iter().enumerate() {
        let frame = engine.render(*view, Channels::Both)?;
        pairs += f64::from(frame.pairs) / views.len() as f64;
        splats_per_pixel += frame.processed().iter().map(|w| f64::from(*w)).sum::<f64>()
            / (pixels * views.len()) as f64;
        engine.step(view.for_training(), id, &full, &step)?;
        engine.step(view.for_training(), id, &options(Channels::Color), &step)?;
        engine.step(
            view.for_training(),
            id,
            &options(Channels::Feature),
            &frozen,
        )?;
    }
    engine.losses()?;
    let mut timed = |channels: Channels, step: &Step| -> Result<f64> {
        let started = Instant::now();
        for k in 0..steps as usize {
            engine.step(
                views[k % views.len()].for_training(),
                k % views.len(),
                &options(channels),
                step,
            )?;
        }
        engine.losses()?;
        Ok(started.elapsed().as_secs_f64() / f64::from(steps))
    };
    let full_seconds = timed(Channels::Coupled, &step)?;
    let color_seconds = timed(Channels::Color, &step)?;
    let feature_seconds = timed(Channels::Feature, &frozen)?;
    let started = Instant::now();
    for k in 0..steps {
        engine.render(views[k as usize % views.len()], Channels::Both)?;
    }
    let render_seconds = started.elapsed().as_secs_f64() / f64::from(steps);
    let mut passes: BTreeMap<&str, f64> = BTreeMap::new();
    if engine.set_profiling(true) {
        // Other programs can only slow a pass down, so the fastest round counts.
        for _ in 0..ROUNDS {
            let mut round: BTreeMap<&str, f64> = BTreeMap::new();
            for (id, view) in views.iter().enumerate() {
                engine.step(view.for_training(), id, &full, &step)?;
                for (name, seconds) in engine.take_profile()? {
                    *round.entry(name).or_default() += 1e3 * seconds / views.len() as f64;
                }
            }
            for (name, ms) in round {
                passes
                    .entry(name)
                    .and_modify(|best| *best = best.min(ms))
                    .or_insert(ms);
            }
        }
        engine.set_profiling(false);
    }
    let memory = engine.memory();
    // Time of the blend pass. The whole frame where the device cannot profile passes.
    let blend_seconds = passes.get("blend").map_or(render_seconds, |ms| ms / 1e3);
    let evaluated = splats_per_pixel * pixels as f64 / blend_seconds;
    Ok(json!({
        "gaussians": engine.len(),
        "size": format!("{}x{}", views[0].size()[0], views[0].size()[1]),
        "pairs": pairs,
        "evaluated_per_pixel": splats_per_pixel,
        "evaluated_per_second": evaluated,
        "memory": memory,
        "train_iterations_per_second": 1.0 / full_seconds,
        "train_color_only_iterations_per_second": 1.0 / color_seconds,
        "train_feature_only_iterations_per_second": 1.0 / feature_seconds,
        "render_ms": 1e3 * render_seconds,
        "train_ms": 1e3 * full_seconds,
        "train_pass_ms": passes,
    }))
}

/// Returns exactly `count` Gaussians with the distribution of the scene's.
fn resampled(scene: &Gaussians, count: usize, seed: u64) -> Gaussians {
    let mut rng = Rng::new(seed, "bench resampling");
    let mut order: Vec<usize> = (0..scene.len()).collect();
    rng.shuffle(&mut order);
    let mut chosen: Vec<usize> = (0..count).map(|i| order[i % order.len()]).collect();
    // Training keeps Gaussians in the order of the scene.
    chosen.sort_unstable();
    let mut out = scene.select(&chosen);
    for i in (1..count).filter(|&i| chosen[i] == chosen[i - 1]) {
        // Moves each copy by about the size of the Gaussian.
        let noise = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        out.means[i] += noise * out.log_scales[i].max_element().exp().min(1.0);
    }
    out
}

/// Returns a random cloud of 50,000 anisotropic Gaussians and cameras on four sides of it.
fn generated(seed: u64) -> (Gaussians, Vec<Camera>) {
    let mut rng = Rng::new(seed, "bench cloud");
    let mut scene = Gaussians::default();
    for i in 0..50_000 {
        let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        scene.push_sphere(
            mean,
            0.02,
            rng.range(0.1, 0.95),
            [rng.uniform(), rng.uniform(), rng.uniform()],
        );
        scene.log_scales[i] += Vec3::new(
            rng.range(-1.0, 0.5),
            rng.range(-1.0, 0.5),
            rng.range(-1.0, 0.5),
        );
        scene.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
    }
    let from = |k: usize| {
        let angle = k as f32 * std::f32::consts::FRAC_PI_2;
        Camera::look_at(
            "bench",
            4.0 * Vec3::new(angle.cos(), 0.3, angle.sin()),
            Vec3::ZERO,
            Vec3::Y,
            480,
            360,
            0.9,
        )
    };
    (scene, (0..VIEWS).map(from).collect())
}
