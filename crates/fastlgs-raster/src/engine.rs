//! One interface for the GPU and the fast CPU backend.

use crate::channels::Channels;
use crate::cpu::RUN;
use crate::density::State;
use crate::view::{Plane, Step, View};
use crate::{Error, Result};
use fastlgs_core::Shares;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A rendered frame, planar.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `[8][h][w]`: r, g, b, f0, f1, f2, transmittance left, pairs walked. Channels that were not asked for are zero.
    pub data: Vec<f32>,
    /// (tile, Gaussian) pairs of the frame.
    pub pairs: u32,
}

/// Whether a channel of [`Frame`] is rendered.
pub(crate) fn rendered(channels: Channels, channel: usize) -> bool {
    match channel {
        0..3 => channels.color(),
        3..6 => channels.feature(),
        _ => true,
    }
}

impl Frame {
    /// The frame of a view, all 0.
    pub(crate) fn new(view: &View) -> Self {
        Self { width: view.size[0], height: view.size[1], data: vec![0.0; 8 * view.pixels()], pairs: view.pairs }
    }

    /// The frame of a view from rows (of a channel and y) that begin at its left border; only what was rendered is copied.
    pub(crate) fn gathered<'a>(view: &View, channels: Channels, row: impl Fn(usize, u32) -> &'a [f32] + Sync) -> Self {
        let (mut frame, w) = (Self::new(view), view.size[0] as usize);
        let planes = frame.data.par_chunks_exact_mut(view.pixels()).enumerate();
        planes.filter(|(channel, _)| rendered(channels, *channel)).for_each(|(channel, plane)| {
            for (y, out) in plane.chunks_exact_mut(w).enumerate() {
                out.copy_from_slice(&row(channel, y as u32)[..w]);
            }
        });
        frame
    }

    /// Channels `from..to` as one planar slice.
    pub fn channels(&self, from: usize, to: usize) -> &[f32] {
        let n = (self.width * self.height) as usize;
        &self.data[from * n..to * n]
    }
}

/// What a view should look like, in 8 bits a channel.
#[derive(Clone, Debug, Default)]
pub struct TargetImage {
    /// Pixels along x and y.
    pub size: [u32; 2],
    /// [`pack`]ed colours, row by row.
    pub color: Vec<u32>,
    /// [`pack`]ed features (0 to 1 as 0 to 255), row by row; may be empty where features are not trained.
    pub feature: Vec<u32>,
}

/// A pixel of a target; one that does not count is left out of the loss.
pub fn pack(values: [u8; 3], counts: bool) -> u32 {
    u32::from_le_bytes([values[0], values[1], values[2], if counts { 255 } else { 0 }])
}

impl TargetImage {
    /// Bytes of its planes.
    pub(crate) fn bytes(&self) -> usize {
        4 * (self.color.len() + self.feature.len())
    }

    /// `[2][padded rows][padded columns]`, as it lies on the device; pixels without feature do not count.
    pub(crate) fn padded(&self, view: &View) -> Vec<u32> {
        let mut planes = self.color.clone();
        planes.extend(&self.feature);
        planes.resize(2 * self.color.len(), 0);
        view.padded(&planes)
    }
}

/// Affine exposure of a view for each colour: the photo is compared with gain * rendered + offset.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Exposure {
    /// Factors of red, green and blue.
    pub gain: [f32; 3],
    /// Summands of red, green and blue.
    pub offset: [f32; 3],
}

impl Default for Exposure {
    fn default() -> Self {
        Self { gain: [1.0; 3], offset: [0.0; 3] }
    }
}

/// What a training step does.
#[derive(Clone, Copy, Debug)]
pub struct StepOptions {
    /// What is trained.
    pub channels: Channels,
    /// Share of D-SSIM (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss.
    pub feature_weight: f32,
    /// Exposure of the view.
    pub exposure: Exposure,
}

/// Loss of the last step, and its gradients by what is not stored with the Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    /// Mean absolute error of colour.
    pub color_l1: f64,
    /// Mean SSIM of colour.
    pub color_ssim: f64,
    /// Mean absolute error of the feature.
    pub feature_l1: f64,
    /// By the exposure's gains.
    pub by_gain: [f64; 3],
    /// By the exposure's offsets.
    pub by_offset: [f64; 3],
    /// By the background's colour and feature.
    pub by_background: [f64; 6],
}

/// Runs the passes.
pub trait Engine: Send {
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
    fn set_state(&mut self, state: &State) -> Result<()>;
    /// Trained values and moments.
    ///
    /// # Errors
    /// When the device failed.
    fn state(&self) -> Result<State>;
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
    /// Gradient of the last step, laid out like the state's values; zero where nothing was trained.
    ///
    /// # Errors
    /// When the device failed.
    fn gradients(&self) -> Result<Vec<f32>>;
    /// Keeps a target on the device.
    ///
    /// # Errors
    /// When it does not fit.
    fn set_target(&mut self, id: usize, target: TargetImage) -> Result<()>;
    /// Keeps it no longer.
    fn forget_target(&mut self, id: usize);
    /// Renders a frame; `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// When it does not fit or the device failed.
    fn render(&mut self, view: View, channels: Channels) -> Result<Frame>;
    /// Blending weights of a frame summed by the Gaussians' object ids; `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// As [`Self::render`], and when there is not one id a Gaussian.
    fn render_ids(&mut self, view: View, ids: &[u16]) -> Result<Shares>;
    /// One training step towards target `id`: forward, loss, backward, Adam. With [`Channels::Feature`] geometry must
    /// stay as it was since the last [`Self::set_state`].
    ///
    /// # Errors
    /// As [`Self::render`].
    fn step(&mut self, view: View, id: usize, options: &StepOptions, step: &Step) -> Result<()>;
    /// Losses of the last step.
    ///
    /// # Errors
    /// When the device failed.
    fn losses(&self) -> Result<Losses>;
    /// Bytes that the engine holds for itself now, and of these what Gaussians, moments and key lists take.
    fn memory(&self) -> Memory;
    /// Starts or stops taking the time of each pass; false where the device cannot.
    fn set_profiling(&mut self, on: bool) -> bool;
    /// Seconds of each pass since the last call, while profiling.
    ///
    /// # Errors
    /// When the device failed.
    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>>;
}

/// Refuses ids that do not belong to the Gaussians of the view.
pub(crate) fn check_ids(view: &View, ids: &[u16], n: usize) -> Result<()> {
    if view.gaussians as usize != n || ids.len() != n || n == 0 {
        let reason = format!("the view was made for {} Gaussians, there are {} ids, the device holds {n}", view.gaussians, ids.len());
        return Err(Error::Invalid(reason));
    }
    Ok(())
}

/// Bytes that an engine holds.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct Memory {
    /// Trained values and both moments.
    pub state: u64,
    /// Key lists: what sorting needs, and the gradient slots of the (tile, Gaussian) pairs.
    pub lists: u64,
    /// Everything else for Gaussians: gradients, splats, footprints, counts.
    pub gaussians: u64,
    /// Frames and what the loss needs.
    pub frame: u64,
    /// Targets and cached lists of views.
    pub views: u64,
}

/// Loss planes of a step: colour channels 0..3 and feature channels 3..6, as far as they are trained.
pub(crate) fn planes(view: &View, options: &StepOptions) -> Vec<Plane> {
    let per_pixel = 1.0 / (3.0 * view.pixels() as f32);
    let trained = |c: &usize| if *c < 3 { options.channels.color() } else { options.channels.feature() };
    (0..6usize)
        .filter(trained)
        .map(|channel| Plane {
            size: view.size,
            quads: 2 * view.tiles[0],
            rows: RUN as u32 * view.tiles[1],
            channel: channel as u32,
            scale: if channel < 3 { per_pixel } else { options.feature_weight * per_pixel },
            lambda: options.lambda,
            gain: if channel < 3 { options.exposure.gain[channel] } else { 1.0 },
            offset: if channel < 3 { options.exposure.offset[channel] } else { 0.0 },
            unused: [0; 3],
        })
        .collect()
}

/// Losses from the sums of `shaders/ssim_columns.wgsl` and `shaders/loss_gradient.wgsl`.
pub(crate) fn losses_of(view: &View, channels: Channels, ssim: &[f32], sums: &[f32]) -> Losses {
    let per_channel = (view.tiles[1] * view.tiles[0] * RUN as u32) as usize;
    let sum = |sums: &[f32], plane: usize| -> f64 {
        let part = &sums[plane * per_channel..(plane + 1) * per_channel];
        part.iter().map(|v| f64::from(*v)).sum()
    };
    let mean = |sums: &[f32], from: usize| (from..from + 3).map(|p| sum(sums, p)).sum::<f64>() / (3.0 * view.pixels() as f64);
    let (color, feature) = (channels.color(), channels.feature());
    let three = |from: usize| if color { [0, 1, 2].map(|c| sum(sums, from + c)) } else { [0.0; 3] };
    let trained = |c: usize| if c < 3 { color } else { feature };
    Losses {
        color_l1: if color { mean(sums, 0) } else { 0.0 },
        color_ssim: if color { mean(ssim, 0) } else { 0.0 },
        feature_l1: if feature { mean(sums, 3) } else { 0.0 },
        by_gain: three(6),
        by_offset: three(12),
        by_background: std::array::from_fn(|c| if trained(c) { sum(sums, 18 + c) } else { 0.0 }),
    }
}

/// Bits of the largest tile number and of the one after it, which marks padding.
pub(crate) fn tile_bits(view: &View) -> u32 {
    32 - view.tile_count().leading_zeros()
}
