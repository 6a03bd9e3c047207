// Writes the (tile, Gaussian) pairs of each Gaussian, in depth order.
//
// pair_tiles     [pairs]  tile number: the key of the second sort
// pair_gaussians [pairs]  Gaussian of pair e
// first_pair     [n]      first pair of each Gaussian: its gradient slots are contiguous from there
#import view
#import flat

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> offsets: array<u32>;
@group(0) @binding(3) var<storage, read> rects: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> touched: array<u32>;
@group(0) @binding(5) var<storage, read_write> pair_tiles: array<u32>;
@group(0) @binding(6) var<storage, read_write> pair_gaussians: array<u32>;
@group(0) @binding(7) var<storage, read_write> first_pair: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rank = flat_group(group, groups) * 64u + lane;
    if rank >= view.gaussians {
        return;
    }
    let g = order[rank];
    var e = offsets[rank];
    first_pair[g] = e;
    if touched[g] == 0u {
        return;
    }
    let first = vec2<u32>(rects[g].x & 0xffffu, rects[g].x >> 16u);
    let end = vec2<u32>(rects[g].y & 0xffffu, rects[g].y >> 16u);
    for (var y = first.y; y < end.y; y++) {
        for (var x = first.x; x < end.x; x++) {
            pair_tiles[e] = y * view.tiles.x + x;
            pair_gaussians[e] = g;
            e++;
        }
    }
}
