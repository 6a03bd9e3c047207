//! CPU twin of `shaders/ssim_rows.wgsl`: blur of the moments of SSIM.

use super::sample;
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Blurs x, y, x^2 + y^2 and x y along rows.
pub fn ssim_rows(plane: &Plane, frame: &[f32], targets: &[u32], rows: &mut [f32]) {
    let window = ssim_window();
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    for j in 0..h {
        for i in 0..w {
            let mut sums = [0.0f32; 4];
            for k in i.saturating_sub(SSIM_RADIUS)..=(i + SSIM_RADIUS).min(w - 1) {
                let p = sample(plane, frame, targets, k, j);
                let weight = window[k + SSIM_RADIUS - i];
                for (sum, value) in
                    sums.iter_mut()
                        .zip([p.x, p.y, p.x * p.x + p.y * p.y, p.x * p.y])
                {
                    *sum += weight * value;
                }
            }
            for (m, sum) in sums.into_iter().enumerate() {
                rows[(m * h + j) * w + i] = sum;
            }
        }
    }
}
