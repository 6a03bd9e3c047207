//! CPU twin of `shaders/ssim_columns.wgsl`: SSIM and its derivatives.

use super::{ROWS_PER_INVOCATION, inside_plane};
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Returns one map of `rows` blurred along its column at (i, j).
pub(super) fn blur_column(plane: &Plane, rows: &[f32], map: usize, i: usize, j: usize) -> f32 {
    let window = ssim_window();
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    let taps = j.saturating_sub(SSIM_RADIUS)..=(j + SSIM_RADIUS).min(h - 1);
    taps.map(|k| window[k + SSIM_RADIUS - j] * rows[(map * h + k) * w + i])
        .sum()
}

/// Blurs the local moments along columns. Computes SSIM and its derivatives by three moments.
pub fn ssim_columns(plane: &Plane, rows: &[f32], partials: &mut [f32], sums: &mut [f32]) {
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    let runs = h / ROWS_PER_INVOCATION;
    let base = plane.channel as usize * runs * w;
    sums[base..base + runs * w].fill(0.0);
    for j in 0..h {
        for i in 0..w {
            let [mx, my, squares, xy] = [0, 1, 2, 3].map(|m| blur_column(plane, rows, m, i, j));
            let a = 2.0 * mx * my + 0.0001;
            let b = 2.0 * (xy - mx * my) + 0.0009;
            let of_means = mx * mx + my * my;
            let c = of_means + 0.0001;
            let d = squares - of_means + 0.0009;
            let ssim = a * b / (c * d);
            let weight = inside_plane(plane, i, j);
            sums[base + (j / ROWS_PER_INVOCATION) * w + i] += weight * ssim;
            let at = j * w + i;
            partials[at] =
                weight * ((2.0 * my * (b - a)) / (c * d) - 2.0 * mx * ssim * (d - c) / (c * d));
            partials[w * h + at] = -weight * ssim / d;
            partials[2 * w * h + at] = weight * 2.0 * a / (c * d);
        }
    }
}
