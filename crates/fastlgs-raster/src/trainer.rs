//! Training of scene and semantic field together (paper, "Training Features for Gaussians").

use crate::density::{self, State};
use crate::engine::{Engine, Frame, Losses, StepOptions};
use crate::view::{Step, View};
use crate::{Error, Result};
use fastlgs_core::camera::scene_extent;
use fastlgs_core::gaussians::CHANNELS;
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::{load_tensors, save_tensors};
use fastlgs_core::{Camera, Gaussians, fs};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::Instant;

/// A training view: camera and `[6][h][w]` target of colour and feature; negative values do not count.
pub struct Target {
    /// Camera at the training resolution.
    pub camera: Camera,
    /// Colour (3 planes) and feature (3 planes).
    pub image: Vec<f32>,
}

/// What a training run needs to know; part of every checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainConfig {
    /// Optimiser steps.
    pub iterations: u32,
    /// Seed of view order and splitting.
    pub seed: u64,
    /// No more Gaussians than this.
    pub budget: usize,
    /// Share of D-SSIM in both losses (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss.
    pub feature_weight: f32,
    /// Let the feature loss move geometry too.
    pub feature_moves_geometry: bool,
    /// Steps between rounds of density control.
    pub refine_every: u32,
    /// Share of the iterations after which the scene no longer grows.
    pub refine_until: f32,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            iterations: 3000,
            seed: 0,
            budget: 60_000,
            lambda: 0.2,
            feature_weight: 1.0,
            feature_moves_geometry: false,
            refine_every: 100,
            refine_until: 0.6,
        }
    }
}

/// State of a run, for progress bars.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Steps done.
    pub iteration: u32,
    /// Losses of the last measured step.
    pub losses: Losses,
    /// PSNR of the last measured training view in dB, estimated from its squared error.
    pub psnr: f64,
    /// Gaussians now.
    pub gaussians: usize,
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
    /// Adapter.
    pub adapter: String,
}

#[derive(Serialize, Deserialize)]
struct CheckpointHeader {
    config: TrainConfig,
    iteration: u32,
    gaussians: usize,
    order: Vec<usize>,
    rng: Rng,
}

/// A training run; drive it with [`Trainer::run`].
pub struct Trainer {
    engine: Box<dyn Engine>,
    cameras: Vec<Camera>,
    config: TrainConfig,
    extent: f32,
    iteration: u32,
    order: Vec<usize>,
    rng: Rng,
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
        let params = scene.to_channels();
        let zeros = vec![0.0; params.len()];
        engine.set_state(&params, &zeros, &zeros)?;
        for (id, target) in targets.iter().enumerate() {
            engine.set_target(id, &target.image)?;
        }
        let cameras: Vec<Camera> = targets.into_iter().map(|t| t.camera).collect();
        let rng = Rng::new(config.seed, "train");
        Ok(Self { engine, extent: scene_extent(&cameras), cameras, config, iteration: 0, order: Vec::new(), rng })
    }

    /// Learning rates of 3DGS; those of positions decay exponentially to a hundredth.
    fn rates(&self) -> [f32; CHANNELS] {
        let t = self.iteration as f32 / self.config.iterations.max(1) as f32;
        let mean = 1.6e-4 * self.extent * 0.01f32.powf(t);
        let mut rates = [0.0; CHANNELS];
        rates[0..3].fill(mean);
        rates[3..6].fill(5e-3);
        rates[6..10].fill(1e-3);
        rates[10] = 5e-2;
        rates[11..14].fill(2.5e-3 * 2.0);
        rates[14..17].fill(1e-2);
        rates
    }

    /// The next training view: every view once in random order, then again.
    fn next_view(&mut self) -> usize {
        if self.order.is_empty() {
            self.order = (0..self.cameras.len()).collect();
            self.rng.shuffle(&mut self.order);
        }
        self.order.pop().expect("filled above")
    }

    fn step(&mut self) -> Result<()> {
        let id = self.next_view();
        let mut view = View::new(&self.cameras[id], self.engine.len());
        view.feature_moves_geometry = u32::from(self.config.feature_moves_geometry);
        let options = StepOptions { lambda: self.config.lambda, feature_weight: self.config.feature_weight };
        let step = Step::new(self.engine.len(), self.iteration + 1, self.rates());
        self.engine.step(view, id, options, &step)?;
        self.iteration += 1;
        Ok(())
    }

    /// Whether the last step is followed by a round of density control.
    fn at_refinement(&self) -> bool {
        let until = (self.config.iterations as f32 * self.config.refine_until) as u32;
        self.iteration.is_multiple_of(self.config.refine_every) && self.iteration >= 300.min(until) && self.iteration <= until
    }

    fn state(&self) -> Result<State> {
        let (moment1, moment2) = self.engine.moments()?;
        Ok(State { params: self.engine.params()?, moment1, moment2 })
    }

    fn refine(&mut self) -> Result<()> {
        let mut state = self.state()?;
        let config = density::Config { budget: self.config.budget, ..density::Config::default() };
        let counts = density::refine(&mut state, &self.engine.stats()?, self.extent, &config, &mut self.rng);
        if state.is_empty() {
            return Err(Error::Invalid("every Gaussian became transparent; check the poses of the photos".to_owned()));
        }
        tracing::debug!(iteration = self.iteration, gaussians = state.len(), ?counts, "density control");
        self.engine.set_state(&state.params, &state.moment1, &state.moment2)
    }

    /// Runs to the end. `report` is called every 20 steps; `checkpoint`, where given, is written every 500 steps.
    ///
    /// # Errors
    /// When the device fails, the scene degenerates, or a checkpoint cannot be written.
    pub fn run(&mut self, checkpoint: Option<&Path>, mut report: impl FnMut(&Progress)) -> Result<TrainReport> {
        let first = self.iteration;
        let mut started = Instant::now();
        while self.iteration < self.config.iterations {
            self.step()?;
            if self.iteration == first + 1 {
                // The driver compiles kernels in their first dispatch.
                self.engine.losses()?;
                started = Instant::now();
            }
            if self.at_refinement() {
                self.refine()?;
            }
            if self.iteration.is_multiple_of(20) {
                let losses = self.engine.losses()?;
                // For errors spread like a Gaussian, mean square = pi/2 x squared mean absolute error.
                let psnr = -10.0 * (losses.color_l1.powi(2) * std::f64::consts::FRAC_PI_2).max(1e-12).log10();
                report(&Progress { iteration: self.iteration, losses, psnr, gaussians: self.engine.len() });
            }
            if let Some(path) = checkpoint.filter(|_| self.iteration.is_multiple_of(500) && self.iteration < self.config.iterations) {
                self.save(path)?;
            }
        }
        self.engine.losses()?;
        let (seconds, steps) = (started.elapsed().as_secs_f64(), self.iteration - first);
        Ok(TrainReport {
            iterations: self.iteration,
            steps_here: steps,
            seconds,
            iterations_per_second: f64::from(steps.saturating_sub(1)) / seconds.max(1e-9),
            gaussians: self.engine.len(),
            adapter: self.engine.name(),
        })
    }

    /// The Gaussians as they are now.
    ///
    /// # Errors
    /// When the device failed, or a value is no longer finite.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let scene = Gaussians::from_channels(&self.engine.params()?, None);
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
        self.engine.render(View::new(camera, self.engine.len()))
    }

    /// Writes a checkpoint: `path` (tensors) and `path.json` (the rest, written last).
    ///
    /// # Errors
    /// The system's refusal; an earlier checkpoint then stays.
    pub fn save(&self, path: &Path) -> Result<()> {
        let state = self.state()?;
        let stats = self.engine.stats()?;
        let n = state.len();
        let shape = vec![CHANNELS, n];
        let tensors = [
            ("params", shape.clone(), state.params.as_slice()),
            ("moment1", shape.clone(), &state.moment1),
            ("moment2", shape, &state.moment2),
            ("stats", vec![2, n], &stats),
        ];
        let header = CheckpointHeader {
            config: self.config.clone(),
            iteration: self.iteration,
            gaussians: n,
            order: self.order.clone(),
            rng: self.rng.clone(),
        };
        save_tensors(&path.with_extension(format!("{}.safetensors", self.iteration)), &tensors)?;
        fs::write_json(&path.with_extension("json"), &header)?;
        // The header now names the new tensors; older ones are of no more use.
        let keep = path.with_extension(format!("{}.safetensors", self.iteration));
        let folder = path.parent().unwrap_or(Path::new("."));
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let old = entry.path();
            if old != keep && old.extension().is_some_and(|e| e == "safetensors") {
                let _ = std::fs::remove_file(old);
            }
        }
        Ok(())
    }

    /// Continues from a checkpoint of the same configuration. Returns false where there is none.
    ///
    /// # Errors
    /// A damaged checkpoint, or one of another configuration.
    pub fn resume(&mut self, path: &Path) -> Result<bool> {
        let header_path = path.with_extension("json");
        if !header_path.is_file() {
            return Ok(false);
        }
        let header: CheckpointHeader = fs::read_json(&header_path)?;
        if header.config != self.config {
            return Err(Error::Invalid(format!(
                "{}: the checkpoint was made with other options; leave out --resume",
                header_path.display()
            )));
        }
        let tensors_path = path.with_extension(format!("{}.safetensors", header.iteration));
        let tensors = load_tensors(&tensors_path)?;
        let get = |name: &str, rows: usize| {
            let found = tensors.get(name).filter(|t| t.0 == [rows, header.gaussians]).map(|t| t.1.as_slice());
            found.ok_or_else(|| fastlgs_core::Error::format(&tensors_path, format!("tensor '{name}' is missing or misshapen")))
        };
        self.engine.set_state(get("params", CHANNELS)?, get("moment1", CHANNELS)?, get("moment2", CHANNELS)?)?;
        self.engine.set_stats(get("stats", 2)?)?;
        (self.iteration, self.order, self.rng) = (header.iteration, header.order, header.rng);
        Ok(true)
    }
}
