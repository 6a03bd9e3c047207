// Gradients of blending, front to back from the stored final picture: one slot for each pair; docs/gradients.md, section 1.
//
// With R the light still to come behind Gaussian i (background included), dL/dalpha_i = T_i c_i.g - (R.g) / (1 - alpha_i).
// Only the scalar R.g is carried, so the pass needs one value a pixel whatever the number of channels.
//
// gradient [6][tile rows * 8][tile columns * 8]  dL/d(colour, feature) of the frame
// slots    [window]  sums over the tile's pixels, p being dL/d(exponent); vec4s of a pair:
//                    (p dx, p dy, p dx^2, p dx dy) (p dy^2, p, r, g) (b, f0, f1, f2); with frozen geometry only the last
#import view
#import flat
#import lane
#import slot

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<u32>;
@group(0) @binding(2) var<storage, read> tile_order: array<u32>;
@group(0) @binding(3) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(4) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> gradient: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> slots: array<vec4<f32>>;

struct Quad {
    transmittance: vec4<f32>,
    // R.g of what lies behind the Gaussians that were walked so far.
    r_dot_g: vec4<f32>,
    gr: vec4<f32>,
    gg: vec4<f32>,
    gb: vec4<f32>,
    g0: vec4<f32>,
    g1: vec4<f32>,
    g2: vec4<f32>,
}

// Sums over the rows of an invocation, still one for each column: dx does not change within them.
struct Column {
    p: vec4<f32>,
    py: vec4<f32>,
    pyy: vec4<f32>,
}

// Sums over the quads of an invocation.
struct Sums {
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
}

fn load_quad(x: u32, y: u32) -> Quad {
    var quad: Quad;
    quad.transmittance = inside(x, y, view);
#ifdef WITH_COLOR
    quad.gr = gradient[quad_at(0u, x, y, view)];
    quad.gg = gradient[quad_at(1u, x, y, view)];
    quad.gb = gradient[quad_at(2u, x, y, view)];
    quad.r_dot_g = frame[quad_at(0u, x, y, view)] * quad.gr + frame[quad_at(1u, x, y, view)] * quad.gg + frame[quad_at(2u, x, y, view)] * quad.gb;
#endif
#ifdef WITH_FEATURE
    quad.g0 = gradient[quad_at(3u, x, y, view)];
    quad.g1 = gradient[quad_at(4u, x, y, view)];
    quad.g2 = gradient[quad_at(5u, x, y, view)];
#ifdef FEATURE_MOVES
    quad.r_dot_g += frame[quad_at(3u, x, y, view)] * quad.g0 + frame[quad_at(4u, x, y, view)] * quad.g1 + frame[quad_at(5u, x, y, view)] * quad.g2;
#endif
#endif
    return quad;
}

fn add(quad: ptr<function, Quad>, column: ptr<function, Column>, sums: ptr<function, Sums>, dx: vec4<f32>, dy: f32, s0: vec4<f32>, s1: vec4<f32>, s2: vec4<f32>) {
    let t = (*quad).transmittance;
    let alpha = alphas(dx, s0.z, row_of(s0, s1, dy));
    let w = alpha * t;
    (*quad).transmittance = t - w;
#ifdef WITH_COLOR
    var c_dot_g = fma(vec4<f32>(s1.z), (*quad).gr, fma(vec4<f32>(s1.w), (*quad).gg, s2.x * (*quad).gb));
#ifdef FEATURE_MOVES
    c_dot_g = fma(vec4<f32>(s2.y), (*quad).g0, fma(vec4<f32>(s2.z), (*quad).g1, fma(vec4<f32>(s2.w), (*quad).g2, c_dot_g)));
#endif
    let w_c_dot_g = w * c_dot_g;
    let r_dot_g = (*quad).r_dot_g - w_c_dot_g;
    (*quad).r_dot_g = r_dot_g;
    // p = dL/d(exponent) = alpha dL/dalpha.
    let p = w_c_dot_g - r_dot_g * (alpha / (1.0 - alpha));
    (*column).p += p;
    (*column).py = fma(p, vec4<f32>(dy), (*column).py);
    (*column).pyy = fma(p, vec4<f32>(dy * dy), (*column).pyy);
    (*sums).r = fma(w, (*quad).gr, (*sums).r);
    (*sums).g = fma(w, (*quad).gg, (*sums).g);
    (*sums).b = fma(w, (*quad).gb, (*sums).b);
#endif
#ifdef WITH_FEATURE
    (*sums).f0 = fma(w, (*quad).g0, (*sums).f0);
    (*sums).f1 = fma(w, (*quad).g1, (*sums).f1);
    (*sums).f2 = fma(w, (*quad).g2, (*sums).f2);
#endif
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
    let block = lane_of(flat_group(group, groups), lane);
    if block.place >= view.tiles.x * view.tiles.y {
        return;
    }
    let tile = tile_order[block.place];
    let x = (tile % view.tiles.x) * TILE + block.x;
    let y = (tile / view.tiles.x) * TILE + block.y;
    let px = vec4<f32>(f32(x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(y) + 0.5;
#each Q
    var q$Q = load_quad(x + 4u * ($Qu % QUADS_X), y + $Qu / QUADS_X);
#end
    let start = ranges[2u * tile];
    let walked = u32(frame[quad_at(7u, x, y, view)].x);
    let stop = start + last_of(walked, lane);
    let own_stop = start + walked;
    for (var k = start; k < stop; k++) {
        let e = sorted_pairs[k];
        let i = 3u * pair_gaussians[e];
        let s0 = splats[i];
        var s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
#ifdef WIDE
#else
        // The forward pass was finished with this lane's block: the Gaussian is as good as transparent here.
        s1.y = select(-1e9, s1.y, k < own_stop);
#endif
        let dx = px - s0.x;
        let dy = py - s0.y;
        var c0: Column;
        var c1: Column;
        var sums: Sums;
#each Q
        add(&q$Q, &c$C, &sums, dx + f32(4u * ($Qu % QUADS_X)), dy + f32($Qu / QUADS_X), s0, s1, s2);
#end
#ifdef WITH_COLOR
        // Shapes with one column of quads leave the second at zero.
        let right = dx + 4.0;
        let px0 = c0.p * dx;
        let px1 = c1.p * right;
        let pxx = fma(px0, dx, px1 * right);
        let pxy = fma(c0.py, dx, c1.py * right);
        let a = over_lanes(vec4<f32>(sum4(px0 + px1), sum4(c0.py + c1.py), sum4(pxx), sum4(pxy)), lane);
        let b = over_lanes(vec4<f32>(sum4(c0.pyy + c1.pyy), sum4(c0.p + c1.p), sum4(sums.r), sum4(sums.g)), lane);
        var last = vec4<f32>(sum4(sums.b), 0.0, 0.0, 0.0);
#else
        var last = vec4<f32>(0.0);
#endif
#ifdef WITH_FEATURE
        last = vec4<f32>(last.x, sum4(sums.f0), sum4(sums.f1), sum4(sums.f2));
#endif
        let c = over_lanes(last, lane);
        if writes(lane) && in_window(e, view) {
            let s = SLOT * (e - view.slot_first);
#ifdef WITH_COLOR
            slots[s] = a;
            slots[s + 1u] = b;
#endif
            slots[s + SLOT - 1u] = c;
        }
    }
    // Pairs that no pixel of the tile reached.
    for (var k = stop; k < ranges[2u * tile + 1u]; k++) {
        let e = sorted_pairs[k];
        if writes(lane) && in_window(e, view) {
            for (var s = 0u; s < SLOT; s++) {
                slots[SLOT * (e - view.slot_first) + s] = vec4<f32>(0.0);
            }
        }
    }
}
