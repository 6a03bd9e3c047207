//! The interface of both engines: GPU and CPU.

use crate::channels::Channels;
use crate::cpu::ROWS_PER_INVOCATION;
use crate::density::State;
use crate::lift::Vote;
use crate::view::{Plane, Step, View};
use crate::{Error, Result};
use fastlgs_core::{IdWeights, LabelMap};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A rendered frame in planar layout.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `[8][h][w]`: r, g, b, f0, f1, f2, remaining transmittance, number of pairs that the tile
    /// processed. Channels that were not requested are zero.
    pub data: Vec<f32>,
    /// Number of (tile, Gaussian) pairs of the frame.
    pub pairs: u32,
}

/// Returns whether a channel of [`Frame`] is rendered.
pub(crate) fn rendered(channels: Channels, channel: usize) -> bool {
    channel >= 6 || channels.includes(channel)
}

impl Frame {
    /// Returns a frame of the view's size, filled with 0.
    pub(crate) fn new(view: &View) -> Self {
        Self {
            width: view.size[0],
            height: view.size[1],
            data: vec![0.0; 8 * view.pixels()],
            pairs: view.pairs,
        }
    }

    /// Copies the rendered channels of a view into a frame. `row(channel, y)` returns a row from
    /// the left border on, which may be padded.
    pub(crate) fn gathered<'a>(
        view: &View,
        channels: Channels,
        row: impl Fn(usize, u32) -> &'a [f32] + Sync,
    ) -> Self {
        let (mut frame, w) = (Self::new(view), view.size[0] as usize);
        let planes = frame.data.par_chunks_exact_mut(view.pixels()).enumerate();
        planes
            .filter(|(channel, _)| rendered(channels, *channel))
            .for_each(|(channel, plane)| {
                for (y, out) in plane.chunks_exact_mut(w).enumerate() {
                    out.copy_from_slice(&row(channel, y as u32)[..w]);
                }
            });
        frame
    }

    /// Colour: three planes, row by row.
    pub fn color(&self) -> &[f32] {
        self.channels(0, 3)
    }

    /// Feature: three planes, row by row.
    pub fn feature(&self) -> &[f32] {
        self.channels(3, 6)
    }

    /// Transmittance behind all Gaussians, 0 to 1, row by row.
    pub fn transmittance(&self) -> &[f32] {
        self.channels(6, 7)
    }

    /// Number of Gaussians that were processed for each pixel, row by row.
    pub fn processed(&self) -> &[f32] {
        self.channels(7, 8)
    }

    /// Returns the expected depth of each pixel of a view with the depth as feature
    /// ([`View::with_depth_as_feature`]), in units of the scene: sum of w z / sum of w, with
    /// blending weights w. Pixels with a transmittance of `empty` or more are infinite.
    pub fn depth(&self, empty: f32) -> Vec<f32> {
        let pixels = self.channels(3, 4).iter().zip(self.transmittance());
        let of_pixel = |(z, t): (&f32, &f32)| {
            if *t < empty {
                z / (1.0 - t)
            } else {
                f32::INFINITY
            }
        };
        pixels.map(of_pixel).collect()
    }

    /// Returns the channels `from..to` as one planar slice.
    pub fn channels(&self, from: usize, to: usize) -> &[f32] {
        let n = (self.width * self.height) as usize;
        &self.data[from * n..to * n]
    }
}

/// The image that a view is trained towards, with 8 bits a channel.
#[derive(Clone, Debug, Default)]
pub struct TargetImage {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// [`pack`]ed colours, row by row.
    pub color: Vec<u32>,
    /// [`pack`]ed features (0 to 255 for 0 to 1), row by row; may be empty if features are not
    /// trained.
    pub feature: Vec<u32>,
    /// Depth of the surface, row by row, in units of the scene: 0 where it is unknown, negative
    /// where the depth loss ignores the pixel. May be empty if no step has a depth loss.
    pub depth: Vec<f32>,
}

/// Packs a pixel of a target image. `counts`: whether the loss uses the pixel.
pub fn pack(values: [u8; 3], counts: bool) -> u32 {
    u32::from_le_bytes([
        values[0],
        values[1],
        values[2],
        if counts { 255 } else { 0 },
    ])
}

impl TargetImage {
    /// Returns the size of the planes in bytes.
    pub(crate) fn bytes(&self) -> usize {
        4 * (self.color.len() + self.feature.len() + self.depth.len())
    }

    /// Returns `[2][padded rows][padded columns]`, the layout on the device, and a third plane with
    /// the bits of the depths if there are any. The feature loss ignores pixels without a feature.
    pub(crate) fn padded(&self, view: &View) -> Vec<u32> {
        let mut planes = self.color.clone();
        planes.extend(&self.feature);
        planes.resize(2 * self.color.len(), 0);
        planes.extend(self.depth.iter().map(|depth| depth.to_bits()));
        view.padded(&planes)
    }
}

/// Affine exposure of a view for each colour channel. The photo is compared with
/// gain * rendered + offset.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Exposure {
    /// Factors of red, green and blue.
    pub gain: [f32; 3],
    /// Offsets of red, green and blue.
    pub offset: [f32; 3],
}

impl Default for Exposure {
    fn default() -> Self {
        Self {
            gain: [1.0; 3],
            offset: [0.0; 3],
        }
    }
}

/// Options of a training step.
#[derive(Clone, Copy, Debug)]
pub struct StepOptions {
    /// Channels that are rendered and trained.
    pub channels: Channels,
    /// Weight of D-SSIM against L1, 0 to 1 (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss.
    pub feature_weight: f32,
    /// Exposure of the view.
    pub exposure: Exposure,
    /// Weight of the depth loss, or 0 for none. It replaces the feature loss: the channels must be
    /// [`Channels::Coupled`], and the view needs depth moments as features
    /// ([`View::with_depth_moments`]).
    pub depth_weight: f32,
}

/// Losses of a step, and the gradients of parameters that are not stored with the Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    /// Mean absolute error of colour.
    pub color_l1: f64,
    /// Mean SSIM of colour.
    pub color_ssim: f64,
    /// Mean absolute error of the feature.
    pub feature_l1: f64,
    /// Gradient with respect to the gains of the exposure.
    pub by_gain: [f64; 3],
    /// Gradient with respect to the offsets of the exposure.
    pub by_offset: [f64; 3],
    /// Gradient with respect to the background's colour and feature.
    pub by_background: [f64; 6],
}

/// Renders and trains Gaussians on a device by running all passes.
pub trait Engine: Send {
    /// Returns the name of the device, for reports.
    fn name(&self) -> String;
    /// Returns the number of Gaussians.
    fn len(&self) -> usize;
    /// Returns whether there are no Gaussians.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Replaces the trained values and moments, and clears the statistics.
    ///
    /// # Errors
    /// When the state does not fit the device.
    fn set_state(&mut self, state: &State) -> Result<()>;
    /// Returns the trained values and moments.
    ///
    /// # Errors
    /// When the device failed.
    fn state(&self) -> Result<State>;
    /// Returns the statistics `[2][n]` since the last [`Self::set_state`]: sum of gradient norms,
    /// and how often each Gaussian was drawn (`shaders/project_backward.wgsl`).
    ///
    /// # Errors
    /// When the device failed.
    fn stats(&self) -> Result<Vec<f32>>;
    /// Replaces the statistics.
    ///
    /// # Errors
    /// When the device failed.
    fn set_stats(&mut self, stats: &[f32]) -> Result<()>;
    /// Returns the gradient of the last step, in the layout of the state's values; zero for
    /// channels that are not trained.
    ///
    /// # Errors
    /// When the device failed.
    fn gradients(&self) -> Result<Vec<f32>>;
    /// Stores the target image of view `id` on the device.
    ///
    /// # Errors
    /// When the image does not fit the device.
    fn set_target(&mut self, id: usize, target: TargetImage) -> Result<()>;
    /// Removes the target image of view `id` from the device.
    fn remove_target(&mut self, id: usize);
    /// Renders a frame; `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// When the frame does not fit the device, or the device failed.
    fn render(&mut self, view: View, channels: Channels) -> Result<Frame>;
    /// Sums the blending weights of a frame by object id. `ids` has one id for each Gaussian, and
    /// `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// As [`Self::render`], and when the number of ids is wrong.
    fn render_ids(&mut self, view: View, ids: &[u16]) -> Result<IdWeights>;
    /// Returns the votes of all Gaussians for the labels of a view, sorted by Gaussian and label.
    /// `view.gaussians` must equal [`Self::len`].
    ///
    /// # Errors
    /// As [`Self::render`], and when label map and view differ in size.
    fn votes(&mut self, view: View, labels: &LabelMap) -> Result<Vec<Vote>>;
    /// Adds to `scores`, one for each Gaussian, how much a view changes without it: the sum of
    /// squared changes of colour (0 to 1). Returns the sum of squared differences between the view
    /// and its photo. With a photo, only the pixels that count are used, and changes are scaled by
    /// the gain of its exposure. Without one, all pixels are used as rendered, and the result is 0.
    ///
    /// # Errors
    /// As [`Self::render`], and when photo and view differ in size.
    fn saliency(
        &mut self,
        view: View,
        photo: Option<&ExposedPhoto>,
        scores: &mut [f32],
    ) -> Result<f64>;
    /// Runs one training step towards target `id`: forward, loss, backward, Adam. With
    /// [`Channels::Feature`], geometry must not have changed since the last [`Self::set_state`].
    ///
    /// # Errors
    /// As [`Self::render`].
    fn step(&mut self, view: View, id: usize, options: &StepOptions, step: &Step) -> Result<()>;
    /// Returns the losses of the last step.
    ///
    /// # Errors
    /// When the device failed.
    fn losses(&self) -> Result<Losses>;
    /// Returns the bytes that the engine holds, by purpose.
    fn memory(&self) -> Memory;
    /// Starts or stops measuring the time of each pass. Returns false if the device cannot measure
    /// it.
    fn set_profiling(&mut self, on: bool) -> bool;
    /// Returns the seconds of each pass since the last call, while profiling.
    ///
    /// # Errors
    /// When the device failed.
    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>>;
}

/// A photo, and the exposure with which the scene shows it.
#[derive(Clone, Copy, Debug)]
pub struct ExposedPhoto<'a> {
    /// The photo.
    pub image: &'a TargetImage,
    /// Its exposure.
    pub exposure: Exposure,
}

impl ExposedPhoto<'_> {
    /// Returns the factors on the changes of the colours of pixel `k`: the gains, or 0 if it does
    /// not count.
    pub(crate) fn factors(&self, k: usize) -> [f32; 3] {
        let counts = f32::from(u8::from(self.image.color[k].to_le_bytes()[3] == 255));
        self.exposure.gain.map(|gain| counts * gain)
    }

    /// Returns the squared difference of pixel `k` and the rendered colours.
    pub(crate) fn squared_error(&self, k: usize, rendered: [f32; 3]) -> f64 {
        let bytes = self.image.color[k].to_le_bytes();
        let counts = f32::from(u8::from(bytes[3] == 255));
        let Exposure { gain, offset } = self.exposure;
        (0..3)
            .map(|c| {
                let missed = gain[c] * rendered[c] + offset[c] - f32::from(bytes[c]) / 255.0;
                f64::from(counts * missed * missed)
            })
            .sum()
    }
}

/// Checks that the photo and the scores of [`Engine::saliency`] fit the view.
pub(crate) fn check_saliency(
    view: &View,
    photo: Option<&ExposedPhoto>,
    scores: &[f32],
) -> Result<()> {
    if photo.is_some_and(|photo| photo.image.size != view.size)
        || scores.len() != view.gaussians as usize
    {
        return Err(Error::Invalid(
            "photo and scores must have the sizes of the view".to_owned(),
        ));
    }
    Ok(())
}

/// Checks that view, engine and `ids` have the same number of Gaussians, and more than 0.
pub(crate) fn check_ids(view: &View, ids: &[u16], n: usize) -> Result<()> {
    if view.gaussians as usize != n || ids.len() != n || n == 0 {
        let reason = format!(
            "the view has {} Gaussians, there are {} object ids, and the engine holds {n} Gaussians; all three must be equal",
            view.gaussians,
            ids.len()
        );
        return Err(Error::Invalid(reason));
    }
    Ok(())
}

/// Returns the error of a step with a depth loss towards a target image without depths.
pub(crate) fn no_depth() -> Error {
    Error::Invalid("a step with a depth loss needs a target image with depths".to_owned())
}

/// Bytes that an engine holds, by purpose.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct Memory {
    /// Trained values and both moments.
    pub state: u64,
    /// Buffers of the sorts, and gradient slots of the (tile, Gaussian) pairs.
    pub lists: u64,
    /// Other buffers with one item for each Gaussian: gradients, splats, footprints, counts.
    pub gaussians: u64,
    /// Frames and buffers of the loss.
    pub frame: u64,
    /// Target images and cached tile lists of views.
    pub views: u64,
}

/// Returns the planes of a step's loss: the trained channels among colour (0..3) and feature
/// (3..6).
pub(crate) fn planes(view: &View, options: &StepOptions) -> Vec<Plane> {
    let per_pixel = 1.0 / (3.0 * view.pixels() as f32);
    let has_depth = options.depth_weight > 0.0;
    let trained = |c: &usize| options.channels.includes(*c) && (*c < 3 || !has_depth);
    (0..6usize)
        .filter(trained)
        .map(|channel| Plane {
            size: view.size,
            quads: 2 * view.tiles[0],
            rows: ROWS_PER_INVOCATION as u32 * view.tiles[1],
            channel: channel as u32,
            scale: if channel < 3 {
                per_pixel
            } else {
                options.feature_weight * per_pixel
            },
            lambda: options.lambda,
            gain: if channel < 3 {
                options.exposure.gain[channel]
            } else {
                1.0
            },
            offset: if channel < 3 {
                options.exposure.offset[channel]
            } else {
                0.0
            },
            unused: [0; 3],
        })
        .collect()
}

/// Computes the losses from the sums of `shaders/ssim_columns.wgsl` and
/// `shaders/loss_gradient.wgsl`.
pub(crate) fn losses_from_sums(
    view: &View,
    channels: Channels,
    ssim: &[f32],
    sums: &[f32],
) -> Losses {
    let per_channel = (view.tiles[1] * view.tiles[0] * ROWS_PER_INVOCATION as u32) as usize;
    let sum = |sums: &[f32], plane: usize| -> f64 {
        let part = &sums[plane * per_channel..(plane + 1) * per_channel];
        part.iter().map(|v| f64::from(*v)).sum()
    };
    let mean = |sums: &[f32], from: usize| {
        (from..from + 3).map(|p| sum(sums, p)).sum::<f64>() / (3.0 * view.pixels() as f64)
    };
    let (color, feature) = (channels.color(), channels.feature());
    let three = |from: usize| {
        if color {
            [0, 1, 2].map(|c| sum(sums, from + c))
        } else {
            [0.0; 3]
        }
    };
    Losses {
        color_l1: if color { mean(sums, 0) } else { 0.0 },
        color_ssim: if color { mean(ssim, 0) } else { 0.0 },
        feature_l1: if feature { mean(sums, 3) } else { 0.0 },
        by_gain: three(6),
        by_offset: three(12),
        by_background: std::array::from_fn(|c| {
            if channels.includes(c) {
                sum(sums, 18 + c)
            } else {
                0.0
            }
        }),
    }
}

/// Returns the number of bits of tile numbers. They include the number of tiles itself, which marks
/// unused pairs.
pub(crate) fn tile_bits(view: &View) -> u32 {
    32 - view.tile_count().leading_zeros()
}
