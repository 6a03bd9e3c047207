//! Training of scene and semantic field together (paper, "Training Features for Gaussians").

use crate::budget::{self, Growth, Removal};
use crate::channels::Channels;
use crate::checkpoint::{self, Course};
use crate::density::{self, State};
use crate::engine::{Engine, Exposure, Frame, Losses, StepOptions, TargetImage};
use crate::exposure::{Learned, LearnedExposure, RATE};
use crate::schedule::{Budget, Strategy, TrainConfig};
use crate::view::{Step, View};
use crate::{Error, Result};
use fastlgs_core::camera::scene_extent;
use fastlgs_core::gaussians::{BASE_CHANNELS, channels};
use fastlgs_core::metrics::psnr;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// A training view.
#[derive(Clone)]
pub struct Target {
    /// Camera at the training resolution.
    pub camera: Camera,
    /// What it should see.
    pub image: TargetImage,
}

impl Target {
    /// The view at half the resolution: means over 2x2 pixels, of those that count.
    fn halved(&self) -> Self {
        let [w, h] = self.image.size;
        let size = [w.div_ceil(2), h.div_ceil(2)];
        let halve = |plane: &[u32]| -> Vec<u32> {
            if plane.is_empty() {
                return Vec::new();
            }
            let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (2 * x, 2 * y)));
            pixels
                .map(|(x, y)| {
                    let block = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].map(|(x, y)| (x.min(w - 1), y.min(h - 1)));
                    let bytes = block.map(|(x, y)| plane[(y * w + x) as usize].to_le_bytes());
                    let counting = bytes.iter().filter(|b| b[3] == 255);
                    let n = counting.clone().count() as u32;
                    let mean =
                        |c: usize| (counting.clone().map(|b| u32::from(b[c])).sum::<u32>() + n / 2).checked_div(n).unwrap_or(0) as u8;
                    crate::pack([mean(0), mean(1), mean(2)], n > 0)
                })
                .collect()
        };
        let image = TargetImage { size, color: halve(&self.image.color), feature: halve(&self.image.feature) };
        Self { camera: self.camera.resized(size[0], size[1]), image }
    }
}

/// State of a run, for progress bars.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Steps done.
    pub iteration: u32,
    /// Losses of the last measured step.
    pub losses: Losses,
    /// PSNR of the last measured training view in dB, estimated from its absolute error.
    pub psnr: f64,
    /// Gaussians now.
    pub gaussians: usize,
    /// Seconds in steps and density control so far.
    pub seconds: f64,
}

/// What a finished run reports.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Steps done, including those before a resume.
    pub iterations: u32,
    /// Steps of this process.
    pub steps_here: u32,
    /// Seconds of this process in steps and density control, after the first step (which compiles the kernels).
    pub seconds: f64,
    /// Steps a second in that time.
    pub iterations_per_second: f64,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// What the automatic budget removed.
    pub removals: Vec<Removal>,
    /// Colour and feature behind everything.
    pub background: [f32; 6],
    /// Adapter.
    pub adapter: String,
}

/// A training run; drive it with [`Trainer::run`].
pub struct Trainer {
    engine: Box<dyn Engine>,
    targets: Vec<Target>,
    extent: f32,
    course: Course,
    /// Whether the engine holds the targets at half the resolution.
    coarse: Option<bool>,
}

impl Trainer {
    /// Puts the first Gaussians and all targets on the device.
    ///
    /// # Errors
    /// When there is nothing to train, or it does not fit the device.
    pub fn new(mut engine: Box<dyn Engine>, scene: &Gaussians, targets: Vec<Target>, config: TrainConfig) -> Result<Self> {
        if scene.is_empty() || targets.is_empty() {
            return Err(Error::Invalid("nothing to train: there are no points or no training views".to_owned()));
        }
        engine.set_state(&State::of(&scene.clone().with_sh_degree(config.sh_degree)))?;
        let cameras: Vec<Camera> = targets.iter().map(|t| t.camera.clone()).collect();
        let background = Learned::new(std::array::from_fn(|c| if c < 3 { config.background[c] } else { 0.0 }));
        let course = Course {
            iteration: 0,
            gaussians: scene.len(),
            order: Vec::new(),
            rng: Rng::new(config.seed, "train"),
            growth: Growth::default(),
            removals: Vec::new(),
            exposures: if config.exposure { vec![LearnedExposure::default(); targets.len()] } else { Vec::new() },
            background,
            config,
        };
        Ok(Self { engine, extent: scene_extent(&cameras), targets, course, coarse: None })
    }

    /// Uploads the targets at the resolution of the coming step.
    fn set_resolution(&mut self) -> Result<()> {
        let coarse = self.course.config.coarse(self.course.iteration);
        if self.coarse != Some(coarse) {
            for (id, target) in self.targets.iter().enumerate() {
                let image = if coarse { target.halved().image } else { target.image.clone() };
                self.engine.set_target(id, &image)?;
            }
            self.coarse = Some(coarse);
        }
        Ok(())
    }

    /// The next training view: every view once in random order, then again. Watched views wait until growth is over.
    fn next_view(&mut self) -> usize {
        let growing = matches!(self.course.config.budget, Budget::Auto(_)) && !self.growth_is_over();
        if self.course.order.is_empty() {
            let count = self.targets.len();
            self.course.order = (0..count).filter(|&i| !(growing && budget::is_watched(i, count))).collect();
            self.course.rng.shuffle(&mut self.course.order);
        }
        self.course.order.pop().expect("filled above")
    }

    fn growth_is_over(&self) -> bool {
        let config = &self.course.config;
        self.course.growth.stopped
            || !config.channels.color()
            || self.course.iteration as f32 >= config.iterations as f32 * config.refine_until
    }

    fn view(&self, camera: &Camera, sh_degree: u32) -> View {
        let [r, g, b, x, y, z] = self.course.background.values;
        View {
            antialias: u32::from(self.course.config.antialias),
            background_color: [r, g, b, 0.0],
            background_feature: [x, y, z, 0.0],
            ..View::new(camera, self.engine.len(), sh_degree)
        }
    }

    fn step(&mut self) -> Result<()> {
        self.set_resolution()?;
        let id = self.next_view();
        let config = self.course.config.clone();
        let iteration = self.course.iteration;
        let target = &self.targets[id];
        let [w, h] = target.image.size;
        let camera = if config.coarse(iteration) { target.camera.resized(w.div_ceil(2), h.div_ceil(2)) } else { target.camera.clone() };
        let degree = config.degree(iteration);
        let options = StepOptions {
            channels: config.channels,
            lambda: config.lambda,
            feature_weight: config.feature_weight,
            exposure: self.course.exposures.get(id).map_or_else(Exposure::default, LearnedExposure::exposure),
        };
        let rates = config.rates(iteration, self.extent);
        let trained = match config.channels {
            Channels::Feature => 14..BASE_CHANNELS,
            Channels::Color | Channels::Both | Channels::Coupled => 0..channels(degree),
        };
        let mut step = Step::new(iteration + 1, trained, &rates);
        if config.strategy == Strategy::Mcmc && config.channels.color() {
            // Weights of the means of opacity and scale in MCMC's loss.
            let each = 0.01 / self.engine.len() as f32;
            (step.opacity_weight, step.scale_weight) = (each, each / 3.0);
        }
        self.engine.step(self.view(&camera, degree), id, &options, &step)?;
        if let Some(amount) = config.noise(rates[0]).filter(|_| config.channels.color()) {
            self.engine.perturb(iteration, amount)?;
        }
        if config.exposure || config.learn_background {
            let losses = self.engine.losses()?;
            if let Some(exposure) = self.course.exposures.get_mut(id) {
                exposure.learn(&losses);
            }
            if config.learn_background {
                self.course.background.step(losses.by_background, RATE);
            }
        }
        self.course.iteration += 1;
        Ok(())
    }

    /// A round of density control.
    fn refine(&mut self) -> Result<()> {
        let mut state = self.engine.state()?;
        let config = &self.course.config;
        let before = state.len();
        let budget = if self.course.growth.stopped { before } else { config.budget.most() };
        match config.strategy {
            Strategy::Classic => {
                let limits = density::Config { budget, ..density::Config::default() };
                let counts = density::refine(&mut state, &self.engine.stats()?, self.extent, &limits, &mut self.course.rng);
                tracing::debug!(iteration = self.course.iteration, gaussians = state.len(), ?counts, "density control");
            }
            Strategy::Mcmc => {
                let moved = density::relocate(&mut state, &mut self.course.rng);
                let added = density::grow(&mut state, budget, &mut self.course.rng);
                tracing::debug!(iteration = self.course.iteration, gaussians = state.len(), moved, added, "density control");
            }
        }
        if config.resets_opacity(self.course.iteration) {
            density::reset_opacity(&mut state, 0.01);
        }
        self.replace(&state)
    }

    fn replace(&mut self, state: &State) -> Result<()> {
        if state.is_empty() {
            return Err(Error::Invalid("every Gaussian became transparent; check the poses of the photos".to_owned()));
        }
        self.engine.set_state(state)
    }

    /// Removes what no training view sees.
    fn prune(&mut self) -> Result<()> {
        let mut state = self.engine.state()?;
        let scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        let cameras: Vec<Camera> = self.targets.iter().map(|t| t.camera.clone()).collect();
        let kept = budget::seen(&scene, &cameras, budget::MIN_WEIGHT);
        let psnr_before = self.quality(&self.watched(), None)?;
        state.keep(&kept);
        self.replace(&state)?;
        let psnr_after = self.quality(&self.watched(), None)?;
        let removal = Removal { iteration: self.course.iteration, before: scene.len(), after: kept.len(), psnr_before, psnr_after };
        tracing::info!(?removal, "unseen Gaussians removed");
        self.course.removals.push(removal);
        Ok(())
    }

    /// Looks at the watched views and decides whether the scene may grow on.
    fn watch(&mut self) -> Result<()> {
        let degree = self.course.config.degree(self.course.iteration);
        if let Some(db) = self.quality(&self.watched(), Some(degree))? {
            self.course.growth.look(self.engine.len(), db);
            tracing::debug!(iteration = self.course.iteration, db, gaussians = self.engine.len(), growth = ?self.course.growth, "watched views");
        }
        Ok(())
    }

    /// The training views that are kept aside while the scene grows.
    fn watched(&self) -> Vec<Target> {
        let count = self.targets.len();
        (0..count).filter(|&i| budget::is_watched(i, count)).map(|i| self.targets[i].clone()).collect()
    }

    /// The lowest SH degree that shows the watched views as well as all degrees do, but for [`budget::DEGREE_LOSS`] dB; the
    /// highest where the budget is fixed or no view is watched.
    ///
    /// # Errors
    /// As [`Engine::render`].
    pub fn needed_degree(&mut self) -> Result<u32> {
        let (highest, watched) = (self.course.config.degree(self.course.iteration), self.watched());
        let automatic = matches!(self.course.config.budget, Budget::Auto(_));
        let Some(best) = self.quality(&watched, Some(highest))?.filter(|_| automatic) else { return Ok(highest) };
        for degree in 0..highest {
            if self.quality(&watched, Some(degree))?.is_some_and(|db| best - db <= budget::DEGREE_LOSS) {
                return Ok(degree);
            }
        }
        Ok(highest)
    }

    /// Mean PSNR of the scene as it is now against views, which need not be those of the training; pixels that do not
    /// count are left out. Colour up to `sh_degree`, else up to the degree in use. Nothing where there are no views.
    ///
    /// # Errors
    /// As [`Engine::render`].
    pub fn quality(&mut self, views: &[Target], sh_degree: Option<u32>) -> Result<Option<f64>> {
        let degree = sh_degree.unwrap_or_else(|| self.course.config.degree(self.course.iteration));
        let mut sum = 0.0;
        for Target { camera, image } in views {
            let frame = self.engine.render(self.view(camera, degree), Channels::Color)?;
            let (mut rendered, mut wanted) = (Vec::new(), Vec::new());
            for c in 0..3 {
                for (value, packed) in frame.channels(c, c + 1).iter().zip(&image.color).filter(|(_, p)| p.to_le_bytes()[3] == 255) {
                    rendered.push(*value);
                    wanted.push(f32::from(packed.to_le_bytes()[c]) / 255.0);
                }
            }
            sum += psnr(&rendered, &wanted);
        }
        Ok((!views.is_empty()).then(|| sum / views.len() as f64))
    }

    /// Runs to the end. `report` is called every 20 steps; `checkpoint`, where given, is written every 500 steps.
    ///
    /// # Errors
    /// When the device fails, the scene degenerates, or a checkpoint cannot be written; and whatever `report` returns, which ends the run.
    pub fn run<E: From<Error>>(
        &mut self,
        checkpoint: Option<&Path>,
        mut report: impl FnMut(&Progress, &mut Self) -> Result<(), E>,
    ) -> Result<TrainReport, E> {
        let first = self.course.iteration;
        let mut started = Instant::now();
        // Time of what `report` does is not the run's.
        let mut aside = 0.0;
        while self.course.iteration < self.course.config.iterations {
            self.step()?;
            let iteration = self.course.iteration;
            if iteration == first + 1 {
                // The driver compiles kernels in their first dispatch.
                self.engine.losses()?;
                started = Instant::now();
            }
            if iteration.is_multiple_of(budget::WATCH_EVERY)
                && matches!(self.course.config.budget, Budget::Auto(_))
                && !self.growth_is_over()
            {
                self.watch()?;
            }
            if self.course.config.refines(iteration) {
                self.refine()?;
            }
            if self.course.config.prunes(iteration) {
                self.prune()?;
            }
            if iteration.is_multiple_of(20) {
                let losses = self.engine.losses()?;
                // For errors spread like a Gaussian, mean square = pi/2 x squared mean absolute error.
                let psnr = -10.0 * (losses.color_l1.powi(2) * std::f64::consts::FRAC_PI_2).max(1e-12).log10();
                let seconds = started.elapsed().as_secs_f64() - aside;
                let reporting = Instant::now();
                report(&Progress { iteration, losses, psnr, gaussians: self.engine.len(), seconds }, self)?;
                aside += reporting.elapsed().as_secs_f64();
            }
            if let Some(path) = checkpoint.filter(|_| iteration.is_multiple_of(500) && iteration < self.course.config.iterations) {
                self.save(path)?;
            }
        }
        self.engine.losses()?;
        let (seconds, steps) = (started.elapsed().as_secs_f64() - aside, self.course.iteration - first);
        Ok(TrainReport {
            iterations: self.course.iteration,
            steps_here: steps,
            seconds,
            iterations_per_second: f64::from(steps.saturating_sub(1)) / seconds.max(1e-9),
            gaussians: self.engine.len(),
            removals: self.course.removals.clone(),
            background: self.course.background.values,
            adapter: self.engine.name(),
        })
    }

    /// The Gaussians as they are now.
    ///
    /// # Errors
    /// When the device failed, or a value is no longer finite.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let state = self.engine.state()?;
        let scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        match scene.first_not_finite() {
            Some(i) => Err(Error::Invalid(format!("training diverged: Gaussian {i} is no longer finite; check the poses"))),
            None => Ok(scene),
        }
    }

    /// Renders any camera with the current scene.
    ///
    /// # Errors
    /// As [`Engine::render`].
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        self.engine.render(self.view(camera, self.course.config.degree(self.course.iteration)), Channels::Both)
    }

    /// Exposures of the training views, where they are learned.
    pub fn exposures(&self) -> Vec<Exposure> {
        self.course.exposures.iter().map(LearnedExposure::exposure).collect()
    }

    /// Writes a checkpoint: `path.json`, and the tensors that it names.
    ///
    /// # Errors
    /// The system's refusal; an earlier checkpoint then stays.
    pub fn save(&self, path: &Path) -> Result<()> {
        let state = self.engine.state()?;
        let course = Course { gaussians: state.len(), ..self.course.clone() };
        checkpoint::save(path, &course, &state, &self.engine.stats()?)
    }

    /// Continues from a checkpoint of the same configuration. Returns false where there is none.
    ///
    /// # Errors
    /// A damaged checkpoint, or one of another configuration.
    pub fn resume(&mut self, path: &Path) -> Result<bool> {
        let Some((course, state, stats)) = checkpoint::load(path)? else { return Ok(false) };
        if course.config != self.course.config {
            let header = path.with_extension("json");
            return Err(Error::Invalid(format!("{}: the checkpoint was made with other options; leave out --resume", header.display())));
        }
        self.engine.set_state(&state)?;
        self.engine.set_stats(&stats)?;
        self.course = course;
        Ok(true)
    }
}
