//! CPU twin of `shaders/shared/footprint.wgsl`: the tiles that a Gaussian touches.

use crate::view::TILE;

/// Ellipse on which alpha equals `ALPHA_MIN`, in pixels: (mean.xy, lean, spread) (squared half
/// height, apex, first tile row, end tile row).
///
/// lean is cov_xy / cov_yy: the shift in x of the ellipse's middle for each pixel in y. spread is
/// det / cov_yy^2: the squared half width in a row, divided by (half height^2 - dy^2). apex is the
/// y offset of the rightmost point from the mean; the leftmost point is at -apex.
pub type Footprint = [[f32; 4]; 2];

/// Returns the columns of a row of tiles that the ellipse touches.
#[inline(always)]
pub fn span(f: &Footprint, row: u32, tiles_x: u32) -> std::ops::Range<u32> {
    let [[mean_x, mean_y, lean, spread], [height2, apex, ..]] = *f;
    let half_height = height2.sqrt();
    // Conversions are signed because AVX2 has no unsigned ones. The code has no branches, so that
    // several rows are computed at once.
    let top = ((row * TILE) as i32 as f32 + 0.5 - mean_y).max(-half_height);
    let bottom = ((row * TILE + TILE) as i32 as f32 - 0.5 - mean_y).min(half_height);
    let half_width = |dy: f32| ((height2 - dy * dy).max(0.0) * spread).sqrt();
    let (dy_right, dy_left) = (apex.max(top).min(bottom), (-apex).max(top).min(bottom));
    let right = mean_x + lean * dy_right + half_width(dy_right);
    let left = mean_x + lean * dy_left - half_width(dy_left);
    let (size, limit) = (TILE as f32, tiles_x as f32);
    let first = (((left + 0.5) / size).ceil() - 1.0).max(0.0).min(limit);
    let end = (((right - 0.5) / size).floor() + 1.0).max(first).min(limit);
    let end = if top <= bottom { end } else { first };
    first as i32 as u32..end as i32 as u32
}
