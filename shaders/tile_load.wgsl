// Computes the sort key of each tile: the longer its list, the smaller the key, in steps of 4 %.
//
// Tiles with lists of similar length then share a workgroup, and the longest lists start first.
#import view

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read_write> keys: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let tile = id.x;
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let length = ranges[2u * tile + 1u] - ranges[2u * tile];
    keys[tile] = 255u - min(u32(16.0 * log2(f32(length + 1u))), 255u);
}
