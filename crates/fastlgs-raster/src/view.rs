//! Uniforms shared by kernels and twins; the same bytes as `shaders/shared/view.wgsl` and `shaders/adam.wgsl`.

use bytemuck::{Pod, Zeroable};
use fastlgs_core::Camera;

/// Tile edge in pixels.
pub const TILE: u32 = 8;

/// Camera and sizes of one frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct View {
    /// World to camera, column-major.
    pub world_to_camera: [f32; 16],
    /// Focal lengths in pixels.
    pub focal: [f32; 2],
    /// Principal point in pixels.
    pub centre: [f32; 2],
    /// Pixels.
    pub size: [u32; 2],
    /// Tiles.
    pub tiles: [u32; 2],
    /// Colour behind everything.
    pub background_color: [f32; 4],
    /// Feature behind everything.
    pub background_feature: [f32; 4],
    /// Number of Gaussians.
    pub gaussians: u32,
    /// Number of (tile, Gaussian) pairs, once known.
    pub pairs: u32,
    /// 1: the first feature channel carries the depth.
    pub depth_as_feature: u32,
    /// 1: the feature loss also moves geometry.
    pub feature_moves_geometry: u32,
}

impl View {
    /// The frame of `camera` for `gaussians` Gaussians before a black background.
    pub fn new(camera: &Camera, gaussians: usize) -> Self {
        Self {
            world_to_camera: camera.world_to_camera.to_cols_array(),
            focal: [camera.fx, camera.fy],
            centre: [camera.cx, camera.cy],
            size: [camera.width, camera.height],
            tiles: [camera.width.div_ceil(TILE), camera.height.div_ceil(TILE)],
            background_color: [0.0; 4],
            background_feature: [0.0; 4],
            gaussians: gaussians as u32,
            pairs: 0,
            depth_as_feature: 0,
            feature_moves_geometry: 0,
        }
    }

    /// Pixels of the frame.
    pub fn pixels(&self) -> usize {
        (self.size[0] * self.size[1]) as usize
    }

    /// Tiles of the frame.
    pub fn tile_count(&self) -> u32 {
        self.tiles[0] * self.tiles[1]
    }
}

/// Uniform of the Adam pass.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Step {
    /// Number of Gaussians.
    pub n: u32,
    /// 1 - 0.9^t.
    pub correction1: f32,
    /// 1 - 0.999^t.
    pub correction2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// Learning rate of each channel (17 used).
    pub rates: [f32; 20],
}

impl Step {
    /// Step number `t` (from 1) with the given learning rates.
    pub fn new(n: usize, t: u32, rates: [f32; fastlgs_core::gaussians::CHANNELS]) -> Self {
        let mut all = [0.0; 20];
        all[..rates.len()].copy_from_slice(&rates);
        let correction = |beta: f64| (1.0 - beta.powi(t as i32)) as f32;
        Self { n: n as u32, correction1: correction(0.9), correction2: correction(0.999), epsilon: 1e-15, rates: all }
    }
}

/// Uniform of the loss passes; `shaders/shared/window.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Plane {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Channel of the frame.
    pub channel: u32,
    /// Loss weight of one pixel of this channel.
    pub scale: f32,
    /// Share of D-SSIM.
    pub lambda: f32,
    /// Padding to 16 bytes.
    pub unused: [u32; 3],
}

/// Uniform of sorting and scanning; `shaders/shared/chunks.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Job {
    /// Number of items.
    pub n: u32,
    /// Shift of the radix digit.
    pub shift: u32,
    /// 1: values are 0, 1, 2, ... instead of read.
    pub first: u32,
    /// Padding.
    pub unused: u32,
}
