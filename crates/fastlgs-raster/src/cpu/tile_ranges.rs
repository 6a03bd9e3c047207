//! CPU twin of `shaders/tile_ranges.wgsl`: the list of each tile.

use crate::View;

/// Writes first and end pair of each tile. Tiles without pairs keep their values.
pub fn tile_ranges(view: &View, sorted_tiles: &[u32], ranges: &mut [u32]) {
    let pairs = view.pairs as usize;
    for i in 0..pairs {
        let tile = sorted_tiles[i] as usize;
        if tile >= view.tile_count() as usize {
            continue;
        }
        if i == 0 || sorted_tiles[i - 1] as usize != tile {
            ranges[2 * tile] = i as u32;
        }
        if i + 1 == pairs || sorted_tiles[i + 1] as usize != tile {
            ranges[2 * tile + 1] = i as u32 + 1;
        }
    }
}
