// Gradient of (1 - lambda) L1 + lambda (1 - SSIM) (paper, optimisation), and the run sums of L1.
//
// rows     [3][h][w]       from ssim_backward_rows
// gradient [6][h][w]       dL/d frame
// sums     [6][h runs][w]  sum of |x - y| over each run
#import columns
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> target_image: array<f32>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;

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
    var by_mean = blurred(0u, column, first);
    var by_square = blurred(1u, column, first);
    var by_product = blurred(2u, column, first);
    var total = 0.0;
    for (var o = 0u; o < RUN; o++) {
        let j = u32(first) + o;
        if j < plane.height {
            let at = plane.channel * size + j * plane.width + column;
            let x = frame[at];
            let t = target_image[at];
            let counts = t >= 0.0;
            let y = select(x, t, counts);
            total += abs(x - y);
            let d_ssim = by_mean[o] + 2.0 * x * by_square[o] + y * by_product[o];
            let value = plane.scale * ((1.0 - plane.lambda) * sign(x - y) - plane.lambda * d_ssim);
            gradient[at] = select(0.0, value, counts);
        }
    }
    sums[plane.channel * runs * plane.width + id] = total;
}
