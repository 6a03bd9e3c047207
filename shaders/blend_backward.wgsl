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

struct Row {
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

struct Slot {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
}

fn load(channel: u32, x: u32, y: u32) -> vec4<f32> {
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

fn load_row(x: u32, y: u32) -> Row {
    var row: Row;
    // Pixels outside the picture start opaque: nothing is drawn there.
    let inside = (vec4<u32>(x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(view.size.x)) & vec4<bool>(y < view.size.y);
    row.transmittance = select(vec4<f32>(0.0), vec4<f32>(1.0), inside);
    row.gr = load(0u, x, y);
    row.gg = load(1u, x, y);
    row.gb = load(2u, x, y);
    row.g0 = load(3u, x, y);
    row.g1 = load(4u, x, y);
    row.g2 = load(5u, x, y);
    row.behind = load_frame(0u, x, y) * row.gr + load_frame(1u, x, y) * row.gg + load_frame(2u, x, y) * row.gb;
    let moves = f32(view.feature_moves_geometry);
    row.behind += moves * (load_frame(3u, x, y) * row.g0 + load_frame(4u, x, y) * row.g1 + load_frame(5u, x, y) * row.g2);
    return row;
}

fn sum4(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

fn add(row: ptr<function, Row>, slot: ptr<function, Slot>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) {
    let t = (*row).transmittance;
    let alpha = alphas(dx, dy, vec3<f32>(s0.zw, s1.x), s1.y, t);
    let w = alpha * t;
    let moves = f32(view.feature_moves_geometry) * s2.yzw;
    let worth = s1.z * (*row).gr + s1.w * (*row).gg + s2.x * (*row).gb + moves.x * (*row).g0 + moves.y * (*row).g1 + moves.z * (*row).g2;
    (*row).behind -= w * worth;
    (*row).transmittance = t - w;
    let unclamped = select(vec4<f32>(0.0), vec4<f32>(1.0), (alpha > vec4<f32>(0.0)) & (alpha < vec4<f32>(ALPHA_MAX)));
    let d_alpha = unclamped * (t * worth - (*row).behind / (1.0 - alpha));
    // d alpha / d exponent = alpha; d alpha / d opacity = alpha / opacity.
    let p = d_alpha * alpha;
    let px = p * dx;
    let sp = sum4(p);
    let spx = sum4(px);
    (*slot).a += vec4<f32>(spx, sp * dy, sum4(px * dx), spx * dy);
    (*slot).b += vec4<f32>(sp * dy * dy, sp / s1.y, sum4(w * (*row).gr), sum4(w * (*row).gg));
    (*slot).c += vec4<f32>(sum4(w * (*row).gb), sum4(w * (*row).g0), sum4(w * (*row).g1), sum4(w * (*row).g2));
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

// How far the forward pass walked in each lane's block.
var<workgroup> walked: array<u32, 8>;
var<workgroup> walked_most: u32;

@compute @workgroup_size(8)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = flat_group(group, groups);
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let place = lane_of(tile, lane, view);
    let px = vec4<f32>(f32(place.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(place.y) + 0.5;
    var upper = load_row(place.x, place.y);
    var lower = load_row(place.x, place.y + 1u);
    walked[lane] = 0u;
    if place.x < view.size.x && place.y < view.size.y {
        walked[lane] = u32(frame[(7u * view.size.y + place.y) * view.size.x + place.x]);
    }
    workgroupBarrier();
    if lane == 0u {
        walked_most = 0u;
        for (var k = 0u; k < 8u; k++) {
            walked_most = max(walked_most, walked[k]);
        }
    }
    let start = ranges[2u * tile];
    let stop = start + workgroupUniformLoad(&walked_most);
    for (var k = start; k < stop; k++) {
        let e = sorted_pairs[k];
        let i = 3u * pair_gaussians[e];
        let s0 = splats[i];
        let s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
        let dx = px - s0.x;
        var slot: Slot;
        add(&upper, &slot, dx, py - s0.y, s0, s1, s2);
        add(&lower, &slot, dx, py + 1.0 - s0.y, s0, s1, s2);
        let a = over_lanes(slot.a, lane);
        let b = over_lanes(slot.b, lane);
        let c = over_lanes(slot.c, lane);
        if lane == 0u {
            slots[3u * e] = a;
            slots[3u * e + 1u] = b;
            slots[3u * e + 2u] = c;
        }
    }
    // Pairs that no pixel of the tile reached.
    for (var k = stop + lane; k < ranges[2u * tile + 1u]; k += 8u) {
        let e = 3u * sorted_pairs[k];
        slots[e] = vec4<f32>(0.0);
        slots[e + 1u] = vec4<f32>(0.0);
        slots[e + 2u] = vec4<f32>(0.0);
    }
}
