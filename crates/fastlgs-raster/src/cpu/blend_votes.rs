//! CPU twin of `shaders/blend_votes.wgsl`: blending weights summed by label.

use super::{BATCH, Splat, alpha, inside_image, pixels_of};
use crate::View;

/// Sums the blending weights of each Gaussian of a tile by label. `labels` `[tile][64]` holds the
/// index of each pixel's label in its tile, `tile_votes` `[tile][first sum, number of labels]`, and
/// `votes` `[window][pair of the tile][label of the tile]` receives the sums.
pub fn blend_votes(
    view: &View,
    ranges: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    labels: &[u32],
    tile_votes: &[u32],
    votes: &mut [f32],
) {
    for tile in 0..view.tile_count() {
        let at = tile as usize;
        let (first, count) = (
            tile_votes[2 * at].wrapping_sub(view.slot_first),
            tile_votes[2 * at + 1] as usize,
        );
        let pairs = &sorted_pairs[ranges[2 * at] as usize..ranges[2 * at + 1] as usize];
        if first >= view.slot_count || pairs.is_empty() {
            continue;
        }
        let mut sums = votes[first as usize..].chunks_exact_mut(count);
        let mut pixels: Vec<_> = pixels_of(tile, view)
            .zip(&labels[64 * at..])
            .map(|((x, y), label)| ((x, y), *label as usize, inside_image(x, y, view)))
            .collect();
        for batch in pairs.chunks(BATCH) {
            for (&e, sums) in batch.iter().zip(&mut sums) {
                let splat = &splats[pair_gaussians[e as usize] as usize];
                for ((x, y), label, transmittance) in &mut pixels {
                    let (dx, dy) = (*x as f32 + 0.5 - splat[0][0], *y as f32 + 0.5 - splat[0][1]);
                    let weight = alpha(splat, dx, dy) * *transmittance;
                    *transmittance -= weight;
                    sums[*label] += weight;
                }
            }
            if pixels.iter().all(|p| p.2 < view.min_transmittance) {
                break;
            }
        }
    }
}
