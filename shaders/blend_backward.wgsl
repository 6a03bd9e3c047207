// Gradients of blending, front to back from the stored final picture: one slot of 12 floats for each pair.
//
// With R the light still to come behind Gaussian i (background included), dL/dalpha_i = T_i c_i.g - (R.g) / (1 - alpha_i).
// Only the scalar R.g is carried, so the pass needs one value a pixel whatever the number of channels.
//
// gradient [6][h][w]        dL/d(colour, feature) of the frame
// slots    [pairs][3] vec4  sums over the tile's pixels, p being the exponent:
//                           (p dx, p dy, p dx^2, p dx dy) (p dy^2, opacity, r, g) (b, f0, f1, f2)
#import view
#import flat
#import lane

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> frame: array<f32>;
@group(0) @binding(6) var<storage, read> gradient: array<f32>;
@group(0) @binding(7) var<storage, read_write> slots: array<vec4<f32>>;

struct Quad {
    transmittance: vec4<f32>,
    // R.g: what the light behind is worth.
    behind: vec4<f32>,
    gr: vec4<f32>,
    gg: vec4<f32>,
    gb: vec4<f32>,
    g0: vec4<f32>,
    g1: vec4<f32>,
    g2: vec4<f32>,
}

// Sums over the pixels of an invocation, still one for each column of a quad.
struct Slot {
    p: vec4<f32>,
    px: vec4<f32>,
    py: vec4<f32>,
    pxx: vec4<f32>,
    pxy: vec4<f32>,
    pyy: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
}

fn load_gradient(channel: u32, x: u32, y: u32) -> vec4<f32> {
    var value = vec4<f32>(0.0);
    let base = (channel * view.size.y + y) * view.size.x + x;
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.size.x && y < view.size.y {
            value[k] = gradient[base + k];
        }
    }
    return value;
}

fn load_frame(channel: u32, x: u32, y: u32) -> vec4<f32> {
    var value = vec4<f32>(0.0);
    let base = (channel * view.size.y + y) * view.size.x + x;
    for (var k = 0u; k < 4u; k++) {
        if x + k < view.size.x && y < view.size.y {
            value[k] = frame[base + k];
        }
    }
    return value;
}

fn load_quad(x: u32, y: u32) -> Quad {
    var quad: Quad;
    // Pixels outside the picture are finished before they start.
    quad.transmittance = select(vec4<f32>(0.0), vec4<f32>(1.0), inside(x, y, view));
    quad.gr = load_gradient(0u, x, y);
    quad.gg = load_gradient(1u, x, y);
    quad.gb = load_gradient(2u, x, y);
    quad.g0 = load_gradient(3u, x, y);
    quad.g1 = load_gradient(4u, x, y);
    quad.g2 = load_gradient(5u, x, y);
    quad.behind = load_frame(0u, x, y) * quad.gr + load_frame(1u, x, y) * quad.gg + load_frame(2u, x, y) * quad.gb;
    let moves = f32(view.feature_moves_geometry);
    quad.behind += moves * (load_frame(3u, x, y) * quad.g0 + load_frame(4u, x, y) * quad.g1 + load_frame(5u, x, y) * quad.g2);
    return quad;
}

// `moves` is the splat's feature where the feature loss moves geometry, else zero.
fn add(quad: ptr<function, Quad>, slot: ptr<function, Slot>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, blue: f32, moves: vec3<f32>) {
    let t = (*quad).transmittance;
    let alpha = alphas(dx, dy, vec3<f32>(s0.zw, s1.x), s1.y, t >= vec4<f32>(TRANSMITTANCE_MIN));
    let w = alpha * t;
    let color = fma(vec4<f32>(s1.z), (*quad).gr, fma(vec4<f32>(s1.w), (*quad).gg, blue * (*quad).gb));
    let worth = fma(vec4<f32>(moves.x), (*quad).g0, fma(vec4<f32>(moves.y), (*quad).g1, fma(vec4<f32>(moves.z), (*quad).g2, color)));
    (*quad).behind = fma(-w, worth, (*quad).behind);
    (*quad).transmittance = t - w;
    // p = dL/d(exponent) = alpha dL/dalpha.
    let p = alpha * (t * worth - (*quad).behind / (1.0 - alpha));
    let px = p * dx;
    (*slot).p += p;
    (*slot).px += px;
    (*slot).py = fma(p, vec4<f32>(dy), (*slot).py);
    (*slot).pxx = fma(px, dx, (*slot).pxx);
    (*slot).pxy = fma(px, vec4<f32>(dy), (*slot).pxy);
    (*slot).pyy = fma(p, vec4<f32>(dy * dy), (*slot).pyy);
    (*slot).r = fma(w, (*quad).gr, (*slot).r);
    (*slot).g = fma(w, (*quad).gg, (*slot).g);
    (*slot).b = fma(w, (*quad).gb, (*slot).b);
    (*slot).f0 = fma(w, (*quad).g0, (*slot).f0);
    (*slot).f1 = fma(w, (*quad).g1, (*slot).f1);
    (*slot).f2 = fma(w, (*quad).g2, (*slot).f2);
}

fn sum4(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

#ifdef WIDE
fn over_lanes(v: vec4<f32>, lane: u32) -> vec4<f32> {
    return v;
}
fn last_of(walked: u32, lane: u32) -> u32 {
    return walked;
}
fn writes(lane: u32) -> bool {
    return true;
}
#else
fn writes(lane: u32) -> bool {
    return lane == 0u;
}

// How far the forward pass walked in each lane's block.
var<workgroup> walked_of: array<u32, 8>;
var<workgroup> walked_most: u32;

fn last_of(walked: u32, lane: u32) -> u32 {
    walked_of[lane] = walked;
    workgroupBarrier();
    if lane == 0u {
        walked_most = 0u;
        for (var k = 0u; k < 8u; k++) {
            walked_most = max(walked_most, walked_of[k]);
        }
    }
    return workgroupUniformLoad(&walked_most);
}
#ifdef SUBGROUPS
fn over_lanes(v: vec4<f32>, lane: u32) -> vec4<f32> {
    return subgroupAdd(v);
}
#else
var<workgroup> exchange: array<vec4<f32>, 8>;
fn over_lanes(v: vec4<f32>, lane: u32) -> vec4<f32> {
    exchange[lane] = v;
    workgroupBarrier();
    var sum = exchange[0];
    for (var k = 1u; k < 8u; k++) {
        sum += exchange[k];
    }
    workgroupBarrier();
    return sum;
}
#endif
#endif

@compute @workgroup_size(8)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let place = lane_of(flat_group(group, groups), lane, view);
    if place.tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let px = vec4<f32>(f32(place.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(place.y) + 0.5;
#each Q
    var q$Q = load_quad(place.x + 4u * ($Qu % QUADS_X), place.y + $Qu / QUADS_X);
#end
    var walked = 0u;
    if place.x < view.size.x && place.y < view.size.y {
        walked = u32(frame[(7u * view.size.y + place.y) * view.size.x + place.x]);
    }
    let start = ranges[2u * place.tile];
    let stop = start + last_of(walked, lane);
    for (var k = start; k < stop; k++) {
        let e = sorted_pairs[k];
        let i = 3u * pair_gaussians[e];
        let s0 = splats[i];
        let s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
        let moves = f32(view.feature_moves_geometry) * s2.yzw;
        let dx = px - s0.x;
        let dy = py - s0.y;
        var slot: Slot;
#each Q
        add(&q$Q, &slot, dx + f32(4u * ($Qu % QUADS_X)), dy + f32($Qu / QUADS_X), s0, s1, s2.x, moves);
#end
        // d alpha / d opacity = alpha / opacity.
        let a = over_lanes(vec4<f32>(sum4(slot.px), sum4(slot.py), sum4(slot.pxx), sum4(slot.pxy)), lane);
        let b = over_lanes(vec4<f32>(sum4(slot.pyy), sum4(slot.p) / s1.y, sum4(slot.r), sum4(slot.g)), lane);
        let c = over_lanes(vec4<f32>(sum4(slot.b), sum4(slot.f0), sum4(slot.f1), sum4(slot.f2)), lane);
        if writes(lane) {
            slots[3u * e] = a;
            slots[3u * e + 1u] = b;
            slots[3u * e + 2u] = c;
        }
    }
    // Pairs that no pixel of the tile reached.
    for (var k = stop; k < ranges[2u * place.tile + 1u]; k++) {
        let e = 3u * sorted_pairs[k];
        if writes(lane) {
            slots[e] = vec4<f32>(0.0);
            slots[e + 1u] = vec4<f32>(0.0);
            slots[e + 2u] = vec4<f32>(0.0);
        }
    }
}
