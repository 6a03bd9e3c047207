//! `fastlgs train`: colour and semantic field together (paper, training features for Gaussians).

use super::objects;
use crate::{Outcome, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::is_held_out;
use fastlgs_core::{Camera, Gaussians, SceneFolder, image_io, ply};
use fastlgs_grid::mapping::PaperConfig;
use fastlgs_grid::{Grid, consensus, whole};
use fastlgs_raster::{Target, TrainConfig, Trainer, init};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs train scenes/fox --preset quick")]
pub struct Args {
    /// Scene folder that `preprocess` made.
    scene: PathBuf,
    /// quick: 2,000 iterations; standard: 7,000; paper: 30,000.
    #[arg(long, default_value = "standard", value_parser = ["quick", "standard", "paper"])]
    preset: String,
    /// Iterations, instead of the preset's.
    #[arg(long)]
    iterations: Option<u32>,
    /// Most Gaussians.
    #[arg(long, default_value_t = 60_000)]
    budget: usize,
    /// Start from an existing 3DGS scene instead of points.
    #[arg(long, value_name = "FILE")]
    init_ply: Option<PathBuf>,
    /// How masks become objects: `global` (the views vote over the trained Gaussians) or `paper` (Algorithm 1).
    #[arg(long, default_value = "global", value_parser = ["global", "paper"])]
    mapping: String,
    /// How Gaussians get their codes: `lift` (one pass of votes) or `train` (gradient descent, as in the paper).
    #[arg(long, default_value = "lift", value_parser = ["lift", "train"])]
    feature_mode: String,
    /// Paper mapping: fewest key-point pairs that make two masks one object.
    #[arg(long, default_value_t = PaperConfig::default().tau)]
    tau: u32,
    /// Paper mapping: least similarity that makes two masks one object.
    #[arg(long, default_value_t = PaperConfig::default().theta)]
    theta: f32,
    /// Paper mapping: weight of colour in the similarity.
    #[arg(long, default_value_t = PaperConfig::default().alpha)]
    alpha: f32,
    /// Global mapping: share of the views that must show two regions in one mask to join them.
    #[arg(long, default_value_t = consensus::Config::default().agreement)]
    agreement: f32,
    /// Global mapping, offline segmenter: likeness of meaning and masks, 0 to 1, from which touching regions are one object.
    #[arg(long, default_value_t = whole::LIKENESS)]
    likeness: f32,
    /// Weight of the feature loss.
    #[arg(long, default_value_t = 1.0)]
    feature_weight: f32,
    /// Let the feature loss move geometry as well.
    #[arg(long)]
    feature_moves_geometry: bool,
    /// Continue from the last checkpoint.
    #[arg(long)]
    resume: bool,
}

/// Fewest triangulated points worth starting from.
const FEW_POINTS: usize = 500;

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let by_descent = args.feature_mode == "train";
    if by_descent && args.mapping == "global" {
        bail!("--feature-mode train needs the objects before training: add --mapping paper");
    }
    let folder = SceneFolder::open(&args.scene)?;
    let mut manifest = folder.manifest()?;
    let cameras = folder.cameras()?;
    let training = manifest.training(&cameras);
    let paper = if args.mapping == "paper" {
        let config = PaperConfig { tau: args.tau, theta: args.theta, alpha: args.alpha };
        Some(objects::by_algorithm_1(&folder, &training, &config, common.seed)?)
    } else {
        None
    };
    let codes = paper.as_ref().filter(|_| by_descent).map(|p| &p.grid);
    let targets = training.iter().map(|c| target(&folder, c, codes)).collect::<Result<Vec<_>>>()?;
    let first = first_gaussians(args, &folder, &training, common.seed)?;
    let preset = match args.preset.as_str() {
        "quick" => 2_000,
        "standard" => 7_000,
        _ => 30_000,
    };
    let config = TrainConfig {
        iterations: args.iterations.unwrap_or(preset),
        seed: common.seed,
        budget: args.budget,
        feature_weight: if by_descent { args.feature_weight } else { 0.0 },
        feature_moves_geometry: args.feature_moves_geometry,
        ..TrainConfig::default()
    };
    let engine = fastlgs_raster::open_engine(&common.device)?;
    let bar = ui::bar(common, u64::from(config.iterations), "training");
    let mut trainer = Trainer::new(engine, &first, targets, config)?;
    let checkpoint = folder.root.join("checkpoints/train");
    if args.resume && !trainer.resume(&checkpoint)? {
        tracing::warn!("{}: no checkpoint to resume from; starting anew", checkpoint.display());
    }
    let result = trainer.run(Some(&checkpoint), |p| {
        bar.set_position(u64::from(p.iteration));
        let loss = 0.8 * p.losses.color_l1 + 0.2 * (1.0 - p.losses.color_ssim);
        bar.set_message(format!("loss {loss:.4} {:.1} dB {:.0}k G", p.psnr, p.gaussians as f64 / 1000.0));
        if p.iteration % 200 == 0 {
            tracing::info!(iteration = p.iteration, loss, psnr = p.psnr, feature_l1 = p.losses.feature_l1, gaussians = p.gaussians);
        }
    })?;
    bar.finish_and_clear();

    let mut scene = trainer.gaussians()?;
    let started = Instant::now();
    let grid = match paper {
        Some(found) if by_descent => {
            for (id, feature) in scene.object_ids.iter_mut().zip(&scene.features) {
                *id = found.grid.nearest(*feature).map_or(0, |(id, _)| id);
            }
            found.grid
        }
        Some(found) => {
            objects::lift(&mut scene, &training, &found.maps, &found.grid);
            found.grid
        }
        None => {
            let consensus = consensus::Config { agreement: args.agreement, ..consensus::Config::default() };
            let config = objects::Config { consensus, likeness: args.likeness };
            objects::by_consensus(&mut scene, &folder, &training, &config, common)?
        }
    };
    let mapping_seconds = started.elapsed().as_secs_f64();
    grid.save(&folder)?;
    ply::write(&folder.ply_path(), &scene).context("the trained scene cannot be written")?;
    let held_out: Vec<&Camera> = cameras.iter().enumerate().filter(|(i, _)| is_held_out(*i, manifest.holdout)).map(|c| c.1).collect();
    let mut psnr = Vec::new();
    for camera in held_out {
        let frame = trainer.render(camera)?;
        let photo = image_io::to_planar(&folder.photo(&camera.name)?);
        psnr.push(fastlgs_core::metrics::psnr(frame.channels(0, 3), &photo));
    }
    let mean = psnr.iter().sum::<f64>() / psnr.len().max(1) as f64;
    let value = serde_json::json!({
        "scene": args.scene,
        "preset": args.preset,
        "mapping": args.mapping,
        "feature_mode": args.feature_mode,
        "objects": grid.objects.len(),
        "mapping_seconds": mapping_seconds,
        "iterations": result.iterations,
        "seconds": result.seconds,
        "iterations_per_second": result.iterations_per_second,
        "gaussians": result.gaussians,
        "size": format!("{}x{}", cameras[0].width, cameras[0].height),
        "psnr_held_out": if psnr.is_empty() { None } else { Some(mean) },
        "adapter": result.adapter,
    });
    manifest.seconds.insert("train".to_owned(), result.seconds);
    manifest.notes.insert("train".to_owned(), value.clone());
    folder.save_manifest(&manifest)?;
    // Checkpoints serve a broken run only.
    let _ = std::fs::remove_dir_all(folder.root.join("checkpoints"));
    report::give(common, &value)?;
    Ok(Outcome::Done)
}

/// Photo and, where features are trained, code map of a view; unlabelled pixels do not count in the feature loss.
fn target(folder: &SceneFolder, camera: &Camera, codes: Option<&Grid>) -> Result<Target> {
    let mut image = image_io::to_planar(&folder.photo(&camera.name)?);
    let n = (camera.width * camera.height) as usize;
    if image.len() != 3 * n {
        bail!("{}: photo and camera differ in size; run 'fastlgs preprocess' again", folder.photo_path(&camera.name).display());
    }
    match codes {
        None => image.resize(6 * n, -1.0),
        Some(grid) => {
            let ids = folder.objects(&camera.name)?.labels;
            let code = |id: u16, k: usize| grid.objects.get(usize::from(id).wrapping_sub(1)).map_or(-1.0, |o| o.code[k]);
            for k in 0..3 {
                image.extend(ids.iter().map(|id| code(*id, k)));
            }
        }
    }
    Ok(Target { camera: camera.clone(), image })
}

/// The given PLY, else the scene's points, else random ones.
fn first_gaussians(args: &Args, folder: &SceneFolder, training: &[Camera], seed: u64) -> Result<Gaussians> {
    if let Some(path) = &args.init_ply {
        return Ok(ply::read(path)?);
    }
    let mut rng = Rng::new(seed, "init");
    let mut points = folder.points()?;
    if points.len() < FEW_POINTS {
        tracing::warn!("only {} points are known; starting from random ones as well", points.len());
        points.extend(init::random_points(training, 10_000, &mut rng));
    }
    // More points than half the budget would leave no room to grow where it matters.
    rng.shuffle(&mut points);
    points.truncate((args.budget / 2).max(1));
    Ok(init::from_points(&points))
}
