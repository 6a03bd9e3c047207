//! Uniforms of the passes and their twins, with the layouts of the structures in `shaders/`.

use bytemuck::{Pod, Zeroable};
use fastlgs_core::Camera;
use fastlgs_core::gaussians::BASE_CHANNELS;

/// Tile edge in pixels.
pub const TILE: u32 = 8;

/// Transmittance below which a rendered pixel ignores what lies behind.
const TRANSMITTANCE_MIN: f32 = 0.0001;
/// The same for a training step: half a grey level of a white background.
const TRANSMITTANCE_TRAINED: f32 = 1.0 / 512.0;

/// Value of [`View::depth_as_feature`] for depth moments.
pub(crate) const DEPTH_MOMENTS: u32 = 2;

/// Camera and sizes of one frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct View {
    /// World to camera, column-major.
    pub(crate) world_to_camera: [f32; 16],
    /// Focal lengths in pixels.
    pub(crate) focal: [f32; 2],
    /// Principal point in pixels.
    pub(crate) centre: [f32; 2],
    /// Image size in pixels.
    pub(crate) size: [u32; 2],
    /// Image size in tiles.
    pub(crate) tiles: [u32; 2],
    /// Background colour; the last entry is unused.
    pub(crate) background_color: [f32; 4],
    /// Background feature; the last entry is unused.
    pub(crate) background_feature: [f32; 4],
    /// Position of the camera in the world; the last entry is unused.
    pub(crate) camera: [f32; 4],
    /// Number of Gaussians.
    pub(crate) gaussians: u32,
    /// Number of (tile, Gaussian) pairs, once they are counted.
    pub(crate) pairs: u32,
    /// First Gaussian of the bound page.
    pub(crate) first: u32,
    /// Number of Gaussians of the bound page.
    pub(crate) page: u32,
    /// First pair of the bound window of gradient slots.
    pub(crate) slot_first: u32,
    /// Number of pairs whose Gaussians start in that window.
    pub(crate) slot_count: u32,
    /// SH degree of the colour in use.
    pub(crate) sh_degree: u32,
    /// 1: opacity compensates for dilation (2-D Mip filter).
    pub(crate) antialias: u32,
    /// 1: the first feature channel is the depth z. 2: the features are ln z, its square, and 1.
    pub(crate) depth_as_feature: u32,
    /// Transmittance below which a pixel ignores further Gaussians.
    pub(crate) min_transmittance: f32,
    /// A step drops each Gaussian with the probability `dropped` / 2^32.
    pub(crate) dropped: u32,
    /// Seed that selects the dropped Gaussians.
    pub(crate) draw: u32,
    /// Length of the runs of pairs in which `fold_slots` sums a Gaussian's slots; 1 if it does not
    /// run.
    pub(crate) fold_length: u32,
    /// 1: Gaussians of transparent objects are drawn with an opacity of 0.9, to show which objects
    /// are where. Their logit is at most [`fastlgs_core::gaussians::TRANSPARENT_LOGIT`].
    pub(crate) solid: u32,
    /// Padding to 16 bytes.
    pub(crate) unused: [u32; 2],
}

impl View {
    /// Returns the view of `camera` for `gaussians` Gaussians with SH degree `sh_degree`, on a
    /// black background.
    pub fn new(camera: &Camera, gaussians: usize, sh_degree: u32) -> Self {
        Self {
            world_to_camera: camera.world_to_camera.to_cols_array(),
            focal: [camera.fx, camera.fy],
            centre: [camera.cx, camera.cy],
            size: [camera.width, camera.height],
            tiles: [camera.width.div_ceil(TILE), camera.height.div_ceil(TILE)],
            background_color: [0.0; 4],
            background_feature: [0.0; 4],
            camera: camera.centre().extend(0.0).to_array(),
            gaussians: gaussians as u32,
            pairs: 0,
            first: 0,
            page: gaussians as u32,
            slot_first: 0,
            slot_count: u32::MAX / 2,
            sh_degree,
            antialias: 0,
            depth_as_feature: 0,
            min_transmittance: TRANSMITTANCE_MIN,
            dropped: 0,
            draw: 0,
            fold_length: 1,
            solid: 0,
            unused: [0; 2],
        }
    }

    /// Returns the view with or without the 2-D Mip filter: opacity compensates for dilation.
    #[must_use]
    pub fn with_antialias(self, on: bool) -> Self {
        Self {
            antialias: u32::from(on),
            ..self
        }
    }

    /// Returns the view with the depth of each Gaussian as its first feature channel.
    #[must_use]
    pub fn with_depth_as_feature(self) -> Self {
        Self {
            depth_as_feature: 1,
            ..self
        }
    }

    /// Returns the view with ln z, (ln z)^2 and 1 as features, z being the depth of each Gaussian.
    /// From their blended values, the depth loss computes its gradient.
    #[must_use]
    pub fn with_depth_moments(self) -> Self {
        Self {
            depth_as_feature: DEPTH_MOMENTS,
            ..self
        }
    }

    /// Returns the view with the Gaussians of transparent objects
    /// ([`fastlgs_core::gaussians::TRANSPARENT_LOGIT`]) drawn as opaque ones, or not drawn.
    #[must_use]
    pub fn with_transparent_as_solid(self, on: bool) -> Self {
        Self {
            solid: u32::from(on),
            ..self
        }
    }

    /// Returns the view on a background of this colour.
    #[must_use]
    pub fn with_background(self, [r, g, b]: [f32; 3]) -> Self {
        Self {
            background_color: [r, g, b, 0.0],
            ..self
        }
    }

    /// Returns the view for a training step, which ignores the last half of a grey level.
    #[must_use]
    pub fn for_training(self) -> Self {
        Self {
            min_transmittance: TRANSMITTANCE_TRAINED,
            ..self
        }
    }

    /// Returns the view with a share of the Gaussians dropped, at most 0.9; `draw` is the seed.
    #[must_use]
    pub fn with_dropout(self, share: f32, draw: u32) -> Self {
        Self {
            dropped: (f64::from(share.clamp(0.0, 0.9)) * 4_294_967_296.0) as u32,
            draw,
            ..self
        }
    }

    /// Returns the factor on the remaining opacities that compensates for dropped Gaussians, up to
    /// the largest alpha.
    pub(crate) fn kept_gain(&self) -> f32 {
        1.0 / (1.0 - self.dropped as f32 / 4_294_967_296.0)
    }

    /// Returns the image size in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Returns the SH degree of the colour in use.
    pub fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// Returns the number of pixels of the frame.
    pub fn pixels(&self) -> usize {
        (self.size[0] * self.size[1]) as usize
    }

    /// Returns the number of pixels of the frame padded to whole tiles, as on the device.
    pub fn padded_pixels(&self) -> usize {
        (self.tile_count() * TILE * TILE) as usize
    }

    /// Returns the index of a pixel in a padded plane.
    pub(crate) fn index_of(&self, x: u32, y: u32) -> usize {
        (y * self.tiles[0] * TILE + x) as usize
    }

    /// Returns the planes in the padded layout of the device; the padding is zero.
    pub(crate) fn padded<T: Copy + Default>(&self, planes: &[T]) -> Vec<T> {
        let [w, h] = self.size.map(|s| s as usize);
        let mut out = vec![T::default(); planes.len() / (w * h) * self.padded_pixels()];
        for (plane, from) in out
            .chunks_exact_mut(self.padded_pixels())
            .zip(planes.chunks_exact(w * h))
        {
            for (y, row) in from.chunks_exact(w).enumerate() {
                let at = self.index_of(0, y as u32);
                plane[at..at + w].copy_from_slice(row);
            }
        }
        out
    }

    /// Returns the number of tiles of the frame.
    pub fn tile_count(&self) -> u32 {
        self.tiles[0] * self.tiles[1]
    }
}

/// Uniform of the Adam pass.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Step {
    /// Stride of the page's channels, in groups of four floats.
    pub quads: u32,
    /// Bias correction of the first moment: 1 - 0.9^t.
    pub correction1: f32,
    /// Bias correction of the second moment: 1 - 0.999^t.
    pub correction2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// First trained channel.
    pub first_channel: u32,
    /// The channel after the last trained one.
    pub end_channel: u32,
    /// Weight of the sum of opacities in the loss.
    pub opacity_weight: f32,
    /// Number of first Gaussians that do not change.
    pub frozen: u32,
    /// Learning rates of the base channels, then that of all SH coefficients above degree 0.
    pub rates: [f32; 20],
}

/// Learning rates of the base channels, then that of all SH coefficients above degree 0.
pub type Rates = [f32; BASE_CHANNELS + 1];

impl Step {
    /// Returns step number `t` (from 1) over the channels of `range` with the given learning rates.
    pub fn new(t: u32, range: std::ops::Range<usize>, rates: &Rates) -> Self {
        let mut all = [0.0; 20];
        all[..rates.len()].copy_from_slice(rates);
        let correction = |beta: f64| (1.0 - beta.powi(t as i32)) as f32;
        Self {
            quads: 0,
            correction1: correction(0.9),
            correction2: correction(0.999),
            epsilon: 1e-15,
            first_channel: range.start as u32,
            end_channel: range.end as u32,
            opacity_weight: 0.0,
            frozen: 0,
            rates: all,
        }
    }
}

/// Uniform of the loss passes; `shaders/shared/window.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Plane {
    /// Image size in pixels.
    pub size: [u32; 2],
    /// Quads of four pixels in a padded row.
    pub quads: u32,
    /// Number of padded rows.
    pub rows: u32,
    /// Channel of the frame.
    pub channel: u32,
    /// Loss weight of one pixel of this channel.
    pub scale: f32,
    /// Weight of D-SSIM against L1, 0 to 1.
    pub lambda: f32,
    /// Gain of the view's exposure.
    pub gain: f32,
    /// Offset of the view's exposure.
    pub offset: f32,
    /// Padding to 16 bytes.
    pub unused: [u32; 3],
}

/// Planes that the loss passes process at once; `shaders/shared/window.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Planes {
    /// One plane for each z of the workgroups.
    pub each: [Plane; 6],
    /// Number of planes.
    pub count: u32,
    /// Padding to 16 bytes.
    pub unused: [u32; 3],
}

impl Planes {
    /// Returns the uniform of at most six planes.
    pub(crate) fn new(planes: &[Plane]) -> Self {
        let mut all: Self = Zeroable::zeroed();
        all.each[..planes.len()].copy_from_slice(planes);
        Self {
            count: planes.len() as u32,
            ..all
        }
    }
}

/// Uniform of `shaders/depth_gradient.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct DepthLoss {
    /// Image size in pixels.
    pub size: [u32; 2],
    /// Quads of four pixels in a padded row.
    pub quads: u32,
    /// Number of padded rows.
    pub rows: u32,
    /// Loss weight of one pixel.
    pub scale: f32,
    /// Padding to 16 bytes.
    pub unused: [u32; 3],
}

impl DepthLoss {
    /// Returns the uniform of a view whose mean depth loss has this weight.
    pub(crate) fn new(view: &View, weight: f32) -> Self {
        Self {
            size: view.size,
            quads: 2 * view.tiles[0],
            rows: TILE * view.tiles[1],
            scale: weight / view.pixels() as f32,
            unused: [0; 3],
        }
    }
}

/// Uniform of sorting and scanning; `shaders/shared/chunks.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct ChunkJob {
    /// Number of items.
    pub n: u32,
    /// Shift of the radix digit in bits.
    pub shift: u32,
    /// 1: values are 0, 1, 2, ... and not read.
    pub first: u32,
    /// Number of chunks of items.
    pub chunks: u32,
}

/// Returns the distance between the channels of a page of `n` Gaussians;
/// `shaders/shared/channels.wgsl`.
pub fn stride(n: usize) -> usize {
    n.next_multiple_of(4)
}
