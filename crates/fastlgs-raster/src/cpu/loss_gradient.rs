//! CPU twin of `shaders/loss_gradient.wgsl`: gradient of the loss by the frame.

use super::ssim_columns::blur_column;
use super::{ROWS_PER_INVOCATION, sample};
use crate::view::Plane;

/// Writes dL/d frame of one channel, and sums for the loss, the exposure and the background.
pub fn loss_gradient(
    plane: &Plane,
    frame: &[f32],
    targets: &[u32],
    rows: &[f32],
    gradient: &mut [f32],
    sums: &mut [f32],
) {
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize);
    let runs = h / ROWS_PER_INVOCATION;
    let channel = plane.channel as usize;
    let sum_at = |kind: usize| (kind * 6 + channel) * runs * w;
    (0..4).for_each(|kind| sums[sum_at(kind)..sum_at(kind) + runs * w].fill(0.0));
    for j in 0..h {
        for i in 0..w {
            let [by_mean, by_square, by_product] =
                [0, 1, 2].map(|m| blur_column(plane, rows, m, i, j));
            let p = sample(plane, frame, targets, i, j);
            let sign = if p.x == p.y {
                0.0
            } else {
                (p.x - p.y).signum()
            };
            let d_ssim = by_mean + 2.0 * p.x * by_square + p.y * by_product;
            let value =
                p.weight * plane.scale * ((1.0 - plane.lambda) * sign - plane.lambda * d_ssim);
            let at = channel * w * h + j * w + i;
            gradient[at] = plane.gain * value;
            let transmittance = frame[6 * w * h + j * w + i];
            let kinds = [
                p.weight * (p.x - p.y).abs(),
                value * frame[at],
                value,
                plane.gain * value * transmittance,
            ];
            for (kind, add) in kinds.into_iter().enumerate() {
                sums[sum_at(kind) + (j / ROWS_PER_INVOCATION) * w + i] += add;
            }
        }
    }
}
