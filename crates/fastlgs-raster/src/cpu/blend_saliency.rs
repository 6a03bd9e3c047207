//! CPU twin of `shaders/blend_saliency.wgsl`: how much pixels change without a Gaussian.

use super::{BATCH, Splat, alpha, inside_image, pixels_of, values_of};
use crate::View;

/// Sums the squared changes of a tile's colours without each of its Gaussians. `frame` is the
/// blended frame, `factors` `[3][padded pixels]` scales the changes, and `saliency` receives a sum
/// for each pair in sorted order.
pub fn blend_saliency(
    view: &View,
    ranges: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    frame: &[f32],
    factors: &[f32],
    saliency: &mut [f32],
) {
    let n = view.padded_pixels();
    for tile in 0..view.tile_count() {
        let range = ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize;
        let mut sums = saliency[range.clone()].iter_mut();
        let mut pixels: Vec<_> = pixels_of(tile, view)
            .map(|(x, y)| {
                let at = view.index_of(x, y);
                let behind: [f32; 3] = std::array::from_fn(|c| frame[c * n + at]);
                ((x, y), at, inside_image(x, y, view), behind)
            })
            .collect();
        for batch in sorted_pairs[range].chunks(BATCH) {
            for (&e, sum) in batch.iter().zip(&mut sums) {
                let splat = &splats[pair_gaussians[e as usize] as usize];
                let color = values_of(splat);
                for ((x, y), at, transmittance, behind) in &mut pixels {
                    let (dx, dy) = (*x as f32 + 0.5 - splat[0][0], *y as f32 + 0.5 - splat[0][1]);
                    let alpha = alpha(splat, dx, dy);
                    let weight = alpha * *transmittance;
                    *transmittance -= weight;
                    for c in 0..3 {
                        behind[c] -= weight * color[c];
                        let change = alpha / (1.0 - alpha) * behind[c] - weight * color[c];
                        *sum += (factors[c * n + *at] * change).powi(2);
                    }
                }
            }
            if pixels.iter().all(|p| p.2 < view.min_transmittance) {
                break;
            }
        }
    }
}
