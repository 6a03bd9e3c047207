//! CPU twins: one plain function for each WGSL pass, with the same name and the same buffers in the
//! same order.
//!
//! They are the reference of the parity tests. They can replace the first passes of a frame, to
//! locate a faulty pass (`run`). Functions on a single Gaussian are shared with the CPU engine in
//! `native`.

mod adam;
mod blend;
mod blend_backward;
mod blend_ids;
mod blend_saliency;
mod blend_votes;
mod covariance;
mod depth_gradient;
mod emit;
mod fold_slots;
mod footprint;
mod gather_counts;
mod harmonics;
mod loss_gradient;
mod project;
mod project_backward;
mod radix_count;
mod radix_scatter;
mod random;
mod run;
mod scan_apply;
mod scan_chunks;
mod ssim_backward_rows;
mod ssim_columns;
mod ssim_rows;
mod tile_load;
mod tile_ranges;

pub use adam::adam;
pub(crate) use adam::{adam_step, opacity_penalty};
pub use blend::blend;
pub(crate) use blend::{BATCH, inside_image, pixels_of};
pub use blend_backward::blend_backward;
pub use blend_ids::blend_ids;
pub use blend_saliency::blend_saliency;
pub use blend_votes::blend_votes;
pub use depth_gradient::depth_gradient;
pub(crate) use depth_gradient::depth_gradient_at;
pub use emit::emit;
pub use fold_slots::fold_slots;
pub use footprint::Footprint;
pub(crate) use footprint::span;
pub use gather_counts::gather_counts;
pub use loss_gradient::loss_gradient;
pub use project::project;
pub(crate) use project::{NOT_DRAWN, project_one};
pub(crate) use project_backward::backward_one;
pub use project_backward::project_backward;
pub use radix_count::radix_count;
pub use radix_scatter::radix_scatter;
pub(crate) use random::pcg3d;
pub(crate) use run::run;
pub use scan_apply::scan_apply;
pub use scan_chunks::scan_chunks;
pub use ssim_backward_rows::ssim_backward_rows;
pub use ssim_columns::ssim_columns;
pub use ssim_rows::ssim_rows;
pub use tile_load::tile_load;
pub use tile_ranges::tile_ranges;

use crate::view::{ChunkJob, Plane};

/// Number of rows that one invocation of the loss passes computes; `shaders/shared/columns.wgsl`.
pub const ROWS_PER_INVOCATION: usize = 8;

/// A projected Gaussian as blending reads it; layout in `shaders/project.wgsl`.
pub type Splat = [[f32; 4]; 3];

/// Smallest alpha that is drawn at a pixel: one grey level.
pub(crate) const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Largest alpha.
pub(crate) const ALPHA_MAX: f32 = 0.99;
/// Opacity of a transparent Gaussian if `View::solid` is 1.
pub(crate) const SOLID_OPACITY: f32 = 0.9;
/// log2 of `ALPHA_MAX`: the upper bound of the exponent.
pub(crate) const LOG2_ALPHA_MAX: f32 = -0.014_499_57;
/// Variance in px^2 added to each projected Gaussian, so that none falls between pixels (3DGS).
pub(crate) const DILATION: f32 = 0.3;
/// Smallest depth of a drawn Gaussian, in units of the length of its three scales;
/// `shaders/shared/view.wgsl` gives the reason.
pub(crate) const NEAR: f32 = 0.5;

/// Returns the index ranges of a job's chunks, in order; `shaders/shared/chunks.wgsl`.
pub(crate) fn chunks(job: &ChunkJob) -> impl Iterator<Item = std::ops::Range<usize>> {
    let (n, length) = (job.n as usize, job.n.div_ceil(job.chunks) as usize);
    (0..job.chunks as usize).map(move |t| (t * length).min(n)..((t + 1) * length).min(n))
}

/// Returns colour and feature of a splat.
fn values_of(splat: &Splat) -> [f32; 6] {
    let [_, [_, _, r, g], [b, f0, f1, f2]] = *splat;
    [r, g, b, f0, f1, f2]
}

/// Returns alpha of a splat at the offset (dx, dy) in pixels from its mean; 0 below `ALPHA_MIN`.
pub(crate) fn alpha(splat: &Splat, dx: f32, dy: f32) -> f32 {
    let exponent =
        dx * (splat[0][2] * dx + splat[0][3] * dy) + (splat[1][0] * dy * dy + splat[1][1]);
    let alpha = exponent.exp2().min(ALPHA_MAX);
    if alpha >= ALPHA_MIN { alpha } else { 0.0 }
}

/// Returns 1 if a pixel of a padded plane lies in the image, else 0.
fn inside_plane(plane: &Plane, i: usize, j: usize) -> f32 {
    if i < plane.size[0] as usize && j < plane.size[1] as usize {
        1.0
    } else {
        0.0
    }
}

/// Rendered value x and target value y of one pixel; `shaders/shared/window.wgsl`.
struct Compared {
    x: f32,
    y: f32,
    /// 1 if the pixel enters the loss, else 0.
    weight: f32,
}

/// Returns the rendered value (with exposure applied) and the target of pixel (i, j). A pixel that
/// the loss ignores has y = x.
fn sample(plane: &Plane, frame: &[f32], targets: &[u32], i: usize, j: usize) -> Compared {
    let at = (j * 4 * plane.quads as usize) + i;
    let size = (4 * plane.quads * plane.rows) as usize;
    let inside = inside_plane(plane, i, j);
    let x = inside * (plane.gain * frame[plane.channel as usize * size + at] + plane.offset);
    let packed = targets[plane.channel as usize / 3 * size + at];
    let counts = packed >= 0x8000_0000;
    let y = (packed >> (8 * (plane.channel % 3)) & 255) as f32 / 255.0;
    Compared {
        x,
        y: if counts { y } else { x },
        weight: if counts { inside } else { 0.0 },
    }
}
