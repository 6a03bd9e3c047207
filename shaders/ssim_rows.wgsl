// Finishes the blur along rows and differentiates SSIM (Wang et al. 2004) by the three local moments of x.
//
// moments  [5][padded rows / 2][quads]  from ssim_columns
// partials [3][padded rows / 2][quads]  d SSIM / d (mean x, mean x^2, mean x y)
// sums     [6][padded rows / 2][quads / 2]  sum of SSIM over two quads, for the loss
#import rows
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> moments: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4<f32>>;

fn load(base: u32, quad: i32) -> vec4<f32> {
    let value = moments[base + u32(clamp(quad, 0, i32(plane.quads) - 1))];
    return select(vec4<f32>(0.0), value, quad >= 0 && quad < i32(plane.quads));
}

fn blurred(map: u32, quad: u32, row: u32) -> array<vec4<f32>, 2> {
    let base = (map * (plane.rows / 2u) + row) * plane.quads;
    return blurred_row(array<vec4<f32>, 6>(
#each K 6
        load(base, i32(quad) + $K - 2),
#end
    ));
}

// SSIM of four pixels from their five local moments; stores its derivatives.
fn ssim(quad: u32, row: u32, mx: vec4<f32>, my: vec4<f32>, xx: vec4<f32>, yy: vec4<f32>, xy: vec4<f32>) -> vec4<f32> {
    let a = 2.0 * mx * my + 0.0001;
    let b = 2.0 * (xy - mx * my) + 0.0009;
    let c = mx * mx + my * my + 0.0001;
    let d = (xx - mx * mx) + (yy - my * my) + 0.0009;
    let weight = shown(quad, 2u * row + plane.phase);
    let inverse = 1.0 / (c * d);
    let value = a * b * inverse;
    let size = (plane.rows / 2u) * plane.quads;
    let place = row * plane.quads + quad;
    // sigma terms depend on the mean too: b and d lose 2 mx my and mx^2.
    partials[place] = weight * (2.0 * my * (b - a) * inverse - 2.0 * mx * value * (d - c) * inverse);
    partials[size + place] = -weight * value / d;
    partials[2u * size + place] = weight * 2.0 * a * inverse;
    return weight * value;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = flat_group(group, groups) * 64u + lane;
    let runs = plane.quads / 2u;
    let count = runs * (plane.rows / 2u);
    if id >= count {
        return;
    }
    let row = id / runs;
    let quad = 2u * (id % runs);
    let mx = blurred(0u, quad, row);
    let my = blurred(1u, quad, row);
    let xx = blurred(2u, quad, row);
    let yy = blurred(3u, quad, row);
    let xy = blurred(4u, quad, row);
    var total = vec4<f32>(0.0);
#each K 2
    total += ssim(quad + $Ku, row, mx[$K], my[$K], xx[$K], yy[$K], xy[$K]);
#end
    sums[plane.channel * count + id] = total;
}
