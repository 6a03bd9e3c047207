//! `fastlgs train`: colour and semantic field together (paper, training features for Gaussians).

use super::objects;
use super::preprocess::BRIGHTNESS_SPREAD;
use super::serve::{DEFAULT_BIND, parse_bind};
use crate::serve::{Live, Point, Server};
use crate::{Outcome, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, SceneFolder, image_io, ply};
use fastlgs_grid::mapping::PaperConfig;
use fastlgs_grid::{Grid, consensus, tree};
use fastlgs_raster::{Budget, Channels, Strategy, Target, TargetImage, TrainConfig, Trainer, init, pack};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
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
    /// Gaussians: `auto` (as many as pay for themselves; at most 200,000 with the preset quick, 300,000 with standard, a
    /// million with paper), or exactly how many there may be.
    #[arg(long, default_value = "auto", value_parser = parse_budget)]
    budget: BudgetChoice,
    /// How their number is controlled: `classic` (clone, split, prune, opacity reset) or `mcmc` (relocation and noise).
    #[arg(long, default_value = "classic", value_parser = ["classic", "mcmc"])]
    strategy: String,
    /// Highest spherical-harmonic degree of colour, 0 to 3; by default that of --init-ply, else the preset's.
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=3))]
    sh_degree: Option<u32>,
    /// Anti-aliasing by the 2-D Mip filter.
    #[arg(long)]
    antialias: bool,
    /// Colour behind everything: three numbers from 0 to 1 separated by commas, or `learn`.
    #[arg(long, default_value = "0,0,0", value_parser = parse_background)]
    background: Background,
    /// Learn an affine exposure for each training photo: `on`, `off`, or `auto`, which does where their brightness varies.
    #[arg(long, default_value = "auto", num_args = 0..=1, default_missing_value = "on", require_equals = true, value_parser = ["auto", "on", "off"])]
    exposure: String,
    /// Keep geometry and colour as --init-ply gives them; train features only.
    #[arg(long, requires = "init_ply")]
    freeze: bool,
    /// Start from an existing 3DGS scene instead of points.
    #[arg(long, value_name = "FILE")]
    init_ply: Option<PathBuf>,
    /// How masks become objects: `global` (the views vote over the trained Gaussians), `paper` (Algorithm 1), or `keep` (those that
    /// the scene has; with --init-ply of the trained scene, either feature mode refines what the other made).
    #[arg(long, default_value = "global", value_parser = ["global", "paper", "keep"])]
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
    /// Paper mapping: what is compared beside the embeddings, separated by commas (the paper's ablation).
    #[arg(long, value_delimiter = ',', default_value = "keypoints,color", value_parser = ["keypoints", "color", "none"])]
    cues: Vec<String>,
    /// Global mapping: share of the views that must show two regions in one mask to join them.
    #[arg(long, default_value_t = consensus::Config::default().agreement)]
    agreement: f32,
    /// Global mapping: how well the views' masks must fit an object, as their mean IoU.
    #[arg(long, default_value_t = tree::Config::default().min_support)]
    support: f32,
    /// Global mapping: smallest object, as the mean share of the pixels of the views that show it.
    #[arg(long, default_value_t = tree::Config::default().min_share)]
    min_share: f32,
    /// Measure the held-out PSNR every N iterations and report it over the seconds of training.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    curve: Option<u32>,
    /// Weight of the feature loss.
    #[arg(long, default_value_t = 1.0)]
    feature_weight: f32,
    /// Let the feature loss move geometry as well.
    #[arg(long)]
    feature_moves_geometry: bool,
    /// Continue from the last checkpoint.
    #[arg(long)]
    resume: bool,
    /// Show the scene in the browser while it grows, with its curves; when it is trained, questions are answered until Ctrl-C.
    #[arg(long, value_name = "IP:PORT", num_args = 0..=1, require_equals = true, default_missing_value = DEFAULT_BIND, value_parser = parse_bind)]
    serve: Option<SocketAddr>,
}

/// Difference of two photos in stops from which exposures are learned.
const VARYING: f64 = 0.15;

/// Fewest triangulated points worth starting from.
const FEW_POINTS: usize = 500;

/// Iterations from which it pays to find out first which kernels the device is fastest with.
const WORTH_TUNING: u32 = 500;

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let by_descent = args.feature_mode == "train";
    if by_descent && args.mapping == "global" {
        bail!(
            "--feature-mode train needs the objects before training: add --mapping paper, or keep those of a trained scene (--mapping keep)"
        );
    }
    let folder = SceneFolder::open(&args.scene)?;
    let mut manifest = folder.manifest()?;
    let cameras = folder.cameras()?;
    let training = manifest.training(&cameras);
    let known = match args.mapping.as_str() {
        "paper" => {
            let cue = |name: &str| args.cues.iter().any(|c| c == name);
            let alpha = if cue("color") { args.alpha } else { 0.0 };
            let config = PaperConfig { tau: args.tau, theta: args.theta, alpha, key_points: cue("keypoints") };
            Some(objects::by_algorithm_1(&folder, &training, &config, common.seed)?)
        }
        "keep" => Some(objects::kept(&folder, &training)?),
        _ => None,
    };
    let codes = known.as_ref().filter(|_| by_descent);
    let targets = training.iter().map(|c| target(&folder, c, codes, &args.background)).collect::<Result<Vec<_>>>()?;
    let held_out = manifest.held_out(&cameras).iter().map(|c| target(&folder, c, None, &args.background)).collect::<Result<Vec<_>>>()?;
    let (preset, preset_degree, preset_most) = match args.preset.as_str() {
        "quick" => (2_000, 2, 200_000),
        "standard" => (7_000, 2, 300_000),
        _ => (30_000, 3, 1_000_000),
    };
    let budget = args.budget.map_or(Budget::Auto(preset_most), Budget::Fixed);
    let first = first_gaussians(args, &folder, &training, budget, common.seed)?;
    if args.freeze && !by_descent {
        bail!(
            "--freeze trains features: add --feature-mode train and --mapping paper or keep; or, to lift objects only, use --iterations 0"
        );
    }
    let channels = match (args.freeze, by_descent, args.feature_moves_geometry) {
        (true, ..) => Channels::Feature,
        (_, false, _) => Channels::Color,
        (_, true, false) => Channels::Both,
        (_, true, true) => Channels::Coupled,
    };
    let config = TrainConfig {
        iterations: args.iterations.unwrap_or(preset),
        seed: common.seed,
        budget,
        strategy: if args.strategy == "mcmc" { Strategy::Mcmc } else { Strategy::Classic },
        channels,
        sh_degree: args.sh_degree.unwrap_or(if args.init_ply.is_some() { first.sh_degree } else { preset_degree }),
        first_degree: first.sh_degree,
        feature_weight: args.feature_weight,
        antialias: args.antialias,
        background: args.background.color,
        learn_background: args.background.learn,
        exposure: match args.exposure.as_str() {
            "auto" => manifest.notes.get(BRIGHTNESS_SPREAD).and_then(|s| s.as_f64()).is_some_and(|stops| stops >= VARYING),
            choice => choice == "on",
        },
        ..TrainConfig::default()
    };
    if config.iterations >= WORTH_TUNING {
        fastlgs_raster::tuning::tune(&common.device, false)?;
    }
    let engine = fastlgs_raster::open_engine(&common.device)?;
    let bar = ui::bar(common, u64::from(config.iterations), "training");
    let mut trainer = Trainer::new(engine, &first, targets, config.clone())?;
    let checkpoint = folder.root.join("checkpoints/train");
    if args.resume && !trainer.resume(&checkpoint)? {
        tracing::warn!("{}: no checkpoint to resume from; starting anew", checkpoint.display());
    }
    let watched = args.serve.map(|bind| watch(&folder, bind, &config, &first)).transpose()?;
    let mut curve = Vec::new();
    let result = trainer.run(Some(&checkpoint), |p, trainer| {
        let mut psnr_held_out = None;
        if args.curve.is_some_and(|every| p.iteration % every.next_multiple_of(20) == 0) {
            let psnr = trainer.quality(&held_out, None)?;
            psnr_held_out = psnr;
            tracing::info!(iteration = p.iteration, seconds = p.seconds, psnr_held_out = psnr, gaussians = p.gaussians, "curve");
            curve.push(serde_json::json!({ "iteration": p.iteration, "seconds": p.seconds, "psnr": psnr, "gaussians": p.gaussians }));
        }
        bar.set_position(u64::from(p.iteration));
        let loss = 0.8 * p.losses.color_l1 + 0.2 * (1.0 - p.losses.color_ssim);
        bar.set_message(format!("loss {loss:.4} {:.1} dB {:.0}k G", p.psnr, p.gaussians as f64 / 1000.0));
        if let Some((live, _)) = &watched {
            let (iteration, seconds, psnr, gaussians) = (p.iteration, p.seconds, p.psnr, p.gaussians);
            if live.report(Point { iteration, seconds, loss, psnr, psnr_held_out, gaussians }) {
                live.picture(&trainer.gaussians()?);
            }
        }
        if p.iteration % 200 == 0 {
            tracing::info!(iteration = p.iteration, loss, psnr = p.psnr, feature_l1 = p.losses.feature_l1, gaussians = p.gaussians);
        }
        Ok(())
    })?;
    bar.finish_and_clear();

    let degree = trainer.needed_degree()?;
    let psnr = trainer.quality(&held_out, Some(degree))?;
    let mut scene = trainer.gaussians()?.with_sh_degree(degree);
    if let Some((live, _)) = &watched {
        live.finish(&scene);
    }
    let started = Instant::now();
    let mut summary = None;
    let grid = match known {
        Some(found) if by_descent => {
            for (id, feature) in scene.object_ids.iter_mut().zip(&scene.features) {
                *id = found.nearest(*feature).map_or(0, |(id, _)| id);
            }
            found
        }
        Some(found) => {
            objects::lift(&mut scene, &folder, &training, &found)?;
            found
        }
        None => {
            // Regions may be smaller than objects, which are made of them.
            let of_regions = consensus::Config::default().min_share * args.min_share / tree::Config::default().min_share;
            let consensus = consensus::Config { agreement: args.agreement, min_share: of_regions, ..consensus::Config::default() };
            let objects = tree::Config { min_support: args.support, min_share: args.min_share, ..tree::Config::default() };
            let config = objects::Config { consensus, objects };
            let (grid, found) = objects::by_consensus(&mut scene, &folder, &training, &config, common)?;
            summary = Some(found);
            grid
        }
    };
    let mapping_seconds = started.elapsed().as_secs_f64();
    grid.save(&folder)?;
    ply::write(&folder.ply_path(), &scene).context("the trained scene cannot be written")?;
    let value = serde_json::json!({
        "scene": args.scene,
        "preset": args.preset,
        "mapping": args.mapping,
        "feature_mode": args.feature_mode,
        "objects": grid.objects.len(),
        "mapping_seconds": mapping_seconds,
        "mapping_summary": summary,
        "iterations": result.iterations,
        "seconds": result.seconds,
        "iterations_per_second": result.iterations_per_second,
        "gaussians": result.gaussians,
        "removals": result.removals,
        "sh_degree": scene.sh_degree,
        "exposure": config.exposure,
        "antialias": config.antialias,
        "background": &result.background[..3],
        "size": format!("{}x{}", cameras[0].width, cameras[0].height),
        "psnr_held_out": psnr,
        "curve": curve,
        "adapter": result.adapter,
    });
    manifest.seconds.insert("train".to_owned(), result.seconds);
    manifest.notes.insert("train".to_owned(), value.clone());
    folder.save_manifest(&manifest)?;
    // Checkpoints serve a broken run only.
    let _ = std::fs::remove_dir_all(folder.root.join("checkpoints"));
    report::give(common, &value)?;
    if let Some((_, server)) = watched {
        server.open_scene(&common.device, None)?;
        server.wait()?;
    }
    Ok(Outcome::Done)
}

/// Starts the page that shows how the scene grows.
fn watch(folder: &SceneFolder, bind: SocketAddr, config: &TrainConfig, first: &Gaussians) -> Result<(Arc<Live>, Server)> {
    let live = Arc::new(Live::new(config.iterations, first, config.antialias, config.background));
    let server = Server::start(folder, bind, Some(live.clone()))?;
    server.set_focus(&first.means);
    // Standard output is the report's.
    eprintln!("watch it at {}", server.url);
    Ok((live, server))
}

/// Photo and, where features are trained, code map of a view. Pixels that the view's mask blackens do not count, nor do
/// unlabelled ones in the feature loss; transparent ones show the background.
fn target(folder: &SceneFolder, camera: &Camera, codes: Option<&Grid>, background: &Background) -> Result<Target> {
    let photo = folder.photo(&camera.name)?;
    if (photo.width(), photo.height()) != (camera.width, camera.height) {
        bail!("{}: photo and camera differ in size; run 'fastlgs preprocess' again", folder.photo_path(&camera.name).display());
    }
    let mask = |path: PathBuf| path.is_file().then(|| image_io::load_gray(&path)).transpose();
    let (alpha, ignore) = (mask(folder.alpha_path(&camera.name))?, mask(folder.ignore_path(&camera.name))?);
    if alpha.is_some() && background.learn {
        bail!("--background learn: the photo of '{}' is transparent, so that its background must be given", camera.name);
    }
    let color = photo.enumerate_pixels().map(|(x, y, p)| {
        let covered = alpha.as_ref().map_or(255, |a| a.get_pixel(x, y)[0]);
        let over = |c: usize| {
            let share = f32::from(covered) / 255.0;
            (f32::from(p[c]) * share + 255.0 * background.color[c] * (1.0 - share) + 0.5) as u8
        };
        pack([over(0), over(1), over(2)], ignore.as_ref().is_none_or(|m| m.get_pixel(x, y)[0] >= 128))
    });
    let color = color.collect();
    let code = |grid: &Grid, id: u16| match grid.objects.get(usize::from(id).wrapping_sub(1)) {
        Some(object) => pack(object.code.to_array().map(|v| (v * 255.0).round() as u8), true),
        None => pack([0; 3], false),
    };
    let feature = match codes {
        None => Vec::new(),
        Some(grid) => folder.objects(&camera.name)?.labels.iter().map(|id| code(grid, *id)).collect(),
    };
    Ok(Target { camera: camera.clone(), image: TargetImage { size: [camera.width, camera.height], color, feature } })
}

/// Nothing for `auto`.
type BudgetChoice = Option<usize>;

/// Parses `auto` or a number.
fn parse_budget(text: &str) -> Result<BudgetChoice, String> {
    if text == "auto" {
        return Ok(None);
    }
    text.parse().ok().filter(|n| *n > 0).map(Some).ok_or_else(|| format!("'{text}' is neither 'auto' nor a number of Gaussians"))
}

/// What lies behind everything.
#[derive(Clone, Debug)]
struct Background {
    color: [f32; 3],
    learn: bool,
}

/// Parses `0,0.5,1` or `learn`.
fn parse_background(text: &str) -> Result<Background, String> {
    if text == "learn" {
        return Ok(Background { color: [0.5; 3], learn: true });
    }
    let values: Vec<f32> = text.split(',').filter_map(|v| v.trim().parse().ok()).filter(|v| (0.0..=1.0).contains(v)).collect();
    let color = <[f32; 3]>::try_from(values).map_err(|_| format!("'{text}' is neither 'learn' nor three numbers from 0 to 1"))?;
    Ok(Background { color, learn: false })
}

/// The given PLY, else the scene's points, else random ones.
fn first_gaussians(args: &Args, folder: &SceneFolder, training: &[Camera], budget: Budget, seed: u64) -> Result<Gaussians> {
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
    points.truncate((budget.most() / 2).max(1));
    Ok(init::from_points(&points))
}
