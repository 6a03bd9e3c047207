use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};

/// Twin of `shaders/ssim_rows.wgsl`.
pub fn ssim_rows(plane: &Plane, frame: &[f32], target: &[f32], rows: &mut [f32]) {
    let window = ssim_window();
    let (w, h) = (plane.width as usize, plane.height as usize);
    let size = w * h;
    let channel = plane.channel as usize * size;
    for j in 0..h {
        for i in 0..w {
            let mut sums = [0.0f32; 5];
            for k in i.saturating_sub(SSIM_RADIUS)..=(i + SSIM_RADIUS).min(w - 1) {
                let x = frame[channel + j * w + k];
                let t = target[channel + j * w + k];
                let y = if t < 0.0 { x } else { t };
                let weight = window[k + SSIM_RADIUS - i];
                for (sum, value) in sums.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                    *sum += weight * value;
                }
            }
            for (m, sum) in sums.into_iter().enumerate() {
                rows[m * size + j * w + i] = sum;
            }
        }
    }
}
