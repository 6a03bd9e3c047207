//! CPU twin of `shaders/blend_backward.wgsl`: gradients of blending (docs/how-it-works.md, section
//! 5.1).

use super::blend::{inside_image, pixels_of};
use super::{Splat, alpha};
use crate::View;
use crate::channels::Channels;
use crate::view::TILE;
use rayon::prelude::*;

/// Writes the gradient sums of each (tile, Gaussian) pair to its slot. `slots` holds 12 floats for
/// each pair of the window, or 4 with frozen geometry.
pub fn blend_backward(
    view: &View,
    channels: Channels,
    ranges: &[u32],
    tile_order: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    frame: &[f32],
    gradient: &[f32],
    slots: &mut [f32],
) {
    let n = view.padded_pixels();
    // Number of channels whose gradient moves geometry.
    let geometry_channels = match channels {
        Channels::Feature => 0,
        Channels::Color | Channels::Both => 3,
        Channels::Coupled => 6,
    };
    let trained = |c: usize| {
        if c < 3 {
            channels.color()
        } else {
            channels.feature()
        }
    };
    let tiles: Vec<Vec<(u32, [f32; 12])>> = tile_order
        .par_iter()
        .map(|&tile| {
            let range = ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize;
            let walked = frame
                [7 * n + view.index_of(tile % view.tiles[0] * TILE, tile / view.tiles[0] * TILE)]
                as usize;
            let mut pixels: Vec<_> = pixels_of(tile, view)
                .map(|(x, y)| {
                    let at = view.index_of(x, y);
                    let g: [f32; 6] = std::array::from_fn(|c| {
                        if trained(c) {
                            gradient[c * n + at]
                        } else {
                            0.0
                        }
                    });
                    let r_dot_g: f32 = (0..geometry_channels)
                        .map(|c| frame[c * n + at] * g[c])
                        .sum();
                    (
                        x as f32 + 0.5,
                        y as f32 + 0.5,
                        inside_image(x, y, view),
                        r_dot_g,
                        g,
                    )
                })
                .collect();
            let backward = |(k, pair): (usize, u32)| {
                let mut slot = [0.0f32; 12];
                if k >= walked {
                    return (pair, slot);
                }
                let splat = &splats[pair_gaussians[pair as usize] as usize];
                let values = [
                    splat[1][2],
                    splat[1][3],
                    splat[2][0],
                    splat[2][1],
                    splat[2][2],
                    splat[2][3],
                ];
                for (x, y, transmittance, r_dot_g, g) in &mut pixels {
                    let (dx, dy) = (*x - splat[0][0], *y - splat[0][1]);
                    let a = alpha(splat, dx, dy);
                    let w = a * *transmittance;
                    *transmittance -= w;
                    let w_c_dot_g: f32 = w
                        * (0..geometry_channels)
                            .map(|c| values[c] * g[c])
                            .sum::<f32>();
                    *r_dot_g -= w_c_dot_g;
                    let p = w_c_dot_g - *r_dot_g * (a / (1.0 - a));
                    let add = [p * dx, p * dy, p * dx * dx, p * dx * dy, p * dy * dy, p];
                    for (sum, value) in slot
                        .iter_mut()
                        .zip(add.into_iter().chain(g.iter().map(|g| w * g)))
                    {
                        *sum += value;
                    }
                }
                (pair, slot)
            };
            sorted_pairs[range]
                .iter()
                .copied()
                .enumerate()
                .map(backward)
                .collect()
        })
        .collect();
    let floats = 4 * channels.slot();
    for (e, slot) in tiles.into_iter().flatten() {
        if e >= view.slot_first && e - view.slot_first < view.slot_count + view.tile_count() {
            let at = (e - view.slot_first) as usize * floats;
            slots[at..at + floats].copy_from_slice(&slot[12 - floats..]);
        }
    }
}
