use super::shown_target;
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Twin of `shaders/ssim_columns.wgsl`.
pub fn ssim_columns(plane: &Plane, frame: &[f32], targets: &[u32], moments: &mut [f32]) {
    let window = ssim_window();
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    for (row, j) in (plane.phase as usize..h).step_by(2).enumerate() {
        for i in 0..w {
            let mut sums = [0.0f32; 5];
            for k in j.saturating_sub(SSIM_RADIUS)..=(j + SSIM_RADIUS).min(h - 1) {
                let p = shown_target(plane, frame, targets, i, k);
                let weight = window[k + SSIM_RADIUS - j];
                for (sum, value) in sums.iter_mut().zip([p.x, p.y, p.x * p.x, p.y * p.y, p.x * p.y]) {
                    *sum += weight * value;
                }
            }
            for (m, sum) in sums.into_iter().enumerate() {
                moments[(m * h / 2 + row) * w + i] = sum;
            }
        }
    }
}
