//! CPU twin of `shaders/blend.wgsl`: front-to-back blending.

use super::{Splat, alpha, values_of};
use crate::View;
use crate::channels::Channels;
use crate::view::TILE;
use rayon::prelude::*;

/// Number of Gaussians after which blending checks whether a tile is finished.
pub(crate) const BATCH: usize = 8;

/// Returns (x, y) of all pixels of a tile, including the padding.
pub(crate) fn pixels_of(tile: u32, view: &View) -> impl Iterator<Item = (u32, u32)> + use<> {
    let (x, y) = (tile % view.tiles[0] * TILE, tile / view.tiles[0] * TILE);
    (y..y + TILE).flat_map(move |y| (x..x + TILE).map(move |x| (x, y)))
}

/// Returns 1 for pixels of the image and 0 for pixels of the padding.
pub(crate) fn inside_image(x: u32, y: u32, view: &View) -> f32 {
    if x < view.size[0] && y < view.size[1] {
        1.0
    } else {
        0.0
    }
}

/// Blends all tiles into `frame` `[8][padded pixels]`. Channels that are not requested keep their
/// values.
pub fn blend(
    view: &View,
    channels: Channels,
    ranges: &[u32],
    tile_order: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    frame: &mut [f32],
) {
    let n = view.padded_pixels();
    let background = [view.background_color, view.background_feature];
    let tiles: Vec<Vec<(usize, [f32; 8])>> = tile_order
        .par_iter()
        .map(|&tile| {
            let pairs = &sorted_pairs
                [ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize];
            let mut pixels: Vec<_> = pixels_of(tile, view)
                .map(|(x, y)| ((x, y), inside_image(x, y, view), [0.0f32; 6]))
                .collect();
            let mut walked = 0;
            for batch in pairs.chunks(BATCH) {
                for &e in batch {
                    let splat = &splats[pair_gaussians[e as usize] as usize];
                    let values = values_of(splat);
                    for ((x, y), transmittance, sums) in &mut pixels {
                        let w = alpha(
                            splat,
                            *x as f32 + 0.5 - splat[0][0],
                            *y as f32 + 0.5 - splat[0][1],
                        ) * *transmittance;
                        for (sum, value) in sums.iter_mut().zip(values) {
                            *sum += w * value;
                        }
                        *transmittance -= w;
                    }
                }
                walked += batch.len();
                if pixels.iter().all(|p| p.1 < view.min_transmittance) {
                    break;
                }
            }
            let finished = |((x, y), t, sums): ((u32, u32), f32, [f32; 6])| {
                let value =
                    |c: usize| inside_image(x, y, view) * (sums[c] + t * background[c / 3][c % 3]);
                (
                    view.index_of(x, y),
                    [
                        value(0),
                        value(1),
                        value(2),
                        value(3),
                        value(4),
                        value(5),
                        t,
                        walked as f32,
                    ],
                )
            };
            pixels.into_iter().map(finished).collect()
        })
        .collect();
    for (pixel_index, values) in tiles.into_iter().flatten() {
        for (c, value) in values.into_iter().enumerate() {
            if c >= 6 || channels.includes(c) {
                frame[c * n + pixel_index] = value;
            }
        }
    }
}
