// Writes the (tile, Gaussian) pairs of each Gaussian, in depth order.
//
// pair_tiles     [pairs]  tile number: the key of the second sort
// pair_gaussians [pairs]  Gaussian of each pair
// first_pair     [n]      first pair of each Gaussian; its gradient slots are contiguous from there
// touched        [n]      lowered to the number of pairs written
//
// The formula for the tiles is the same as in `project`, but two kernels may round differently.
// Surplus pairs get the tile number after the last tile, which is never drawn. Tiles beyond the
// number that `project` counted are left out.
#import view
#import flat
#import footprint

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> offsets: array<u32>;
@group(0) @binding(3) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> touched: array<u32>;
@group(0) @binding(5) var<storage, read_write> pair_tiles: array<u32>;
@group(0) @binding(6) var<storage, read_write> pair_gaussians: array<u32>;
@group(0) @binding(7) var<storage, read_write> first_pair: array<u32>;

// Invocations that write the tiles of one Gaussian. Real GPUs use several, because a large Gaussian
// touches thousands of tiles.
#ifdef WIDE
const WRITERS: u32 = 1u;
#else
const WRITERS: u32 = 8u;
#endif

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let invocation = flat_group(group, groups) * 64u + lane;
    let rank = invocation / WRITERS;
    let writer = invocation % WRITERS;
    if rank >= view.gaussians {
        return;
    }
    let g = order[rank];
    let start = offsets[rank];
    // The first writer may already have lowered `touched` to the number of pairs found. This does
    // not change the result of the other writers.
    let end = start + touched[g];
    if writer == 0u {
        first_pair[g] = start;
    }
    if start == end {
        return;
    }
    var e = start;
    let f0 = footprints[2u * g];
    let f1 = footprints[2u * g + 1u];
    for (var row = u32(f1.z); row < u32(f1.w); row++) {
        let span = footprint_span(f0, f1, row, view.tiles.x);
        let first = e;
        let next = min(first + span.y - span.x, end);
        for (e = first + writer; e < next; e += WRITERS) {
            pair_tiles[e] = row * view.tiles.x + span.x + (e - first);
            pair_gaussians[e] = g;
        }
        e = next;
    }
    if writer > 0u {
        return;
    }
    touched[g] = e - start;
    for (; e < end; e++) {
        pair_tiles[e] = view.tiles.x * view.tiles.y;
        pair_gaussians[e] = g;
    }
}
