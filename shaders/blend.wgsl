// Blends colour and feature front to back in one pass (paper, rendering features; 3DGS eq. 3).
//
// frame [8][tile rows * 8][tile columns * 8]: r, g, b, f0, f1, f2 including the background,
//       transmittance behind all Gaussians, and number of pairs processed for the tile.
#import view
#import flat
#import lane

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> tile_order: array<u32>;
@group(0) @binding(3) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(4) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> frame: array<vec4<f32>>;

struct Quad {
    transmittance: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
}

fn add(quad: ptr<function, Quad>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) {
    let t = (*quad).transmittance;
    let w = t * alphas(dx, s0.z, row_of(s0, s1, dy));
#ifdef WITH_COLOR
    (*quad).r = fma(w, vec4<f32>(s1.z), (*quad).r);
    (*quad).g = fma(w, vec4<f32>(s1.w), (*quad).g);
    (*quad).b = fma(w, vec4<f32>(s2.x), (*quad).b);
#endif
#ifdef WITH_FEATURE
    (*quad).f0 = fma(w, vec4<f32>(s2.y), (*quad).f0);
    (*quad).f1 = fma(w, vec4<f32>(s2.z), (*quad).f1);
    (*quad).f2 = fma(w, vec4<f32>(s2.w), (*quad).f2);
#endif
    (*quad).transmittance = t - w;
}

fn store_quad(quad: Quad, x: u32, y: u32, walked: f32) {
    let t = quad.transmittance;
    let inside_image = inside(x, y, view);
#ifdef WITH_COLOR
    frame[quad_at(0u, x, y, view)] = inside_image * (quad.r + t * view.background_color.r);
    frame[quad_at(1u, x, y, view)] = inside_image * (quad.g + t * view.background_color.g);
    frame[quad_at(2u, x, y, view)] = inside_image * (quad.b + t * view.background_color.b);
#endif
#ifdef WITH_FEATURE
    frame[quad_at(3u, x, y, view)] = inside_image * (quad.f0 + t * view.background_feature.x);
    frame[quad_at(4u, x, y, view)] = inside_image * (quad.f1 + t * view.background_feature.y);
    frame[quad_at(5u, x, y, view)] = inside_image * (quad.f2 + t * view.background_feature.z);
#endif
    frame[quad_at(6u, x, y, view)] = t;
    frame[quad_at(7u, x, y, view)] = vec4<f32>(walked);
}

// Number of Gaussians after which blending checks whether a tile is finished.
const BATCH: u32 = 8u;

#ifdef WIDE
#else
#import stage

// The unrolled loop below requires these values; Gaussians are staged in every second batch.
const_assert BATCH == 8u && TILE_LANES == 2u * BATCH;

// Bit mask of the workgroup's tiles that are not finished.
var<workgroup> unfinished_tiles: atomic<u32>;
#endif

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    let lane = lane_of(flat_group(group, groups), index);
    let start = lane.start;
    let length = lane.end - start;
    let x = lane.x;
    let y = lane.y;
    let px = vec4<f32>(f32(x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(y) + 0.5;
#each Q
    var q$Q: Quad;
    // Pixels outside the image start with transmittance 0.
    q$Q.transmittance = inside(x + 4u * ($Qu % QUADS_X), y + $Qu / QUADS_X, view);
#end
    var walked = 0u;
#ifdef WIDE
    while walked < length {
        let stop = min(walked + BATCH, length);
        for (; walked < stop; walked++) {
            let i = 3u * pair_gaussians[sorted_pairs[start + walked]];
            let s0 = splats[i];
            let s1 = splats[i + 1u];
            let s2 = splats[i + 2u];
            let dx = px - s0.x;
            let dy = py - s0.y;
#each Q
            add(&q$Q, dx + f32(4u * ($Qu % QUADS_X)), dy + f32($Qu / QUADS_X), s0, s1, s2);
#end
        }
        var most = vec4<f32>(0.0);
#each Q
        most = max(most, q$Q.transmittance);
#end
        if all(most < vec4<f32>(view.finished)) {
            break;
        }
    }
#else
    var fetched = fetch(start, lane.plane_index, length);
    var unfinished = length > 0u;
    for (var k = 0u; ; k += BATCH) {
        if index == 0u {
            atomicStore(&unfinished_tiles, 0u);
        }
        if k % TILE_LANES == 0u {
            stage(fetched, lane.tile, k + lane.plane_index);
            fetched = fetch(start, k + TILE_LANES + lane.plane_index, length);
        }
        workgroupBarrier();
        if unfinished {
            walked = min(k + BATCH, length);
#each K 8
            let at$K = staged_at(lane.tile, k + $Ku);
            add(&q0, px - staged_splats[at$K][0].x, py - staged_splats[at$K][0].y, staged_splats[at$K][0], staged_splats[at$K][1], staged_splats[at$K][2]);
#end
            if walked < length && any(q0.transmittance >= vec4<f32>(view.finished)) {
                atomicOr(&unfinished_tiles, 1u << lane.tile);
            }
        }
        let still_open = workgroupUniformLoad(&unfinished_tiles);
        if still_open == 0u {
            break;
        }
        unfinished = (still_open & (1u << lane.tile)) != 0u;
    }
#endif
    if lane.exists {
#each Q
        store_quad(q$Q, x + 4u * ($Qu % QUADS_X), y + $Qu / QUADS_X, f32(walked));
#end
    }
}
