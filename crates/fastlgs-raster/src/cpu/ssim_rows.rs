use super::{RUN, shown_plane};
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Blurs a row at place `i`.
pub(super) fn blur_row(row: &[f32], i: usize) -> f32 {
    let window = ssim_window();
    let taps = i.saturating_sub(SSIM_RADIUS)..=(i + SSIM_RADIUS).min(row.len() - 1);
    taps.map(|k| window[k + SSIM_RADIUS - i] * row[k]).sum()
}

/// Twin of `shaders/ssim_rows.wgsl`.
pub fn ssim_rows(plane: &Plane, moments: &[f32], partials: &mut [f32], sums: &mut [f32]) {
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize / 2);
    let base = plane.channel as usize * w * h / 2;
    sums[base..base + w * h / 2].fill(0.0);
    for j in 0..h {
        for i in 0..w {
            let [mx, my, xx, yy, xy] = [0, 1, 2, 3, 4].map(|m| blur_row(&moments[(m * h + j) * w..][..w], i));
            let a = 2.0 * mx * my + 0.0001;
            let b = 2.0 * (xy - mx * my) + 0.0009;
            let c = mx * mx + my * my + 0.0001;
            let d = (xx - mx * mx) + (yy - my * my) + 0.0009;
            let ssim = a * b / (c * d);
            let weight = shown_plane(plane, i, 2 * j + plane.phase as usize);
            // Two quads of four add up to one.
            sums[base + (j * w + i) / RUN * 4 + i % 4] += weight * ssim;
            let at = j * w + i;
            partials[at] = weight * ((2.0 * my * (b - a)) / (c * d) - 2.0 * mx * ssim * (d - c) / (c * d));
            partials[w * h + at] = -weight * ssim / d;
            partials[2 * w * h + at] = weight * 2.0 * a / (c * d);
        }
    }
}
