use super::RUN;
use super::ssim_columns::blur_column;
use crate::view::Plane;

/// Twin of `shaders/loss_gradient.wgsl`.
pub fn loss_gradient(plane: &Plane, frame: &[f32], target: &[f32], rows: &[f32], gradient: &mut [f32], sums: &mut [f32]) {
    let (w, h) = (plane.width as usize, plane.height as usize);
    let runs = h.div_ceil(RUN);
    let channel = plane.channel as usize;
    let base = channel * runs * w;
    sums[base..base + runs * w].fill(0.0);
    for j in 0..h {
        for i in 0..w {
            let [by_mean, by_square, by_product] = [0, 1, 2].map(|m| blur_column(plane, rows, m, i, j));
            let at = channel * w * h + j * w + i;
            let (x, t) = (frame[at], target[at]);
            let y = if t < 0.0 { x } else { t };
            sums[base + (j / RUN) * w + i] += (x - y).abs();
            let sign = if x > y {
                1.0
            } else if x < y {
                -1.0
            } else {
                0.0
            };
            let d_ssim = by_mean + 2.0 * x * by_square + y * by_product;
            gradient[at] = if t < 0.0 { 0.0 } else { plane.scale * ((1.0 - plane.lambda) * sign - plane.lambda * d_ssim) };
        }
    }
}
