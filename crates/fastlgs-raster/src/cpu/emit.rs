//! CPU twin of `shaders/emit.wgsl`: the (tile, Gaussian) pairs.

use super::footprint::{Footprint, span};
use crate::View;

/// Writes the (tile, Gaussian) pairs in depth order. Lowers `touched` to the number of pairs
/// written.
pub fn emit(
    view: &View,
    order: &[u32],
    offsets: &[u32],
    footprints: &[Footprint],
    touched: &mut [u32],
    pair_tiles: &mut [u32],
    pair_gaussians: &mut [u32],
    first_pair: &mut [u32],
) {
    for rank in 0..view.gaussians as usize {
        let g = order[rank] as usize;
        let mut e = offsets[rank] as usize;
        first_pair[g] = e as u32;
        if touched[g] == 0 {
            continue;
        }
        let end = e + touched[g] as usize;
        let footprint = &footprints[g];
        for row in footprint[1][2] as u32..footprint[1][3] as u32 {
            for x in span(footprint, row, view.tiles[0]) {
                if e < end {
                    pair_tiles[e] = row * view.tiles[0] + x;
                    pair_gaussians[e] = g as u32;
                    e += 1;
                }
            }
        }
        touched[g] = e as u32 - first_pair[g];
        pair_tiles[e..end].fill(view.tile_count());
        pair_gaussians[e..end].fill(g as u32);
    }
}
