use super::blend::pixels_of;
use super::{Splat, alpha};
use crate::View;
use rayon::prelude::*;

/// Twin of `shaders/blend_backward.wgsl`.
pub fn blend_backward(
    view: &View,
    ranges: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    frame: &[f32],
    gradient: &[f32],
    slots: &mut [Splat],
) {
    let n = view.pixels();
    let moving = if view.feature_moves_geometry == 1 { 6 } else { 3 };
    let tiles: Vec<Vec<(u32, Splat)>> = (0..view.tile_count())
        .into_par_iter()
        .map(|tile| {
            let pairs = &sorted_pairs[ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize];
            let mut pixels: Vec<_> = pixels_of(tile, view)
                .map(|(x, y)| {
                    let at = (y * view.size[0] + x) as usize;
                    let g: [f32; 6] = std::array::from_fn(|c| gradient[c * n + at]);
                    let behind: f32 = (0..moving).map(|c| frame[c * n + at] * g[c]).sum();
                    (x as f32 + 0.5, y as f32 + 0.5, 1.0f32, behind, g)
                })
                .collect();
            let backward = |e: u32| {
                let splat = &splats[pair_gaussians[e as usize] as usize];
                let values = [splat[1][2], splat[1][3], splat[2][0], splat[2][1], splat[2][2], splat[2][3]];
                let mut slot = [[0.0f32; 4]; 3];
                for (x, y, transmittance, behind, g) in &mut pixels {
                    let (dx, dy) = (*x - splat[0][0], *y - splat[0][1]);
                    let a = alpha(splat, dx, dy, *transmittance);
                    if a == 0.0 {
                        continue;
                    }
                    let w = a * *transmittance;
                    let worth: f32 = (0..moving).map(|c| values[c] * g[c]).sum();
                    *behind -= w * worth;
                    let d_alpha = *transmittance * worth - *behind / (1.0 - a);
                    *transmittance -= w;
                    let p = d_alpha * a;
                    let add = [p * dx, p * dy, p * dx * dx, p * dx * dy, p * dy * dy, p / splat[1][1]];
                    for (k, value) in add.into_iter().chain(g.iter().map(|g| w * g)).enumerate() {
                        slot[k / 4][k % 4] += value;
                    }
                }
                (e, slot)
            };
            pairs.iter().copied().map(backward).collect()
        })
        .collect();
    for (e, slot) in tiles.into_iter().flatten() {
        slots[e as usize] = slot;
    }
}
