// Finishes the blur along columns and differentiates SSIM (Wang et al. 2004) by the three local moments of x.
//
// rows     [5][h][w]  from ssim_rows
// partials [3][h][w]  d SSIM / d (mean x, mean x^2, mean x y)
// sums     [6][h runs][w]  sum of SSIM over each run, for the loss
#import columns
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read_write> partials: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let runs = (plane.height + RUN - 1u) / RUN;
    let id = flat_group(group, groups) * 64u + lane;
    if id >= runs * plane.width {
        return;
    }
    let column = id % plane.width;
    let first = i32((id / plane.width) * RUN);
    let size = plane.width * plane.height;
    var mx = blurred(0u, column, first);
    var my = blurred(1u, column, first);
    var xx = blurred(2u, column, first);
    var yy = blurred(3u, column, first);
    var xy = blurred(4u, column, first);
    var total = 0.0;
    for (var o = 0u; o < RUN; o++) {
        let j = u32(first) + o;
        if j < plane.height {
            let a = 2.0 * mx[o] * my[o] + 0.0001;
            let b = 2.0 * (xy[o] - mx[o] * my[o]) + 0.0009;
            let c = mx[o] * mx[o] + my[o] * my[o] + 0.0001;
            let d = (xx[o] - mx[o] * mx[o]) + (yy[o] - my[o] * my[o]) + 0.0009;
            let ssim = a * b / (c * d);
            total += ssim;
            let at = j * plane.width + column;
            // sigma terms depend on the mean too: b and d lose 2 mx my and mx^2.
            partials[at] = (2.0 * my[o] * (b - a)) / (c * d) - 2.0 * mx[o] * ssim * (1.0 / c - 1.0 / d);
            partials[size + at] = -ssim / d;
            partials[2u * size + at] = 2.0 * a / (c * d);
        }
    }
    sums[plane.channel * runs * plane.width + id] = total;
}
