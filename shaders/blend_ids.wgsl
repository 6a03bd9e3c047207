// Sums the blending weights alpha * transmittance of each pixel by object id, front to back.
//
// A pixel keeps four ids. A further id replaces the lightest one if its own weight is larger. Fewer
// than one pixel in a thousand has more than four ids.
//
// ids    [gaussian]: object id below 65,536
// shares [4][tile rows * 8][tile columns * 8]: id << 16 | weight of 0 to 1 as 0 to 65,535, unsorted
#import view
#import flat
#import quad

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> ids: array<u32>;
@group(0) @binding(6) var<storage, read_write> shares: array<vec4<u32>>;

const NO_ID: u32 = 0x10000u;

struct Quad {
    transmittance: vec4<f32>,
#each K 4
    id$K: vec4<u32>,
    weight$K: vec4<f32>,
#end
}

fn add(quad: ptr<function, Quad>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, id: u32) {
    let t = (*quad).transmittance;
    let w = t * alphas(dx, s0.z, row_of(s0, s1, dy));
    (*quad).transmittance = t - w;
    var has_slot = vec4<bool>(false);
#each K 4
    let is$K = (*quad).id$K == vec4<u32>(id);
    has_slot = has_slot | is$K;
    (*quad).weight$K += select(vec4<f32>(0.0), w, is$K);
#end
    let least = min(min((*quad).weight0, (*quad).weight1), min((*quad).weight2, (*quad).weight3));
    var free = !has_slot & (w > least);
#each K 4
    let take$K = free & ((*quad).weight$K == least);
    (*quad).id$K = select((*quad).id$K, vec4<u32>(id), take$K);
    (*quad).weight$K = select((*quad).weight$K, w, take$K);
    free = free & !take$K;
#end
}

fn packed(id: vec4<u32>, weight: vec4<f32>) -> vec4<u32> {
    return id << vec4<u32>(16u) | vec4<u32>(weight * 65535.0 + 0.5);
}

// Number of Gaussians after which an invocation checks whether its pixels are finished.
const BATCH: u32 = 8u;

// Eight invocations share a tile and do not communicate. Each has two quads, one above the other.
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    let tile = flat_group(group, groups) * 8u + index / 8u;
    let lane = index % 8u;
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let x = (tile % view.tiles.x) * TILE + (lane & 1u) * 4u;
    let y = (tile / view.tiles.x) * TILE + (lane >> 1u) * 2u;
    let px = vec4<f32>(f32(x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(y) + 0.5;
#each K 2
    var q$K: Quad;
    // Pixels outside the image start with transmittance 0.
    q$K.transmittance = inside(x, y + $Ku, view);
    q$K.id0 = vec4<u32>(NO_ID);
    q$K.id1 = vec4<u32>(NO_ID);
    q$K.id2 = vec4<u32>(NO_ID);
    q$K.id3 = vec4<u32>(NO_ID);
#end
    let end = ranges[2u * tile + 1u];
    var k = ranges[2u * tile];
    while k < end {
        let stop = min(k + BATCH, end);
        for (; k < stop; k++) {
            let g = pair_gaussians[sorted_pairs[k]];
            let s0 = splats[3u * g];
            let s1 = splats[3u * g + 1u];
            let id = ids[g];
#each K 2
            add(&q$K, px - s0.x, py + $K.0 - s0.y, s0, s1, id);
#end
        }
        if all(max(q0.transmittance, q1.transmittance) < vec4<f32>(view.finished)) {
            break;
        }
    }
#each K 2
    shares[quad_at(0u, x, y + $Ku, view)] = packed(q$K.id0, q$K.weight0);
    shares[quad_at(1u, x, y + $Ku, view)] = packed(q$K.id1, q$K.weight1);
    shares[quad_at(2u, x, y + $Ku, view)] = packed(q$K.id2, q$K.weight2);
    shares[quad_at(3u, x, y + $Ku, view)] = packed(q$K.id3, q$K.weight3);
#end
}
