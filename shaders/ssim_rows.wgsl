// Blurs x, y, x^2, y^2 and x y along rows: the first half of SSIM's window.
//
// frame  [..][h][w] rendered x; target [..][h][w] y, negative where the pixel does not count (then y := x)
// rows   [5][h][w]
#import window
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> target_image: array<f32>;
@group(0) @binding(3) var<storage, read_write> rows: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let runs = (plane.width + RUN - 1u) / RUN;
    let id = flat_group(group, groups) * 64u + lane;
    if id >= runs * plane.height {
        return;
    }
    let row = id / runs;
    let first = i32((id % runs) * RUN);
    let size = plane.width * plane.height;
    let base = row * plane.width;
    var x: array<f32, REACH>;
    var y: array<f32, REACH>;
    for (var k = 0; k < 18; k++) {
        let i = first + k - 5;
        x[k] = 0.0;
        y[k] = 0.0;
        if i >= 0 && i < i32(plane.width) {
            let at = plane.channel * size + base + u32(i);
            x[k] = frame[at];
            let t = target_image[at];
            y[k] = select(t, x[k], t < 0.0);
        }
    }
    var window = WINDOW;
    for (var o = 0u; o < RUN; o++) {
        let i = u32(first) + o;
        var mx = 0.0;
        var my = 0.0;
        var xx = 0.0;
        var yy = 0.0;
        var xy = 0.0;
        for (var k = 0u; k < 11u; k++) {
            let w = window[k];
            let a = x[o + k];
            let b = y[o + k];
            mx += w * a;
            my += w * b;
            xx += w * a * a;
            yy += w * b * b;
            xy += w * a * b;
        }
        if i < plane.width {
            rows[base + i] = mx;
            rows[size + base + i] = my;
            rows[2u * size + base + i] = xx;
            rows[3u * size + base + i] = yy;
            rows[4u * size + base + i] = xy;
        }
    }
}
