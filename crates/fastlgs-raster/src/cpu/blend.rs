use super::{Splat, TRANSMITTANCE_MIN, alpha};
use crate::View;
use crate::view::TILE;
use rayon::prelude::*;

/// All pixels of a tile that lie in the picture.
pub(crate) fn pixels_of(tile: u32, view: &View) -> impl Iterator<Item = (u32, u32)> + use<> {
    let (x, y) = (tile % view.tiles[0] * TILE, tile / view.tiles[0] * TILE);
    let [w, h] = view.size;
    (y..(y + TILE).min(h)).flat_map(move |y| (x..(x + TILE).min(w)).map(move |x| (x, y)))
}

/// Twin of `shaders/blend.wgsl` in its wide shape.
pub fn blend(view: &View, ranges: &[u32], sorted_pairs: &[u32], pair_gaussians: &[u32], splats: &[Splat], frame: &mut [f32]) {
    let n = view.pixels();
    let background = [view.background_color, view.background_feature];
    let tiles: Vec<Vec<(usize, [f32; 8])>> = (0..view.tile_count())
        .into_par_iter()
        .map(|tile| {
            let pairs = &sorted_pairs[ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize];
            let mut pixels: Vec<_> = pixels_of(tile, view).map(|p| (p, 1.0f32, [0.0f32; 6])).collect();
            let mut walked = 0;
            for &e in pairs {
                let splat = &splats[pair_gaussians[e as usize] as usize];
                let values = [splat[1][2], splat[1][3], splat[2][0], splat[2][1], splat[2][2], splat[2][3]];
                let mut open = false;
                for ((x, y), transmittance, sums) in &mut pixels {
                    let (dx, dy) = (*x as f32 + 0.5 - splat[0][0], *y as f32 + 0.5 - splat[0][1]);
                    open |= *transmittance >= TRANSMITTANCE_MIN;
                    let w = alpha(splat, dx, dy, *transmittance) * *transmittance;
                    for (sum, value) in sums.iter_mut().zip(values) {
                        *sum += w * value;
                    }
                    *transmittance -= w;
                }
                if !open {
                    break;
                }
                walked += 1;
            }
            let finished = |((x, y), t, sums): ((u32, u32), f32, [f32; 6])| {
                let value = |c: usize| sums[c] + t * background[c / 3][c % 3];
                ((y * view.size[0] + x) as usize, [value(0), value(1), value(2), value(3), value(4), value(5), t, walked as f32])
            };
            pixels.into_iter().map(finished).collect()
        })
        .collect();
    for (at, values) in tiles.into_iter().flatten() {
        for (c, value) in values.into_iter().enumerate() {
            frame[c * n + at] = value;
        }
    }
}
