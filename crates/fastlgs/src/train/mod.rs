//! Training: optimises Gaussians with colour and features, then finds their objects (paper,
//! training features for Gaussians).

mod config;
mod init;
mod mask_supervision;
mod report;
mod settings;

use crate::error::{Context, bail};
use crate::output::SceneLock;
use crate::progress::{Message, TrainStep};
use crate::staged::StagedOutput;
use crate::{Result, Run, checkpoints, objects, preprocess, transparent};
pub use config::{
    Align, Background, Borders, Cue, Exposures, FeatureMode, Mapping, Preset, TrainConfig,
};
use fastlgs_core::{Gaussians, SceneFolder, ply};
use fastlgs_grid::Grid;
use fastlgs_grid::codebook::Codebook;
use fastlgs_raster::Trainer;
pub(crate) use init::target;
pub use report::{CurvePoint, TrainReport};
use settings::settings;
use std::time::Instant;

/// Key of the manifest note with the inputs and options of `make`.
pub(crate) const MADE: &str = "made";

/// Files of the scene that training replaces, besides the manifest and the object maps.
const REPLACED: [&str; 4] = [
    "grid.json",
    "grid.safetensors",
    "scene.ply",
    "cameras/trained.json",
];

/// Trains the scene `config.scene`: writes its Gaussians, object table and object maps.
///
/// # Errors
/// Contradictory options, a scene that was not preprocessed, a failing device, or a cancelled run.
/// The earlier scene then stays unchanged, and `config.resume` continues from the last checkpoint.
pub fn train(config: &TrainConfig, run: &Run) -> Result<TrainReport> {
    train_locked(config, &SceneLock::of_scene(&config.scene, "train")?, run)
}

/// Trains a scene that the caller has locked.
pub(crate) fn train_locked(
    config: &TrainConfig,
    _lock: &SceneLock,
    run: &Run,
) -> Result<TrainReport> {
    if config.preset == Preset::LikePaper && config.mapping == Mapping::Keep {
        bail!(
            "preset 'like-paper' finds objects by Algorithm 1 and cannot keep existing ones: omit mapping 'keep', or choose another preset"
        );
    }
    let config = &config.resolved();
    let trains_features = config.feature_mode == FeatureMode::Train;
    if trains_features && config.mapping == Mapping::Global {
        bail!(
            "--feature-mode train needs the objects before training: add --mapping paper, or keep those of a trained scene (--mapping keep)"
        );
    }
    let folder = SceneFolder::open(&config.scene)?;
    let mut manifest = folder.manifest()?;
    let given = folder.initial_cameras()?;
    // Gaussians of an earlier training belong to its cameras, which alignment may have moved.
    let mut cameras = if config.init.is_some() {
        folder.cameras()?
    } else {
        given.clone()
    };
    let mut training = manifest.training(&cameras);
    let prior_objects = match config.mapping {
        Mapping::Paper => Some(objects::by_algorithm_1(
            &folder,
            &training,
            &config.paper(&manifest.encoder),
            run,
        )?),
        Mapping::Keep => Some(objects::load_kept(&folder, &training)?),
        Mapping::Global => None,
    };
    let codes = prior_objects.as_ref().filter(|_| trains_features);
    let light = preprocess::Brightness::from_manifest(&manifest)?;
    let config = &init::with_earlier_settings(config, &folder, &manifest)?;
    let background = config.background.unwrap_or_default();
    let targets = init::targets(
        &folder,
        &training,
        codes.map(init::codes).as_ref(),
        &background,
        |name| light.gain(name),
    );
    let held_out = init::targets(
        &folder,
        &manifest.held_out(&cameras),
        None,
        &background,
        |_| [1.0; 3],
    );
    held_out.check()?;
    let mut first = init::gaussians(config, &folder, &targets, run)?;
    // Gaussians of transparent objects have no colour to train.
    transparent::take(&mut first);
    let kept_clear = if config.mapping == Mapping::Keep {
        transparent::take(&mut folder.gaussians()?)
    } else {
        Gaussians::default()
    };
    let free = init::free_space(config, &folder, &training, &first)?;
    if let Some(codes) = codes.filter(|_| config.init.is_none() || config.mapping != Mapping::Keep)
    {
        // Start from the objects on which most views agree. From elsewhere, descent ends between
        // the codes of views that disagree.
        objects::lift(&mut first, &folder, &training, codes, config.antialias)?;
    }
    if config.freeze && !trains_features {
        bail!(
            "freeze trains features only: set feature_mode to train, and mapping to paper or keep; to lift objects without training, set iterations to 0"
        );
    }
    let settings = settings(config, &first, &targets, &manifest, run.seed)?;
    let device = fastlgs_raster::choice(run.device);
    let engine = fastlgs_raster::open_engine(&device.device)?;
    let work = run.work("train", u64::from(settings.iterations));
    let mut trainer = Trainer::new(engine, &first, targets, settings.clone())?;
    trainer.set_free_space(free);
    let checkpoint = checkpoints::path(&folder);
    if config.resume && !trainer.resume(&checkpoint)? {
        run.warn(&format!(
            "{}: there is no checkpoint to resume from; training starts from the beginning",
            checkpoint.display()
        ));
    }
    if trainer.is_coupled() {
        mask_supervision::resume_targets(&mut trainer, &folder)?;
    }
    run.progress.on_message(Message::TrainingBegins(&first));
    let (mut curve, mut mapping_seconds) = (Vec::new(), 0.0);
    let result = trainer.run(Some(&checkpoint), |p, trainer| {
        work.check()?;
        if settings.couples_at == Some(p.iteration) {
            let started = Instant::now();
            mask_supervision::begin(trainer, &folder, &config.global(), run)?;
            mapping_seconds += started.elapsed().as_secs_f64();
        }
        let loss = 0.8 * p.losses.color_l1 + 0.2 * (1.0 - p.losses.color_ssim);
        let (iteration, seconds, psnr, gaussians) = (p.iteration, p.seconds, p.psnr, p.gaussians);
        let mut step = TrainStep {
            iteration,
            seconds,
            loss,
            psnr,
            psnr_held_out: None,
            gaussians,
        };
        if config
            .curve
            .is_some_and(|every| iteration % every.next_multiple_of(20) == 0)
        {
            step.psnr_held_out = trainer.quality(&held_out, None)?;
            tracing::info!(
                iteration,
                seconds,
                psnr_held_out = step.psnr_held_out,
                gaussians,
                "curve"
            );
            curve.push(CurvePoint::from(step));
        }
        run.progress.on_message(Message::Trained {
            step,
            total: settings.iterations,
            scene: &|| Ok(trainer.gaussians()?),
        });
        if iteration % 200 == 0 {
            tracing::info!(
                iteration,
                loss,
                psnr,
                feature_l1 = p.losses.feature_l1,
                gaussians
            );
        }
        Ok::<_, crate::Error>(())
    })?;
    drop(work);

    training = trainer.cameras();
    for camera in &training {
        cameras
            .iter_mut()
            .filter(|c| c.name == camera.name)
            .for_each(|c| *c = camera.clone());
    }
    let aligned = cameras != given;
    let degree = trainer.needed_degree()?;
    let psnr = trainer.quality(&held_out, Some(degree))?;
    let mut scene = trainer.gaussians()?.with_sh_degree(degree);
    run.progress.on_message(Message::TrainingEnds(&scene));
    let started = Instant::now();
    let mut summary = None;
    let grid = match prior_objects {
        Some(found) if trains_features => {
            if !found.overlaps.0.is_empty() {
                run.warn("a trained feature keeps only the smallest of overlapping objects and the objects that contain it; set feature_mode to lift to keep them all");
            }
            nearest_codes(&mut scene, &found);
            found
        }
        Some(found) => {
            scene.append(kept_clear.with_sh_degree(degree));
            objects::lift(&mut scene, &folder, &training, &found, config.antialias)?;
            transparent::keep_owned(&mut scene);
            found
        }
        None => {
            let mapped = transparent::map(&mut scene, &folder, &training, &config.global(), run)?;
            let (grid, found) =
                objects::embed_objects(&mut scene, &folder, &training, mapped, run)?;
            summary = Some(found);
            grid
        }
    };
    mapping_seconds += started.elapsed().as_secs_f64();
    let staged = StagedOutput::new(&folder, "train")?;
    grid.save(&staged.folder)?;
    staged
        .folder
        .save_trained_cameras(aligned.then_some(&cameras))?;
    ply::write(&staged.folder.ply_path(), &scene).context("the trained scene cannot be written")?;
    let [r, g, b, ..] = result.background;
    let report = TrainReport {
        scene: config.scene.clone(),
        preset: config.preset,
        mapping: config.mapping,
        feature_mode: config.feature_mode,
        objects: grid.objects.len(),
        mapping_seconds,
        mapping_summary: summary,
        iterations: result.iterations,
        seconds: result.seconds,
        iterations_per_second: result.iterations_per_second,
        gaussians: scene.len(),
        clear: transparent::count(&scene),
        removals: result.removals,
        sh_degree: scene.sh_degree,
        exposure: settings.exposure,
        alignment_gain: result.alignment_gain,
        aligned,
        borders: settings.couples_at.is_some() && result.iterations > 0,
        antialias: settings.antialias,
        background: [r, g, b],
        size: format!("{}x{}", cameras[0].width, cameras[0].height),
        psnr_held_out: psnr,
        curve,
        adapter: result.adapter,
        device,
    };
    manifest.seconds.insert("train".to_owned(), result.seconds);
    // The note of `make` is invalid now; `make` writes it again if it called this function.
    manifest.notes.remove(MADE);
    report.note(&mut manifest)?;
    staged.publish(&folder, &REPLACED, [], &manifest)?;
    objects::mark_maps_finished(&folder);
    // Only an interrupted run needs its checkpoints.
    checkpoints::forget(&folder);
    Ok(report)
}

/// Assigns every Gaussian the object whose code is nearest to its trained feature. Gaussians nearer
/// to the origin get none: pixels outside of all masks are trained towards the origin.
fn nearest_codes(scene: &mut Gaussians, grid: &Grid) {
    let codebook = Codebook::of(grid);
    scene.object_ids = scene
        .features
        .iter()
        .map(|feature| codebook.owner(*feature).0)
        .collect();
}
