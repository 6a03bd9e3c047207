// Writes first and end pair of each tile in the sorted list. Tiles without pairs keep their values:
// `ranges` must be cleared before.
#import view
#import flat

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = flat_group(group, groups) * 64u + lane;
    if i >= view.pairs {
        return;
    }
    let tile = sorted_tiles[i];
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    if i == 0u || sorted_tiles[i - 1u] != tile {
        ranges[2u * tile] = i;
    }
    if i + 1u == view.pairs || sorted_tiles[i + 1u] != tile {
        ranges[2u * tile + 1u] = i + 1u;
    }
}
