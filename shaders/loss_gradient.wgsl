// Computes the gradient of (1 - lambda) L1 + lambda (1 - SSIM) (paper, optimisation), and sums for
// the loss and the exposure.
//
// rows     [planes][4][padded rows][quads]  three maps from ssim_backward_rows
// gradient [6][padded rows][quads]          dL/d frame
// sums     [4][6][tile rows][quads]         sums over eight rows of |x - y|, dL/d gain,
//                                           dL/d offset and dL/d background
#import columns
#import flat

@group(0) @binding(0) var<uniform> planes: Planes;
@group(0) @binding(1) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> targets: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> rows: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> gradient: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> sums: array<vec4<f32>>;

struct Totals {
    error: vec4<f32>,
    gain: vec4<f32>,
    offset: vec4<f32>,
    background: vec4<f32>,
}

fn add(totals: ptr<function, Totals>, quad: u32, row: u32, by_mean: vec4<f32>, by_square: vec4<f32>, by_product: vec4<f32>) {
    let place = row * plane.quads + quad;
    let at = plane.channel * plane.rows * plane.quads + place;
    let rendered = frame[at];
    let x = exposed(rendered, quad, row);
    let t = unpack_target(targets[(plane.channel / 3u) * plane.rows * plane.quads + place], plane.channel);
    let weight = select(vec4<f32>(0.0), inside_image(quad, row), t.counts);
    let y = select(x, t.value, t.counts);
    let d_ssim = by_mean + 2.0 * x * by_square + y * by_product;
    let value = weight * plane.scale * ((1.0 - plane.lambda) * sign(x - y) - plane.lambda * d_ssim);
    gradient[at] = plane.gain * value;
    (*totals).error += weight * abs(x - y);
    (*totals).gain = fma(value, rendered, (*totals).gain);
    (*totals).offset += value;
    // Transmittance behind all Gaussians.
    let transmittance = frame[6u * plane.rows * plane.quads + place];
    (*totals).background = fma(plane.gain * value, transmittance, (*totals).background);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    take_plane(group);
    let id = flat_group(group, groups) * 64u + lane;
    let runs = plane.rows / 8u;
    if id >= runs * plane.quads {
        return;
    }
    let quad = id % plane.quads;
    let first = 8u * (id / plane.quads);
    let by_mean = blurred(0u, quad, i32(first));
    let by_square = blurred(1u, quad, i32(first));
    let by_product = blurred(2u, quad, i32(first));
    var totals: Totals;
#each K 8
    add(&totals, quad, first + $Ku, by_mean[$K], by_square[$K], by_product[$K]);
#end
    let size = runs * plane.quads;
    let place = plane.channel * size + id;
    sums[place] = totals.error;
    sums[6u * size + place] = totals.gain;
    sums[12u * size + place] = totals.offset;
    sums[18u * size + place] = totals.background;
}
