// Front-to-back blending of colour and feature in one pass (paper, rendering features; 3DGS eq. 3).
//
// frame [8][h][w]: r, g, b, f0, f1, f2 with the background blended in, transmittance left, and
//                  number of pairs walked through before the pixel's invocation was finished.
#import view
#import flat
#import lane

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> frame: array<f32>;

struct Quad {
    transmittance: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
}

// Blends one Gaussian into a quad; returns which pixels were still open before.
fn add(quad: ptr<function, Quad>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) -> vec4<bool> {
    let t = (*quad).transmittance;
    let open = t >= vec4<f32>(TRANSMITTANCE_MIN);
    let w = t * alphas(dx, dy, vec3<f32>(s0.zw, s1.x), s1.y, open);
    (*quad).r = fma(w, vec4<f32>(s1.z), (*quad).r);
    (*quad).g = fma(w, vec4<f32>(s1.w), (*quad).g);
    (*quad).b = fma(w, vec4<f32>(s2.x), (*quad).b);
    (*quad).f0 = fma(w, vec4<f32>(s2.y), (*quad).f0);
    (*quad).f1 = fma(w, vec4<f32>(s2.z), (*quad).f1);
    (*quad).f2 = fma(w, vec4<f32>(s2.w), (*quad).f2);
    (*quad).transmittance = t - w;
    return open;
}

fn store(channel: u32, value: vec4<f32>, x: u32, y: u32) {
    let base = (channel * view.size.y + y) * view.size.x + x;
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.size.x {
            frame[base + k] = value[k];
        }
    }
}

fn store_quad(quad: Quad, x: u32, y: u32, walked: f32) {
    if y >= view.size.y {
        return;
    }
    let t = quad.transmittance;
    store(0u, quad.r + t * view.background_color.r, x, y);
    store(1u, quad.g + t * view.background_color.g, x, y);
    store(2u, quad.b + t * view.background_color.b, x, y);
    store(3u, quad.f0 + t * view.background_feature.x, x, y);
    store(4u, quad.f1 + t * view.background_feature.y, x, y);
    store(5u, quad.f2 + t * view.background_feature.z, x, y);
    store(6u, t, x, y);
    store(7u, vec4<f32>(walked), x, y);
}

@compute @workgroup_size(8)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let place = lane_of(flat_group(group, groups), lane, view);
    if place.tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let px = vec4<f32>(f32(place.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(place.y) + 0.5;
#each Q
    var q$Q: Quad;
    // Pixels outside the picture are finished before they start.
    q$Q.transmittance = select(vec4<f32>(0.0), vec4<f32>(1.0), inside(place.x + 4u * ($Qu % QUADS_X), place.y + $Qu / QUADS_X, view));
#end
    let start = ranges[2u * place.tile];
    let end = ranges[2u * place.tile + 1u];
    var k = start;
    for (; k < end; k++) {
        let i = 3u * pair_gaussians[sorted_pairs[k]];
        let s0 = splats[i];
        let s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
        let dx = px - s0.x;
        let dy = py - s0.y;
        var open = vec4<bool>(false);
#each Q
        open = open | add(&q$Q, dx + f32(4u * ($Qu % QUADS_X)), dy + f32($Qu / QUADS_X), s0, s1, s2);
#end
        if !any(open) {
            break;
        }
    }
#each Q
    store_quad(q$Q, place.x + 4u * ($Qu % QUADS_X), place.y + $Qu / QUADS_X, f32(k - start));
#end
}
