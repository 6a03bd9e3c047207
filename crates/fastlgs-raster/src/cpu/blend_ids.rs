//! CPU twin of `shaders/blend_ids.wgsl`: blending weights summed by object id.

use super::{BATCH, Splat, alpha, inside_image, pixels_of};
use crate::View;
use fastlgs_core::id_weights::{IDS_PER_PIXEL, pack};
use rayon::prelude::*;

/// Marks a free slot. No object has this id.
const NO_ID: u32 = 0x1_0000;

/// Adds `weight` to the slot of `id`. If `id` has no slot, it replaces the first of the lightest
/// slots, provided that `weight` is larger.
fn add_weight(slots: &mut [(u32, f32); IDS_PER_PIXEL], id: u32, weight: f32) {
    if let Some(slot) = slots.iter_mut().find(|s| s.0 == id) {
        slot.1 += weight;
        return;
    }
    let least = slots.iter().fold(f32::INFINITY, |m, s| m.min(s.1));
    if let Some(slot) = slots
        .iter_mut()
        .find(|s| s.1 == least)
        .filter(|_| weight > least)
    {
        *slot = (id, weight);
    }
}

/// Sums the blending weights of each pixel by object id. `shares` `[4][padded pixels]` receives the
/// packed id weights.
pub fn blend_ids(
    view: &View,
    ranges: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    ids: &[u32],
    shares: &mut [u32],
) {
    let n = view.padded_pixels();
    let tiles: Vec<Vec<(usize, [u32; IDS_PER_PIXEL])>> = (0..view.tile_count())
        .into_par_iter()
        .map(|tile| {
            let pairs = &sorted_pairs
                [ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize];
            let mut pixels: Vec<_> = pixels_of(tile, view)
                .map(|(x, y)| {
                    (
                        (x, y),
                        inside_image(x, y, view),
                        [(NO_ID, 0.0); IDS_PER_PIXEL],
                    )
                })
                .collect();
            for batch in pairs.chunks(BATCH) {
                for &e in batch {
                    let g = pair_gaussians[e as usize] as usize;
                    for ((x, y), transmittance, slots) in &mut pixels {
                        let (dx, dy) = (
                            *x as f32 + 0.5 - splats[g][0][0],
                            *y as f32 + 0.5 - splats[g][0][1],
                        );
                        let weight = alpha(&splats[g], dx, dy) * *transmittance;
                        *transmittance -= weight;
                        add_weight(slots, ids[g], weight);
                    }
                }
                // In the shader, each invocation stops alone. The twin processes more pairs; these
                // have negligible weight.
                if pixels.iter().all(|p| p.1 < view.min_transmittance) {
                    break;
                }
            }
            pixels
                .into_iter()
                .map(|((x, y), _, slots)| {
                    (
                        view.index_of(x, y),
                        slots.map(|(id, weight)| pack(id as u16, weight)),
                    )
                })
                .collect()
        })
        .collect();
    for (at, slots) in tiles.into_iter().flatten() {
        for (k, slot) in slots.into_iter().enumerate() {
            shares[k * n + at] = slot;
        }
    }
}
