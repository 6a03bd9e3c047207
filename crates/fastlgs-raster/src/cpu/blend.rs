use super::{Splat, TRANSMITTANCE_MIN, alpha};
use crate::View;
use crate::view::TILE;
use rayon::prelude::*;

/// Pixels of a 4x2 block of the picture: one invocation's share. Yields (x, y) from the upper left.
pub(super) fn block(x: u32, y: u32, view: &View) -> impl Iterator<Item = (u32, u32)> + use<> {
    let [w, h] = view.size;
    (y..(y + 2).min(h)).flat_map(move |y| (x..(x + 4).min(w)).map(move |x| (x, y)))
}

/// Upper left pixels of the eight blocks of a tile.
pub(super) fn blocks(tile: u32, view: &View) -> impl Iterator<Item = (u32, u32)> + use<> {
    let (x, y) = (tile % view.tiles[0] * TILE, tile / view.tiles[0] * TILE);
    let [w, h] = view.size;
    (0..8).map(move |lane| (x + (lane & 1) * 4, y + (lane >> 1) * 2)).filter(move |(x, y)| *x < w && *y < h)
}

/// All pixels of a tile that lie in the picture.
pub(crate) fn pixels_of(tile: u32, view: &View) -> impl Iterator<Item = (u32, u32)> + use<> {
    let view = *view;
    blocks(tile, &view).flat_map(move |(x, y)| block(x, y, &view))
}

/// Twin of `shaders/blend.wgsl`.
pub fn blend(view: &View, ranges: &[u32], sorted_pairs: &[u32], pair_gaussians: &[u32], splats: &[Splat], frame: &mut [f32]) {
    let pixels = view.pixels();
    let background = [view.background_color, view.background_feature];
    let tiles: Vec<Vec<(usize, [f32; 8])>> = (0..view.tile_count())
        .into_par_iter()
        .map(|tile| {
            let pairs = &sorted_pairs[ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize];
            let mut out = Vec::with_capacity(64);
            for (x, y) in blocks(tile, view) {
                let mut state: Vec<_> = block(x, y, view).map(|p| (p, 1.0f32, [0.0f32; 6])).collect();
                let mut walked = 0;
                for &e in pairs {
                    walked += 1;
                    let splat = &splats[pair_gaussians[e as usize] as usize];
                    let values = [splat[1][2], splat[1][3], splat[2][0], splat[2][1], splat[2][2], splat[2][3]];
                    let mut most = 0.0f32;
                    for ((px, py), transmittance, sums) in &mut state {
                        let (dx, dy) = (*px as f32 + 0.5 - splat[0][0], *py as f32 + 0.5 - splat[0][1]);
                        let w = alpha(splat, dx, dy, *transmittance) * *transmittance;
                        for (sum, value) in sums.iter_mut().zip(values) {
                            *sum += w * value;
                        }
                        *transmittance -= w;
                        most = most.max(*transmittance);
                    }
                    if most < TRANSMITTANCE_MIN {
                        break;
                    }
                }
                for ((px, py), t, sums) in state {
                    let value = |c: usize| sums[c] + t * background[c / 3][c % 3];
                    let values = [value(0), value(1), value(2), value(3), value(4), value(5), t, walked as f32];
                    out.push(((py * view.size[0] + px) as usize, values));
                }
            }
            out
        })
        .collect();
    for (at, values) in tiles.into_iter().flatten() {
        for (c, value) in values.into_iter().enumerate() {
            frame[c * pixels + at] = value;
        }
    }
}
