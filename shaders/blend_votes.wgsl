// Sums the blending weights alpha * transmittance of each Gaussian of a tile over the pixels of each
// label, front to back (lifting).
//
// labels     [tile][64]: index of each pixel's label among the labels of its tile
// tile_votes [tile]: first sum of the tile, and number of its labels
// votes      [window][pair of the tile][label of the tile]: the sums; 0 at first. A window is a run
//            of tiles, whose sums start at view.slot_first and are view.slot_count in number.
#import view
#import flat
#import quad
#import tile_part

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> labels: array<vec4<u32>>;
@group(0) @binding(6) var<storage, read> tile_votes: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read_write> votes: array<f32>;

struct Quad {
    transmittance: vec4<f32>,
    label: vec4<u32>,
}

fn absorb(quad: ptr<function, Quad>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>) -> vec4<f32> {
    let t = (*quad).transmittance;
    let w = t * alphas(dx, s0.z, row_of(s0, s1, dy));
    (*quad).transmittance = t - w;
    return w;
}

// Largest numbers among the workgroup's tiles.
var<workgroup> max_length: atomic<u32>;
var<workgroup> max_labels: atomic<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    var own = tile_part_of(flat_group(group, groups), index);
    var first = 0u;
    var count = 0u;
    if own.length > 0u {
        first = tile_votes[own.tile].x - view.slot_first;
        count = tile_votes[own.tile].y;
        // Tiles of other windows have nothing to do.
        if first >= view.slot_count {
            own.length = 0u;
            count = 0u;
        }
    }
    if index == 0u {
        atomicStore(&max_length, 0u);
        atomicStore(&max_labels, 0u);
    }
    workgroupBarrier();
    atomicMax(&max_length, own.length);
    atomicMax(&max_labels, count);
    let longest = workgroupUniformLoad(&max_length);
    let most_labels = workgroupUniformLoad(&max_labels);

    let px = vec4<f32>(f32(own.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(own.y) + 0.5;
#each K 2
    var q$K: Quad;
    q$K.transmittance = inside(own.x, own.y + $Ku, view);
    if own.length > 0u {
        q$K.label = labels[own.tile * 16u + ((own.y + $Ku) % TILE) * 2u + own.lane % 2u];
    }
#end
    var unfinished = own.length > 0u;
    for (var k = 0u; k < longest; k += BATCH) {
        if index == 0u {
            atomicStore(&unfinished_tiles, 0u);
        }
        workgroupBarrier();
#each K 8
        var upper$K = vec4<f32>(0.0);
        var lower$K = vec4<f32>(0.0);
        if unfinished && k + $Ku < own.length {
            let i = 3u * pair_gaussians[sorted_pairs[own.start + k + $Ku]];
            let dx = px - splats[i].x;
            let dy = py - splats[i].y;
            upper$K = absorb(&q0, dx, dy, splats[i], splats[i + 1u]);
            lower$K = absorb(&q1, dx, dy + 1.0, splats[i], splats[i + 1u]);
        }
#end
        for (var label = 0u; label < most_labels; label++) {
            let zero = vec4<f32>(0.0);
#each K 8
            put_partial(own, $Ku, select(zero, upper$K, q0.label == vec4<u32>(label)) + select(zero, lower$K, q1.label == vec4<u32>(label)));
#end
            workgroupBarrier();
            let pair = k + own.lane;
            if label < count && pair < own.length {
                votes[first + pair * count + label] = tile_sum(own);
            }
            workgroupBarrier();
        }
        if k + BATCH < own.length {
            mark_unfinished(own, max(q0.transmittance, q1.transmittance));
        }
        let still_open = workgroupUniformLoad(&unfinished_tiles);
        if still_open == 0u {
            break;
        }
        unfinished = (still_open & (1u << own.slot)) != 0u;
    }
}
