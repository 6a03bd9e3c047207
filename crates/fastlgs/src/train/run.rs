//! Trains the Gaussians of a scene.

use super::{CurvePoint, Inputs, Mapping, init, mask_supervision};
use crate::progress::{Message, TrainStep};
use crate::train::settings::settings;
use crate::{Result, Run, checkpoints, objects, stop_point, transparent};
use fastlgs_core::{Camera, Gaussians};
use fastlgs_raster::{Choice, Engine, Progress, Targets, Trainer, TrainerConfig, TrainerReport};
use fastlgs_sfm::surfaces::Surfaces;
use std::time::Instant;

/// Trained Gaussians, and the data of their training that the report needs.
pub struct Trained {
    pub scene: Gaussians,
    /// The device.
    pub engine: Box<dyn Engine>,
    /// Cameras of all views; alignment may have moved those of the training views.
    pub cameras: Vec<Camera>,
    /// The training views among them.
    pub training: Vec<Camera>,
    /// Whether alignment moved cameras.
    pub aligned: bool,
    /// Transparent Gaussians of the earlier scene, if its objects are kept.
    pub kept_transparent: Gaussians,
    /// Mean PSNR of the held-out views in dB.
    pub psnr_held_out: Option<f64>,
    pub curve: Vec<CurvePoint>,
    /// Seconds of finding objects during training.
    pub supervision_seconds: f64,
    pub settings: TrainerConfig,
    pub device: Choice,
    pub result: TrainerReport,
}

/// Trains the Gaussians. Only the engine of the trainer remains, so that mapping has its memory.
pub fn train(inputs: &Inputs, run: &Run) -> Result<Trained> {
    let (config, folder) = (&inputs.config, &inputs.folder);
    let (targets, held_out) = (inputs.targets(), inputs.held_out());
    held_out.check()?;
    let device = fastlgs_raster::choice(run.device);
    let mut engine = fastlgs_raster::open_engine(&device.device)?;
    let surfaces = init::surfaces(config, folder, &targets)?;
    let first = initial_gaussians(inputs, &targets, surfaces.as_ref(), &mut *engine, run)?;
    let kept_transparent = match config.mapping {
        Mapping::Keep => transparent::take_transparent(&mut folder.gaussians()?),
        Mapping::Paper | Mapping::Global => Gaussians::default(),
    };
    let brightness = inputs.notes.brightness.clone().unwrap_or_default();
    let manifest = &inputs.manifest;
    let mut settings = settings(config, &first, &targets, manifest, &brightness, run.seed);
    settings.depth_weight = surfaces.as_ref().map_or(0.0, |_| config.depth_weight);
    let free = init::free_space(config, folder, &inputs.training, &first, surfaces.as_ref())?;
    let targets = match surfaces {
        Some(surfaces) => init::with_depths(targets, surfaces.maps),
        None => targets,
    };
    let work = run.work("train", u64::from(settings.iterations));
    let mut trainer = Trainer::new(engine, &first, targets, settings.clone())?;
    trainer.set_free_space(free);
    resume(&mut trainer, inputs, run)?;
    run.progress.on_message(Message::TrainingBegins(&first));
    let mut watch = ProgressWatcher {
        inputs,
        held_out: &held_out,
        settings: &settings,
        run,
        curve: Vec::new(),
        supervision_seconds: 0.0,
    };
    let result = trainer.run(Some(&checkpoints::path(folder)), |progress, trainer| {
        work.check()?;
        watch.on_progress(progress, trainer)
    })?;
    drop(work);
    let (curve, supervision_seconds) = (watch.curve, watch.supervision_seconds);

    let training = trainer.cameras();
    let cameras = with_trained(&inputs.cameras, &training);
    let degree = trainer.needed_degree()?;
    let psnr_held_out = trainer.quality(&held_out, Some(degree))?;
    let scene = trainer.gaussians()?.with_sh_degree(degree);
    run.progress.on_message(Message::TrainingEnds(&scene));
    Ok(Trained {
        scene,
        engine: trainer.into_engine(),
        aligned: cameras != inputs.initial_cameras,
        cameras,
        training,
        kept_transparent,
        psnr_held_out,
        curve,
        supervision_seconds,
        settings,
        device,
        result,
    })
}

/// Returns the Gaussians that training starts from, with their features.
fn initial_gaussians(
    inputs: &Inputs,
    targets: &Targets,
    surfaces: Option<&Surfaces>,
    engine: &mut dyn Engine,
    run: &Run,
) -> Result<Gaussians> {
    let config = &inputs.config;
    let mut first = init::gaussians(config, &inputs.folder, targets, surfaces, run)?;
    // Gaussians of transparent objects have no colour to train.
    transparent::take_transparent(&mut first);
    let has_features = config.init.is_some() && config.mapping == Mapping::Keep;
    if let Some(objects) = inputs
        .prior_objects
        .as_ref()
        .filter(|_| inputs.trains_features() && !has_features)
    {
        // Features start from the objects on which most views agree. From other features, descent
        // ends between the codes of views that disagree.
        let mut mapper = objects::Mapper {
            folder: &inputs.folder,
            cameras: &inputs.training,
            config: config.global(&inputs.manifest.segmenter),
            engine,
            run,
        };
        mapper.lift(&mut first, objects)?;
    }
    Ok(first)
}

/// Returns all cameras, with those of the training views as training left them.
fn with_trained(all: &[Camera], training: &[Camera]) -> Vec<Camera> {
    let mut cameras = all.to_vec();
    for camera in &mut cameras {
        if let Some(trained) = training.iter().find(|c| c.name == camera.name) {
            *camera = trained.clone();
        }
    }
    cameras
}

/// Continues from the last checkpoint if `resume` is set.
fn resume(trainer: &mut Trainer, inputs: &Inputs, run: &Run) -> Result<()> {
    let checkpoint = checkpoints::path(&inputs.folder);
    if inputs.config.resume && !trainer.resume(&checkpoint)? {
        run.warn(&format!(
            "{}: there is no checkpoint to resume from; training starts from the beginning",
            checkpoint.display()
        ));
    }
    if trainer.is_coupled() {
        mask_supervision::resume_targets(trainer, &inputs.folder)?;
    }
    Ok(())
}

/// Follows a training: starts mask supervision, measures the curve, and reports progress.
struct ProgressWatcher<'a> {
    inputs: &'a Inputs,
    held_out: &'a Targets,
    settings: &'a TrainerConfig,
    run: &'a Run<'a>,
    curve: Vec<CurvePoint>,
    supervision_seconds: f64,
}

impl ProgressWatcher<'_> {
    fn on_progress(&mut self, progress: &Progress, trainer: &mut Trainer) -> Result<()> {
        let Progress {
            iteration,
            seconds,
            psnr,
            gaussians,
            losses,
        } = progress;
        let (iteration, seconds, psnr, gaussians) = (*iteration, *seconds, *psnr, *gaussians);
        if self.settings.couples_at == Some(iteration) {
            let started = Instant::now();
            let config = self.inputs.config.global(&self.inputs.manifest.segmenter);
            mask_supervision::begin(trainer, &self.inputs.folder, config, self.run)?;
            self.supervision_seconds += started.elapsed().as_secs_f64();
        }
        stop_point::reach("train", u64::from(iteration));
        let loss = 0.8 * losses.color_l1 + 0.2 * (1.0 - losses.color_ssim);
        let mut step = TrainStep {
            iteration,
            seconds,
            loss,
            psnr,
            psnr_held_out: None,
            gaussians,
        };
        let is_on_curve = |every: u32| iteration % every.next_multiple_of(20) == 0;
        if self.inputs.config.curve.is_some_and(is_on_curve) {
            step.psnr_held_out = trainer.quality(self.held_out, None)?;
            tracing::info!(
                iteration,
                seconds,
                psnr_held_out = step.psnr_held_out,
                gaussians,
                "curve"
            );
            self.curve.push(CurvePoint::from(step));
        }
        self.run.progress.on_message(Message::Trained {
            step,
            total: self.settings.iterations,
            scene: &|| Ok(trainer.gaussians()?),
        });
        if iteration % 200 == 0 {
            tracing::info!(
                iteration,
                loss,
                psnr,
                feature_l1 = losses.feature_l1,
                gaussians
            );
        }
        Ok(())
    }
}
