//! CPU twin of `shaders/ssim_backward_rows.wgsl`: blur of the derivatives of SSIM.

use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Blurs the three derivatives of SSIM along rows.
pub fn ssim_backward_rows(plane: &Plane, partials: &[f32], rows: &mut [f32]) {
    let window = ssim_window();
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    for j in 0..3 * h {
        for i in 0..w {
            let taps = i.saturating_sub(SSIM_RADIUS)..=(i + SSIM_RADIUS).min(w - 1);
            rows[j * w + i] = taps
                .map(|k| window[k + SSIM_RADIUS - i] * partials[j * w + k])
                .sum();
        }
    }
}
