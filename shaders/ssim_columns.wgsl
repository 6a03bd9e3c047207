// Blurs along columns and differentiates SSIM (Wang et al. 2004) by the three local moments that
// depend on x.
//
// rows     [planes][4][padded rows][quads]  from ssim_rows
// partials [planes][3][padded rows][quads]  d SSIM / d (mean x, mean x^2 + y^2, mean x y)
// sums     [6][tile rows][quads]            sum of SSIM over eight rows, for the loss
#import columns
#import flat

@group(0) @binding(0) var<uniform> planes: Planes;
@group(0) @binding(1) var<storage, read> rows: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4<f32>>;

// Returns the SSIM of four pixels from their four local moments. Stores its derivatives.
fn ssim(quad: u32, row: u32, mx: vec4<f32>, my: vec4<f32>, squares: vec4<f32>, xy: vec4<f32>) -> vec4<f32> {
    let a = 2.0 * mx * my + 0.0001;
    let b = 2.0 * (xy - mx * my) + 0.0009;
    let of_means = mx * mx + my * my;
    let c = of_means + 0.0001;
    let d = squares - of_means + 0.0009;
    let weight = inside_image(quad, row);
    let inverse = 1.0 / (c * d);
    let value = a * b * inverse;
    let size = plane.rows * plane.quads;
    let place = 3u * plane_index * size + row * plane.quads + quad;
    // The sigma terms also depend on the mean: b contains -2 mx my and d contains -mx^2.
    partials[place] = weight * (2.0 * my * (b - a) * inverse - 2.0 * mx * value * (d - c) * inverse);
    partials[size + place] = -weight * value / d;
    partials[2u * size + place] = weight * 2.0 * a * inverse;
    return weight * value;
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
    let mx = blurred(0u, quad, i32(first));
    let my = blurred(1u, quad, i32(first));
    let squares = blurred(2u, quad, i32(first));
    let xy = blurred(3u, quad, i32(first));
    var total = vec4<f32>(0.0);
#each K 8
    total += ssim(quad, first + $Ku, mx[$K], my[$K], squares[$K], xy[$K]);
#end
    sums[plane.channel * runs * plane.quads + id] = total;
}
