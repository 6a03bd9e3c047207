// Computes the gradients of blending, front to back from the stored frame, and writes one slot for
// each (tile, Gaussian) pair; docs/how-it-works.md, section 5.1.
//
// R is the colour behind Gaussian i, including the background:
//     dL/dalpha_i = T_i c_i.g - (R.g) / (1 - alpha_i)
// Only the scalar R.g is carried: one value for each pixel, whatever the number of channels.
//
// gradient [6][tile rows * 8][tile columns * 8]  dL/d(colour, feature) of the frame
// slots    [window]  sums over the tile's pixels, with p = dL/d(exponent); the vec4s of a pair are
//                    (p dx, p dy, p dx^2, p dx dy) (p dy^2, p, r, g) (b, f0, f1, f2);
//                    with frozen geometry only the last one
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
#ifdef WIDE
@group(0) @binding(8) var<storage, read_write> slots: array<vec4<f32>>;
#else
// An array of floats, because several invocations write to one slot. In some shading languages,
// writing a component of a vector reads and writes the whole vector.
@group(0) @binding(8) var<storage, read_write> slots: array<f32>;
#endif

struct Quad {
    transmittance: vec4<f32>,
    // R.g, with R the colour behind the Gaussians processed so far.
    r_dot_g: vec4<f32>,
    gr: vec4<f32>,
    gg: vec4<f32>,
    gb: vec4<f32>,
    g0: vec4<f32>,
    g1: vec4<f32>,
    g2: vec4<f32>,
}

// Sums over the rows of an invocation, one for each pixel column, as dx is constant within a
// column.
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

struct Slot {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
}

// Returns the slot of one Gaussian from the sums of an invocation's two columns of quads. With only
// one column of quads, c1 is zero.
fn slot_of(c0: Column, c1: Column, sums: Sums, dx: vec4<f32>) -> Slot {
    var slot: Slot;
#ifdef WITH_COLOR
    let right = dx + 4.0;
    let px0 = c0.p * dx;
    let px1 = c1.p * right;
    let pxx = fma(px0, dx, px1 * right);
    let pxy = fma(c0.py, dx, c1.py * right);
    slot.a = vec4<f32>(sum4(px0 + px1), sum4(c0.py + c1.py), sum4(pxx), sum4(pxy));
    slot.b = vec4<f32>(sum4(c0.pyy + c1.pyy), sum4(c0.p + c1.p), sum4(sums.r), sum4(sums.g));
    slot.c.x = sum4(sums.b);
#endif
#ifdef WITH_FEATURE
    slot.c = vec4<f32>(slot.c.x, sum4(sums.f0), sum4(sums.f1), sum4(sums.f2));
#endif
    return slot;
}

#ifdef WIDE
#else
#import stage

// Number of Gaussians whose sums are added over a tile's invocations in one round.
const GAUSSIANS_PER_ROUND: u32 = 4u;
// The unrolled loops below require these values.
const_assert GAUSSIANS_PER_ROUND == 4u && TILE_LANES == 16u;
// Floats of a slot.
const SLOT_FLOATS: u32 = 4u * SLOT;

// [tile][Gaussian of the round][float of the slot][invocation]. Each row is rotated by its index,
// so that neither writing columns nor reading rows causes bank conflicts.
var<workgroup> exchange: array<f32, TILES * GAUSSIANS_PER_ROUND * SLOT_FLOATS * TILE_LANES>;
// Largest number of pairs to process among the workgroup's tiles.
var<workgroup> max_length: atomic<u32>;

fn exchange_at(tile: u32, row: u32, plane_index: u32) -> u32 {
    return (tile * GAUSSIANS_PER_ROUND * SLOT_FLOATS + row) * TILE_LANES + (plane_index + row) % TILE_LANES;
}

fn exchange_put(tile: u32, row: u32, plane_index: u32, v: vec4<f32>) {
    exchange[exchange_at(tile, row, plane_index)] = v.x;
    exchange[exchange_at(tile, row + 1u, plane_index)] = v.y;
    exchange[exchange_at(tile, row + 2u, plane_index)] = v.z;
    exchange[exchange_at(tile, row + 3u, plane_index)] = v.w;
}
#endif

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    let lane = lane_of(flat_group(group, groups), index);
    let start = lane.start;
    let x = lane.x;
    let y = lane.y;
    let px = vec4<f32>(f32(x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let py = f32(y) + 0.5;
#each Q
    var q$Q = load_quad(x + 4u * ($Qu % QUADS_X), y + $Qu / QUADS_X);
#end
    // Number of pairs that the forward pass processed.
    let length = select(0u, u32(frame[quad_at(7u, x, y, view)].x), lane.exists);
#ifdef WIDE
    for (var k = 0u; k < length; k++) {
        let e = sorted_pairs[start + k];
        let i = 3u * pair_gaussians[e];
        let s0 = splats[i];
        let s1 = splats[i + 1u];
        let s2 = splats[i + 2u];
        let dx = px - s0.x;
        let dy = py - s0.y;
        var c0: Column;
        var c1: Column;
        var sums: Sums;
#each Q
        add(&q$Q, &c$C, &sums, dx + f32(4u * ($Qu % QUADS_X)), dy + f32($Qu / QUADS_X), s0, s1, s2);
#end
        if in_window(e, view) {
            let slot = slot_of(c0, c1, sums, dx);
            let s = SLOT * (e - view.slot_first);
#ifdef WITH_COLOR
            slots[s] = slot.a;
            slots[s + 1u] = slot.b;
#endif
            slots[s + SLOT - 1u] = slot.c;
        }
    }
#else
    var fetched = fetch(start, lane.plane_index, length);
    if index == 0u {
        atomicStore(&max_length, 0u);
    }
    workgroupBarrier();
    atomicMax(&max_length, length);
    let most = workgroupUniformLoad(&max_length);
    for (var k = 0u; k < most; k += GAUSSIANS_PER_ROUND) {
        if k % TILE_LANES == 0u {
            stage(fetched, lane.tile, k + lane.plane_index);
            fetched = fetch(start, k + TILE_LANES + lane.plane_index, length);
        }
        workgroupBarrier();
        // Unrolled, so that four Gaussians are computed in parallel.
#each K 4
        let s0_$K = staged_splats[staged_at(lane.tile, k + $Ku)][0];
        let s1_$K = staged_splats[staged_at(lane.tile, k + $Ku)][1];
        let s2_$K = staged_splats[staged_at(lane.tile, k + $Ku)][2];
        let dx$K = px - s0_$K.x;
        var column$K: Column;
        var sums$K: Sums;
        add(&q0, &column$K, &sums$K, dx$K, py - s0_$K.y, s0_$K, s1_$K, s2_$K);
#end
#each K 4
        let slot$K = slot_of(column$K, Column(), sums$K, dx$K);
#ifdef WITH_COLOR
        exchange_put(lane.tile, SLOT_FLOATS * $Ku, lane.plane_index, slot$K.a);
        exchange_put(lane.tile, SLOT_FLOATS * $Ku + 4u, lane.plane_index, slot$K.b);
#endif
        exchange_put(lane.tile, SLOT_FLOATS * $Ku + SLOT_FLOATS - 4u, lane.plane_index, slot$K.c);
#end
        workgroupBarrier();
        for (var row = lane.plane_index; row < SLOT_FLOATS * GAUSSIANS_PER_ROUND; row += TILE_LANES) {
            var sum = 0.0;
#each K 16
            sum += exchange[exchange_at(lane.tile, row, $Ku)];
#end
            let i = k + row / SLOT_FLOATS;
            let e = staged_pairs[staged_pair_at(lane.tile, i)];
            if i < length && in_window(e, view) {
                slots[SLOT_FLOATS * (e - view.slot_first) + row % SLOT_FLOATS] = sum;
            }
        }
    }
#endif
    // Zeros the slots of pairs that the forward pass did not process.
#ifdef WIDE
    for (var k = start + length; k < lane.end; k++) {
        let e = sorted_pairs[k];
        if in_window(e, view) {
            for (var s = 0u; s < SLOT; s++) {
                slots[SLOT * (e - view.slot_first) + s] = vec4<f32>(0.0);
            }
        }
    }
#else
    // Neighbouring invocations write neighbouring floats. In dense scenes, most pairs are of this
    // kind.
    for (var i = lane.plane_index; i < SLOT_FLOATS * (lane.end - start - length); i += TILE_LANES) {
        let e = sorted_pairs[start + length + i / SLOT_FLOATS];
        if in_window(e, view) {
            slots[SLOT_FLOATS * (e - view.slot_first) + i % SLOT_FLOATS] = 0.0;
        }
    }
#endif
}
