// Front-to-back blending of colour and feature in one pass (paper, rendering features; 3DGS eq. 3).
//
// frame [8][h][w]: r, g, b, f0, f1, f2 with the background blended in, transmittance left, and
//                  number of pairs walked through before the pixel's block was finished.
#import view
#import flat
#import lane

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> frame: array<f32>;

struct Row {
    transmittance: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
}

fn add(row: ptr<function, Row>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) {
    let alpha = alphas(dx, dy, vec3<f32>(s0.zw, s1.x), s1.y, (*row).transmittance);
    let w = alpha * (*row).transmittance;
    (*row).r += w * s1.z;
    (*row).g += w * s1.w;
    (*row).b += w * s2.x;
    (*row).f0 += w * s2.y;
    (*row).f1 += w * s2.z;
    (*row).f2 += w * s2.w;
    (*row).transmittance -= w;
}

fn store(channel: u32, value: vec4<f32>, x: u32, y: u32) {
    let base = (channel * view.size.y + y) * view.size.x + x;
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.size.x {
            frame[base + k] = value[k];
        }
    }
}

fn store_row(row: Row, x: u32, y: u32, walked: f32) {
    if y >= view.size.y {
        return;
    }
    let t = row.transmittance;
    store(0u, row.r + t * view.background_color.r, x, y);
    store(1u, row.g + t * view.background_color.g, x, y);
    store(2u, row.b + t * view.background_color.b, x, y);
    store(3u, row.f0 + t * view.background_feature.x, x, y);
    store(4u, row.f1 + t * view.background_feature.y, x, y);
    store(5u, row.f2 + t * view.background_feature.z, x, y);
    store(6u, t, x, y);
    store(7u, vec4<f32>(walked), x, y);
}

@compute @workgroup_size(8)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = flat_group(group, groups);
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let place = lane_of(tile, lane, view);
    let px = vec4<f32>(f32(place.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(place.y) + 0.5;
    var upper: Row;
    var lower: Row;
    upper.transmittance = vec4<f32>(1.0);
    lower.transmittance = vec4<f32>(1.0);
    let start = ranges[2u * tile];
    let end = ranges[2u * tile + 1u];
    var k = start;
    for (; k < end; k++) {
        let i = 3u * pair_gaussians[sorted_pairs[k]];
        let s0 = splats[i];
        let s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
        let dx = px - s0.x;
        add(&upper, dx, py - s0.y, s0, s1, s2);
        add(&lower, dx, py + 1.0 - s0.y, s0, s1, s2);
        let most = max(upper.transmittance, lower.transmittance);
        if max(max(most.x, most.y), max(most.z, most.w)) < TRANSMITTANCE_MIN {
            k++;
            break;
        }
    }
    store_row(upper, place.x, place.y, f32(k - start));
    store_row(lower, place.x, place.y + 1u, f32(k - start));
}
