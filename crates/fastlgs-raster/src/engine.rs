//! One interface for the GPU and its twins.

use crate::cpu::{self, CHUNKS, RUN, Splat};
use crate::view::{Job, Plane, Step, View};
use crate::{Error, GpuEngine, Result};
use fastlgs_core::gaussians::CHANNELS;
use std::collections::{BTreeMap, HashMap};

/// A rendered frame, planar.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `[8][h][w]`: r, g, b, f0, f1, f2, transmittance left, pairs walked.
    pub data: Vec<f32>,
    /// (tile, Gaussian) pairs of the frame.
    pub pairs: u32,
}

impl Frame {
    /// Channels `from..to` as one planar slice.
    pub fn channels(&self, from: usize, to: usize) -> &[f32] {
        let n = (self.width * self.height) as usize;
        &self.data[from * n..to * n]
    }
}

/// Weights of one training step's loss.
#[derive(Clone, Copy, Debug)]
pub struct StepOptions {
    /// Share of D-SSIM (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss; 0 leaves the feature channels out.
    pub feature_weight: f32,
}

/// Loss of the last step.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    /// Mean absolute error of colour.
    pub color_l1: f64,
    /// Mean SSIM of colour.
    pub color_ssim: f64,
    /// Mean absolute error of the feature.
    pub feature_l1: f64,
}

/// Runs the passes. State: trained values `[CHANNELS][n]`, both Adam moments of the same shape, and density statistics.
pub trait Engine {
    /// The adapter, for reports.
    fn name(&self) -> String;
    /// Number of Gaussians.
    fn len(&self) -> usize;
    /// Whether there are no Gaussians.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Replaces trained values and moments; clears the statistics.
    ///
    /// # Errors
    /// When they do not fit the device.
    fn set_state(&mut self, params: &[f32], moment1: &[f32], moment2: &[f32]) -> Result<()>;
    /// Trained values.
    ///
    /// # Errors
    /// When the device failed.
    fn params(&self) -> Result<Vec<f32>>;
    /// Both moments.
    ///
    /// # Errors
    /// When the device failed.
    fn moments(&self) -> Result<(Vec<f32>, Vec<f32>)>;
    /// Statistics `[2][n]` since the last [`Self::set_state`]; `shaders/project_backward.wgsl`.
    ///
    /// # Errors
    /// When the device failed.
    fn stats(&self) -> Result<Vec<f32>>;
    /// Replaces the statistics.
    ///
    /// # Errors
    /// When the device failed.
    fn set_stats(&mut self, stats: &[f32]) -> Result<()>;
    /// Gradient `[CHANNELS][n]` of the last step.
    ///
    /// # Errors
    /// When the device failed.
    fn gradients(&self) -> Result<Vec<f32>>;
    /// Keeps a target `[6][h][w]` on the device; negative values do not count.
    ///
    /// # Errors
    /// When it does not fit.
    fn set_target(&mut self, id: usize, target: &[f32]) -> Result<()>;
    /// Renders a frame; `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// When it does not fit or the device failed.
    fn render(&mut self, view: View) -> Result<Frame>;
    /// One training step towards target `id`: forward, loss, backward, Adam.
    ///
    /// # Errors
    /// As [`Self::render`].
    fn step(&mut self, view: View, id: usize, options: StepOptions, step: &Step) -> Result<()>;
    /// Losses of the last step.
    ///
    /// # Errors
    /// When the device failed.
    fn losses(&self) -> Result<Losses>;
    /// Starts or stops taking the time of each pass; false where the device cannot.
    fn set_profiling(&mut self, _on: bool) -> bool {
        false
    }
    /// Seconds of each pass since the last call, while profiling.
    ///
    /// # Errors
    /// When the device failed.
    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>> {
        Ok(BTreeMap::new())
    }
}

/// Opens `cpu`, `auto`, or an adapter by name or index.
///
/// # Errors
/// When there is no such adapter.
pub fn open_engine(device: &str) -> Result<Box<dyn Engine>> {
    if device == "cpu" {
        return Ok(Box::new(CpuEngine::default()));
    }
    Ok(Box::new(GpuEngine::new(crate::Gpu::open(device)?)))
}

/// Loss planes of a step: colour channels 0..3, then feature channels 3..6 where they have weight.
pub(crate) fn planes(view: &View, options: &StepOptions) -> Vec<Plane> {
    let [width, height] = view.size;
    let per_pixel = 1.0 / (3.0 * width as f32 * height as f32);
    let weight = |c: u32| if c < 3 { 1.0 } else { options.feature_weight };
    (0..6)
        .filter(|c| weight(*c) > 0.0)
        .map(|channel| Plane { width, height, channel, scale: weight(channel) * per_pixel, lambda: options.lambda, unused: [0; 3] })
        .collect()
}

/// Losses from the run sums `[6][runs][w]` of SSIM and L1.
pub(crate) fn losses_of(view: &View, ssim: &[f32], l1: &[f32]) -> Losses {
    let per_channel = view.size[1].div_ceil(RUN as u32) as usize * view.size[0] as usize;
    let mean = |sums: &[f32], from: usize| {
        let part = &sums[from * per_channel..(from + 3) * per_channel];
        part.iter().map(|v| f64::from(*v)).sum::<f64>() / (3.0 * view.pixels() as f64)
    };
    Losses { color_l1: mean(l1, 0), color_ssim: mean(ssim, 0), feature_l1: mean(l1, 3) }
}

/// The twins, for machines without Vulkan and for finding a wrong pass.
#[derive(Default)]
pub struct CpuEngine {
    params: Vec<f32>,
    moments: (Vec<f32>, Vec<f32>),
    stats: Vec<f32>,
    gradients: Vec<f32>,
    targets: HashMap<usize, Vec<f32>>,
    last: Option<(View, Vec<f32>, Vec<f32>)>,
}

/// Everything the backward passes need of a forward run.
pub(crate) struct Forward {
    view: View,
    pub splats: Vec<Splat>,
    touched: Vec<u32>,
    first_pair: Vec<u32>,
    pub ranges: Vec<u32>,
    pub sorted_pairs: Vec<u32>,
    pub pair_gaussians: Vec<u32>,
    frame: Vec<f32>,
}

/// Stable sort of `keys` by their lowest `bits`, with what was at which place before.
pub(crate) fn radix_sort_cpu(keys: &mut Vec<u32>, bits: u32) -> Vec<u32> {
    let n = keys.len();
    let mut values: Vec<u32> = vec![0; n];
    let (mut keys_out, mut values_out) = (vec![0; n], vec![0; n]);
    let (mut histogram, mut totals) = (vec![0; 256 * CHUNKS], vec![0; CHUNKS + 1]);
    for (round, shift) in (0..bits).step_by(8).enumerate() {
        let job = Job { n: n as u32, shift, first: u32::from(round == 0), unused: 0 };
        cpu::radix_count(&job, keys, &mut histogram);
        let scan = Job { n: histogram.len() as u32, ..job };
        cpu::scan_chunks(&scan, &histogram, &mut totals);
        cpu::scan_apply(&scan, &mut histogram, &mut totals);
        cpu::radix_scatter(&job, keys, &values, &mut histogram, &mut keys_out, &mut values_out);
        std::mem::swap(keys, &mut keys_out);
        std::mem::swap(&mut values, &mut values_out);
    }
    values
}

/// Bits of the largest tile number and of the one after it, which marks padding.
pub(crate) fn tile_bits(view: &View) -> u32 {
    32 - view.tile_count().leading_zeros()
}

impl CpuEngine {
    fn forward(&self, view: View) -> Forward {
        let mut f = Self::lists_of(&self.params, view);
        f.frame = vec![0.0; 8 * view.pixels()];
        cpu::blend(&f.view, &f.ranges, &f.sorted_pairs, &f.pair_gaussians, &f.splats, &mut f.frame);
        f
    }

    /// Everything up to blending.
    pub(crate) fn lists_of(params: &[f32], mut view: View) -> Forward {
        let n = view.gaussians as usize;
        let mut splats = vec![[[0.0; 4]; 3]; n];
        let (mut depths, mut footprints, mut touched) = (vec![0; n], vec![[[0.0; 4]; 2]; n], vec![0; n]);
        cpu::project(&view, params, &mut splats, &mut depths, &mut footprints, &mut touched);
        let order = radix_sort_cpu(&mut depths, 24);
        let mut offsets = vec![0; n];
        cpu::gather_counts(&view, &order, &touched, &mut offsets);
        let mut totals = vec![0; CHUNKS + 1];
        let job = Job { n: n as u32, shift: 0, first: 0, unused: 0 };
        cpu::scan_chunks(&job, &offsets, &mut totals);
        cpu::scan_apply(&job, &mut offsets, &mut totals);
        view.pairs = totals[CHUNKS];
        let pairs = view.pairs as usize;
        let (mut tiles, mut pair_gaussians, mut first_pair) = (vec![0; pairs], vec![0; pairs], vec![0; n]);
        cpu::emit(&view, &order, &offsets, &footprints, &mut touched, &mut tiles, &mut pair_gaussians, &mut first_pair);
        let sorted_pairs = radix_sort_cpu(&mut tiles, tile_bits(&view));
        let mut ranges = vec![0; 2 * view.tile_count() as usize];
        cpu::tile_ranges(&view, &tiles, &mut ranges);
        Forward { view, splats, touched, first_pair, ranges, sorted_pairs, pair_gaussians, frame: Vec::new() }
    }
}

impl Engine for CpuEngine {
    fn name(&self) -> String {
        "cpu".to_owned()
    }

    fn len(&self) -> usize {
        self.params.len() / CHANNELS
    }

    fn set_state(&mut self, params: &[f32], moment1: &[f32], moment2: &[f32]) -> Result<()> {
        self.params = params.to_vec();
        self.moments = (moment1.to_vec(), moment2.to_vec());
        self.stats = vec![0.0; 2 * self.len()];
        self.gradients = vec![0.0; params.len()];
        Ok(())
    }

    fn params(&self) -> Result<Vec<f32>> {
        Ok(self.params.clone())
    }

    fn moments(&self) -> Result<(Vec<f32>, Vec<f32>)> {
        Ok(self.moments.clone())
    }

    fn stats(&self) -> Result<Vec<f32>> {
        Ok(self.stats.clone())
    }

    fn set_stats(&mut self, stats: &[f32]) -> Result<()> {
        self.stats = stats.to_vec();
        Ok(())
    }

    fn gradients(&self) -> Result<Vec<f32>> {
        Ok(self.gradients.clone())
    }

    fn set_target(&mut self, id: usize, target: &[f32]) -> Result<()> {
        self.targets.insert(id, target.to_vec());
        Ok(())
    }

    fn render(&mut self, view: View) -> Result<Frame> {
        let f = self.forward(view);
        Ok(Frame { width: view.size[0], height: view.size[1], data: f.frame, pairs: f.view.pairs })
    }

    fn step(&mut self, view: View, id: usize, options: StepOptions, step: &Step) -> Result<()> {
        let f = self.forward(view);
        let target = self.targets.get(&id).filter(|t| t.len() == 6 * view.pixels());
        let target = target.ok_or_else(|| Error::Invalid(format!("no target {id} of {}x{}", view.size[0], view.size[1])))?;
        let n = view.pixels();
        let sums = 6 * view.size[1].div_ceil(RUN as u32) as usize * view.size[0] as usize;
        let (mut rows, mut partials, mut gradient) = (vec![0.0; 5 * n], vec![0.0; 3 * n], vec![0.0; 6 * n]);
        let (mut ssim, mut l1) = (vec![0.0; sums], vec![0.0; sums]);
        for plane in planes(&view, &options) {
            cpu::ssim_rows(&plane, &f.frame, target, &mut rows);
            cpu::ssim_columns(&plane, &rows, &mut partials, &mut ssim);
            cpu::ssim_backward_rows(&plane, &partials, &mut rows);
            cpu::loss_gradient(&plane, &f.frame, target, &rows, &mut gradient, &mut l1);
        }
        let mut slots = vec![[[0.0; 4]; 3]; f.view.pairs as usize];
        cpu::blend_backward(&f.view, &f.ranges, &f.sorted_pairs, &f.pair_gaussians, &f.splats, &f.frame, &gradient, &mut slots);
        cpu::project_backward(&f.view, &self.params, &f.splats, &f.touched, &f.first_pair, &slots, &mut self.gradients, &mut self.stats);
        cpu::adam(step, &self.gradients, &mut self.params, &mut self.moments.0, &mut self.moments.1);
        self.last = Some((view, ssim, l1));
        Ok(())
    }

    fn losses(&self) -> Result<Losses> {
        Ok(self.last.as_ref().map(|(view, ssim, l1)| losses_of(view, ssim, l1)).unwrap_or_default())
    }
}
