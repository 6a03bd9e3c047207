//! CPU twins: one plain function for each WGSL pass, of the same name, on the same buffers in the same order.
//!
//! They are the reference of the parity tests and the engine of `--device cpu`.

mod adam;
mod blend;
mod blend_backward;
mod emit;
mod footprint;
mod gather_counts;
mod loss_gradient;
mod project;
mod project_backward;
mod radix_count;
mod radix_scatter;
mod scan_apply;
mod scan_chunks;
mod ssim_backward_rows;
mod ssim_columns;
mod ssim_rows;
mod tile_ranges;

pub use adam::adam;
pub use blend::blend;
pub(crate) use blend::pixels_of;
pub use blend_backward::blend_backward;
pub use emit::emit;
pub use footprint::Footprint;
pub use gather_counts::gather_counts;
pub use loss_gradient::loss_gradient;
pub use project::project;
pub use project_backward::project_backward;
pub use radix_count::radix_count;
pub use radix_scatter::radix_scatter;
pub use scan_apply::scan_apply;
pub use scan_chunks::scan_chunks;
pub use ssim_backward_rows::ssim_backward_rows;
pub use ssim_columns::ssim_columns;
pub use ssim_rows::ssim_rows;
pub use tile_ranges::tile_ranges;

/// Invocations of the serial-chunk passes; `shaders/shared/chunks.wgsl`.
pub const CHUNKS: usize = 256;

/// Outputs of one invocation of the loss passes; `shaders/shared/window.wgsl`.
pub const RUN: usize = 8;

/// What blending reads of one projected Gaussian; `shaders/project.wgsl`.
pub type Splat = [[f32; 4]; 3];

pub(crate) const ALPHA_MIN: f32 = 1.0 / 255.0;
pub(crate) const ALPHA_MAX: f32 = 0.99;
pub(crate) const TRANSMITTANCE_MIN: f32 = 0.0001;
pub(crate) const DILATION: f32 = 0.3;
pub(crate) const NEAR: f32 = 0.05;

/// The contiguous part of `n` items that invocation `t` owns.
pub(crate) fn chunk(n: usize, t: usize) -> std::ops::Range<usize> {
    let length = n.div_ceil(CHUNKS);
    (t * length).min(n)..((t + 1) * length).min(n)
}

/// Alpha of a splat at offset (dx, dy) from its mean; 0 where it is not drawn.
pub(crate) fn alpha(splat: &Splat, dx: f32, dy: f32, transmittance: f32) -> f32 {
    let power = dx * (splat[0][2] * dx + splat[0][3] * dy) + splat[1][0] * dy * dy;
    let alpha = splat[1][1] * power.exp2();
    if alpha >= ALPHA_MIN && transmittance >= TRANSMITTANCE_MIN { alpha } else { 0.0 }
}

/// Geometry of one projected Gaussian; `shaders/shared/covariance.wgsl`.
pub(crate) mod covariance {
    use crate::View;
    use glam::{Mat3, Mat4, Vec2, Vec3};

    /// World to camera rotation, its rows being the camera axes.
    pub fn world(view: &View) -> Mat3 {
        Mat3::from_mat4(Mat4::from_cols_array(&view.world_to_camera))
    }

    /// x/z and y/z, clamped to 1.3 x the image's half extent.
    pub fn clamped_slope(t: Vec3, view: &View) -> Vec2 {
        let (focal, centre) = (Vec2::from(view.focal), Vec2::from(view.centre));
        let size = Vec2::new(view.size[0] as f32, view.size[1] as f32);
        (t.truncate() / t.z).clamp(-1.3 * centre / focal, 1.3 * (size - centre) / focal)
    }

    /// The two rows of J W.
    pub fn affine(t: Vec3, view: &View) -> [Vec3; 2] {
        let slope = clamped_slope(t, view);
        let w = world(view);
        let (x, y, z) = (w.row(0), w.row(1), w.row(2));
        [view.focal[0] / t.z * (x - slope.x * z), view.focal[1] / t.z * (y - slope.y * z)]
    }
}
