//! CPU twin of `shaders/tile_load.wgsl`: sort keys of tiles.

use crate::View;

/// Writes the sort key of each tile: the longer its list, the smaller the key.
pub fn tile_load(view: &View, ranges: &[u32], keys: &mut [u32]) {
    for tile in 0..view.tile_count() as usize {
        let length = ranges[2 * tile + 1] - ranges[2 * tile];
        keys[tile] = 255 - ((16.0 * ((length + 1) as f32).log2()) as u32).min(255);
    }
}
