//! Trains the scene and its semantic features (paper, "Training Features for Gaussians").

mod alignment;
mod coupling;
mod loaded_targets;
mod validation;

use crate::budget::{self, Removal};
use crate::channels::Channels;
use crate::checkpoint::{self, TrainingState};
use crate::density::{self, State};
use crate::engine::{Engine, Exposure, Frame, Losses, StepOptions};
use crate::exposure::{self, BACKGROUND_RATE, Learned, LearnedExposure};
use crate::floaters::FreeSpace;
use crate::schedule::{Budget, TrainerConfig};
use crate::target::{Target, Targets, fingerprint};
use crate::view::{Step, View};
use crate::{Error, Result};
use fastlgs_core::camera::scene_extent;
use fastlgs_core::gaussians::channel::FEATURE;
use fastlgs_core::gaussians::{self, BASE_CHANNELS};
use fastlgs_core::metrics::psnr;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use loaded_targets::LoadedTargets;
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// Progress of a run, for progress bars.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Steps done.
    pub iteration: u32,
    /// Losses of the last measured step. With few photos, its render lacks the Gaussians that were
    /// dropped.
    pub losses: Losses,
    /// PSNR of the last measured training view in dB, estimated from its absolute error.
    pub psnr: f64,
    /// Current number of Gaussians.
    pub gaussians: usize,
    /// Seconds of steps and density control so far.
    pub seconds: f64,
}

/// Report of a finished run.
#[derive(Clone, Debug, Serialize)]
pub struct TrainerReport {
    /// Steps done, including those before a resume.
    pub iterations: u32,
    /// Steps of this process.
    pub steps_here: u32,
    /// Seconds of this process in steps and density control, without reading photos. The time
    /// starts after the first step, which compiles the kernels.
    pub seconds: f64,
    /// Steps per second in that time.
    pub iterations_per_second: f64,
    /// Final number of Gaussians.
    pub gaussians: usize,
    /// Removals by the automatic budget.
    pub removals: Vec<Removal>,
    /// Background colour and feature.
    pub background: [f32; 6],
    /// PSNR gain of the validation views by alignment, in dB; `None` if it was not measured.
    pub alignment_gain: Option<f64>,
    /// Name of the device.
    pub adapter: String,
}

/// A training run; [`Trainer::run`] completes it.
pub struct Trainer {
    engine: Box<dyn Engine>,
    targets: Targets,
    extent: f32,
    /// Standard deviation of the photos' brightness.
    contrast: f32,
    /// Space in which density control removes Gaussians.
    free_space: FreeSpace,
    training: TrainingState,
    loaded_targets: LoadedTargets,
}

/// Returns the view of a camera with the options and the background of a run.
fn view_of(course: &TrainingState, gaussians: usize, camera: &Camera, sh_degree: u32) -> View {
    let [r, g, b, x, y, z] = course.background.values;
    View {
        antialias: u32::from(course.config.antialias),
        background_color: [r, g, b, 0.0],
        background_feature: [x, y, z, 0.0],
        ..View::new(camera, gaussians, sh_degree)
    }
}

impl Trainer {
    /// Loads the first Gaussians onto the device.
    ///
    /// # Errors
    /// When there is nothing to train, it does not fit the device, or an image cannot be read.
    pub fn new(
        mut engine: Box<dyn Engine>,
        scene: &Gaussians,
        targets: impl Into<Targets>,
        config: TrainerConfig,
    ) -> Result<Self> {
        let mut targets: Targets = targets.into();
        if scene.is_empty() || targets.is_empty() {
            return Err(Error::Invalid(
                "nothing to train: there are no points or no training views".to_owned(),
            ));
        }
        engine.set_state(&State::of(&scene.clone().with_sh_degree(config.degree(0))))?;
        if config.exposure {
            targets = targets.without_clipped();
        }
        let (contrast, pictures) = targets.contrast_and_fingerprint()?;
        let first = scene.to_channels().into_iter().map(f32::to_bits);
        let background = Learned::new(std::array::from_fn(|c| {
            if c < 3 { config.background[c] } else { 0.0 }
        }));
        let course = TrainingState {
            iteration: 0,
            gaussians: scene.len(),
            order: Vec::new(),
            rng: Rng::new(config.seed, "train"),
            removals: Vec::new(),
            exposures: targets
                .gains()
                .iter()
                .filter(|_| config.exposure)
                .map(|gain| LearnedExposure::from_gain(*gain))
                .collect(),
            background,
            views: targets
                .cameras
                .iter()
                .map(|c| (c.name.clone(), [c.width, c.height]))
                .collect(),
            shown: fingerprint(
                [pictures as u32, (pictures >> 32) as u32]
                    .into_iter()
                    .chain(first),
            ),
            poses: targets.cameras.iter().map(|c| c.world_to_camera).collect(),
            alignment_gain: None,
            coupled: false,
            config,
        };
        let extent = scene_extent(&targets.cameras);
        Ok(Self {
            engine,
            extent,
            contrast,
            free_space: FreeSpace::default(),
            targets,
            training: course,
            loaded_targets: LoadedTargets::default(),
        })
    }

    /// Ends the run and returns the engine, without the images of the views.
    pub fn into_engine(mut self) -> Box<dyn Engine> {
        self.unload_targets();
        self.engine
    }

    /// Sets the free space for the current cameras. Density control removes Gaussians in it.
    pub fn set_free_space(&mut self, free: FreeSpace) {
        self.free_space = free;
    }

    /// Returns the next training view: every view once in random order, then again. Under an
    /// automatic budget, validation views are left out until growth ends.
    fn next_view(&mut self) -> usize {
        let growing = matches!(self.training.config.budget, Budget::Auto(_)) && self.grows();
        if self.training.order.is_empty() {
            let count = self.targets.len();
            self.training.order = (0..count)
                .filter(|&i| !(growing && budget::is_validation_view(i, count)))
                .collect();
            self.training.rng.shuffle(&mut self.training.order);
        }
        self.training.order.pop().expect("filled above")
    }

    fn grows(&self) -> bool {
        let config = &self.training.config;
        config.channels.color() && config.grows(self.training.iteration)
    }

    fn view(&self, camera: &Camera, sh_degree: u32) -> View {
        view_of(&self.training, self.engine.len(), camera, sh_degree)
    }

    fn step(&mut self) -> Result<()> {
        let id = self.next_view();
        self.load_target(id)?;
        let config = self.training.config.clone();
        let iteration = self.training.iteration;
        let camera = &self.targets.cameras[id];
        let camera = if config.coarse(iteration) {
            camera.halved()
        } else {
            camera.clone()
        };
        let degree = config.degree(iteration);
        let has_depth = config.trains_depth(iteration);
        let channels = if has_depth {
            Channels::Coupled
        } else {
            self.channels()
        };
        let options = StepOptions {
            channels,
            lambda: config.lambda,
            feature_weight: config.feature_weight,
            exposure: self.exposure(id),
            depth_weight: if has_depth { config.depth_weight } else { 0.0 },
        };
        let rates = config.rates(iteration, self.extent);
        let trained = match channels {
            _ if has_depth => 0..FEATURE.start,
            Channels::Feature => FEATURE.start..BASE_CHANNELS,
            Channels::Color | Channels::Both | Channels::Coupled => 0..gaussians::channels(degree),
        };
        let mut step = Step::new(iteration + 1, trained, &rates);
        step.opacity_weight = config.opacity_weight(iteration, self.engine.len(), self.contrast);
        step.frozen = config.frozen as u32;
        let left_out = config.dropout(iteration, self.targets.len());
        let view = self
            .view(&camera, degree)
            .for_training()
            .with_dropout(left_out, config.step_seed(iteration));
        let view = if has_depth {
            view.with_depth_moments()
        } else {
            view
        };
        self.engine.step(view, id, &options, &step)?;
        self.enforce_limit(id);
        if config.exposure || config.learn_background {
            let losses = self.engine.losses()?;
            if let Some(exposure) = self.training.exposures.get_mut(id) {
                exposure.learn(&losses, config.progress(iteration));
                exposure::pin_mean(&mut self.training.exposures);
            }
            if config.learn_background {
                // The background feature stays 0, because queries expect no other.
                let [r, g, b, ..] = losses.by_background;
                self.training
                    .background
                    .step([r, g, b, 0.0, 0.0, 0.0], BACKGROUND_RATE);
            }
        }
        self.training.iteration += 1;
        Ok(())
    }

    /// Runs a round of density control.
    fn refine(&mut self) -> Result<()> {
        let mut state = self.engine.state()?;
        let config = &self.training.config;
        let before = state.len();
        let budget = if self.grows() {
            config.budget.max_gaussians()
        } else {
            before
        };
        let limits = density::DensityConfig {
            budget,
            ..density::DensityConfig::default()
        };
        let counts = density::refine(
            &mut state,
            &self.engine.stats()?,
            self.extent,
            &limits,
            &mut self.training.rng,
        );
        let floaters = state.remove_where(|mean| self.free_space.contains(mean));
        tracing::debug!(
            iteration = self.training.iteration,
            gaussians = state.len(),
            ?counts,
            floaters,
            "density control"
        );
        state.sort_along_curve();
        self.replace(&state)
    }

    /// Changes the trained values of the Gaussians, and keeps the statistics of their gradients.
    fn edit_state(&mut self, edit: impl FnOnce(&mut State)) -> Result<()> {
        let (mut state, stats) = (self.engine.state()?, self.engine.stats()?);
        edit(&mut state);
        self.engine.set_state(&state)?;
        self.engine.set_stats(&stats)
    }

    fn replace(&mut self, state: &State) -> Result<()> {
        if state.is_empty() {
            return Err(Error::Invalid("all Gaussians were removed, because none contributes to the photos; check the camera poses".to_owned()));
        }
        self.engine.set_state(state)
    }

    fn exposure(&self, id: usize) -> Exposure {
        self.training
            .exposures
            .get(id)
            .map_or_else(Exposure::default, LearnedExposure::exposure)
    }

    /// Returns the exposure of a view that is not trained on, from its measured brightness. Without
    /// it, differences in brightness would hide changes of quality.
    fn measured_exposure(&self, target: &Target) -> Exposure {
        if self.training.config.exposure {
            Exposure {
                gain: target.gain,
                ..Exposure::default()
            }
        } else {
            Exposure::default()
        }
    }

    /// Returns the mean PSNR in dB of the current scene on any views, over the pixels that the
    /// loss uses.
    /// Colour has SH degree `sh_degree`, or the degree in use if `None`. Returns `None` if there
    /// are no views, or the loss ignores all pixels.
    ///
    /// # Errors
    /// As [`Engine::render`], and when an image cannot be read.
    pub fn quality(&mut self, views: &Targets, sh_degree: Option<u32>) -> Result<Option<f64>> {
        let degree =
            sh_degree.unwrap_or_else(|| self.training.config.degree(self.training.iteration));
        let mut sum = 0.0;
        let mut count = 0u32;
        for id in 0..views.len() {
            let target = views.get(id)?;
            let (image, gain) = (&target.image, self.measured_exposure(&target).gain);
            let frame = self
                .engine
                .render(self.view(&target.camera, degree), Channels::Color)?;
            let (mut rendered, mut wanted) = (Vec::new(), Vec::new());
            for c in 0..3 {
                for (value, packed) in frame
                    .channels(c, c + 1)
                    .iter()
                    .zip(&image.color)
                    .filter(|(_, p)| p.to_le_bytes()[3] == 255)
                {
                    rendered.push((gain[c] * value).clamp(0.0, 1.0));
                    wanted.push(f32::from(packed.to_le_bytes()[c]) / 255.0);
                }
            }
            if !wanted.is_empty() {
                (sum, count) = (sum + psnr(&rendered, &wanted), count + 1);
            }
        }
        Ok((count > 0).then(|| sum / f64::from(count)))
    }

    /// Runs to the end. `report` is called every 20 steps. The checkpoint, if given, is written
    /// every 500 steps.
    ///
    /// # Errors
    /// When the device fails, the scene degenerates, or a checkpoint cannot be written. An error of
    /// `report` ends the run.
    pub fn run<E: From<Error>>(
        &mut self,
        checkpoint: Option<&Path>,
        mut report: impl FnMut(&Progress, &mut Self) -> Result<(), E>,
    ) -> Result<TrainerReport, E> {
        let first = self.training.iteration;
        let mut started = Instant::now();
        // The time of `report` does not count.
        let mut report_seconds = 0.0;
        while self.training.iteration < self.training.config.iterations {
            self.step()?;
            let iteration = self.training.iteration;
            if iteration == first + 1 {
                // Drivers compile kernels in their first dispatch.
                self.engine.losses()?;
                started = Instant::now();
                self.loaded_targets.read_seconds = 0.0;
            }
            self.run_scheduled(iteration)?;
            if iteration.is_multiple_of(20) || self.training.config.couples_at == Some(iteration) {
                let losses = self.engine.losses()?;
                // For normally distributed errors, mean square = pi/2 x squared mean absolute
                // error.
                let mean_square = losses.color_l1.powi(2) * std::f64::consts::FRAC_PI_2;
                let psnr = -10.0 * mean_square.max(1e-12).log10();
                let seconds = started.elapsed().as_secs_f64()
                    - report_seconds
                    - self.loaded_targets.read_seconds;
                let reporting = Instant::now();
                let progress = Progress {
                    iteration,
                    losses,
                    psnr,
                    gaussians: self.engine.len(),
                    seconds,
                };
                report(&progress, self)?;
                report_seconds += reporting.elapsed().as_secs_f64();
            }
            let is_last = iteration >= self.training.config.iterations;
            if let Some(path) = checkpoint.filter(|_| iteration.is_multiple_of(500) && !is_last) {
                self.save(path)?;
            }
        }
        self.engine.losses()?;
        let idle = report_seconds + self.loaded_targets.read_seconds;
        let seconds = started.elapsed().as_secs_f64() - idle;
        let steps = self.training.iteration - first;
        Ok(TrainerReport {
            iterations: self.training.iteration,
            steps_here: steps,
            seconds,
            iterations_per_second: f64::from(steps.saturating_sub(1)) / seconds.max(1e-9),
            gaussians: self.engine.len(),
            removals: self.training.removals.clone(),
            background: self.training.background.values,
            alignment_gain: self.training.alignment_gain,
            adapter: self.engine.name(),
        })
    }

    /// Runs the steps that are due after an iteration: a higher SH degree, density control, opacity
    /// reset, alignment and pruning.
    fn run_scheduled(&mut self, iteration: u32) -> Result<()> {
        let degree = self.training.config.degree(iteration);
        if degree > self.training.config.degree(iteration - 1) {
            // Steps are faster without coefficients that are not in use yet.
            self.edit_state(|state| state.raise_degree(degree))?;
        }
        if self.training.config.refines(iteration) {
            self.refine()?;
        }
        if self.training.config.resets_opacity(iteration) {
            // Opacities that no photo needs stay low.
            self.edit_state(|state| density::reset_opacity(state, 0.01))?;
        }
        if self.training.config.aligns(iteration) {
            self.align()?;
        }
        if self.training.config.prunes(iteration) {
            self.prune()?;
        }
        Ok(())
    }

    /// Returns the current Gaussians.
    ///
    /// # Errors
    /// When the device failed, or no Gaussian is finite.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let mut state = self.engine.state()?;
        let lost = state.keep_finite();
        if lost > 0 {
            tracing::warn!(lost, "removed Gaussians whose values are not finite");
        }
        if state.is_empty() {
            return Err(Error::Invalid(
                "training diverged: no Gaussian has finite values; check the camera poses"
                    .to_owned(),
            ));
        }
        Ok(Gaussians::from_channels(
            &state.params,
            state.sh_degree,
            None,
        ))
    }

    /// Renders the current scene from any camera.
    ///
    /// # Errors
    /// As [`Engine::render`].
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        self.engine.render(
            self.view(camera, self.training.config.degree(self.training.iteration)),
            Channels::Both,
        )
    }

    /// Returns the exposures of the training views; empty if they are not learned.
    pub fn exposures(&self) -> Vec<Exposure> {
        self.training
            .exposures
            .iter()
            .map(LearnedExposure::exposure)
            .collect()
    }

    /// Writes a checkpoint: `path.json`, and the tensor file that it names.
    ///
    /// # Errors
    /// When a file cannot be written; the previous checkpoint then remains.
    pub fn save(&self, path: &Path) -> Result<()> {
        let state = self.engine.state()?;
        let course = TrainingState {
            gaussians: state.len(),
            ..self.training.clone()
        };
        checkpoint::save(path, &course, &state, &self.engine.stats()?)
    }

    /// Continues from a checkpoint of the same configuration. Returns false if there is none.
    ///
    /// # Errors
    /// When the checkpoint is damaged, or belongs to another configuration.
    pub fn resume(&mut self, path: &Path) -> Result<bool> {
        let Some((course, state, stats)) = checkpoint::load(path)? else {
            return Ok(false);
        };
        let other = match () {
            () if course.config != self.training.config => Some("with other options"),
            () if course.views != self.training.views => Some("from other photos"),
            () if course.shown != 0 && course.shown != self.training.shown => {
                Some("from other images, objects or first Gaussians")
            }
            () => None,
        };
        if let Some(other) = other {
            let header = path.with_extension("json");
            let header = header.display();
            return Err(Error::Invalid(format!(
                "{header}: the checkpoint was made {other}; train without resuming, or delete it"
            )));
        }
        self.engine.set_state(&state)?;
        self.engine.set_stats(&stats)?;
        for (camera, pose) in self.targets.cameras.iter_mut().zip(&course.poses) {
            camera.world_to_camera = *pose;
        }
        tracing::info!(
            iteration = course.iteration,
            "training continues from its checkpoint"
        );
        self.training = course;
        Ok(true)
    }
}
