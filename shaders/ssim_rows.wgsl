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

// Values outside the picture are 0; loading in any case and choosing afterwards avoids branches.
fn rendered(base: u32, i: i32) -> f32 {
    let value = frame[base + u32(clamp(i, 0, i32(plane.width) - 1))];
    return select(0.0, value, i >= 0 && i < i32(plane.width));
}

fn wanted(base: u32, i: i32, x: f32) -> f32 {
    let value = target_image[base + u32(clamp(i, 0, i32(plane.width) - 1))];
    return select(0.0, select(value, x, value < 0.0), i >= 0 && i < i32(plane.width));
}

fn store(map: u32, row: u32, first: i32, values: array<f32, 8>) {
    var v = values;
    let base = (map * plane.height + row) * plane.width + u32(first);
    for (var o = 0u; o < RUN; o++) {
        if u32(first) + o < plane.width {
            rows[base + o] = v[o];
        }
    }
}

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
    let base = plane.channel * size + row * plane.width;
    let x = array<f32, 18>(
        rendered(base, first - 5), rendered(base, first - 4), rendered(base, first - 3), rendered(base, first - 2), rendered(base, first - 1), rendered(base, first + 0),
        rendered(base, first + 1), rendered(base, first + 2), rendered(base, first + 3), rendered(base, first + 4), rendered(base, first + 5), rendered(base, first + 6),
        rendered(base, first + 7), rendered(base, first + 8), rendered(base, first + 9), rendered(base, first + 10), rendered(base, first + 11), rendered(base, first + 12),
    );
    let y = array<f32, 18>(
        wanted(base, first - 5, x[0]), wanted(base, first - 4, x[1]), wanted(base, first - 3, x[2]),
        wanted(base, first - 2, x[3]), wanted(base, first - 1, x[4]), wanted(base, first + 0, x[5]),
        wanted(base, first + 1, x[6]), wanted(base, first + 2, x[7]), wanted(base, first + 3, x[8]),
        wanted(base, first + 4, x[9]), wanted(base, first + 5, x[10]), wanted(base, first + 6, x[11]),
        wanted(base, first + 7, x[12]), wanted(base, first + 8, x[13]), wanted(base, first + 9, x[14]),
        wanted(base, first + 10, x[15]), wanted(base, first + 11, x[16]), wanted(base, first + 12, x[17]),
    );
    store(0u, row, first, blur(x));
    store(1u, row, first, blur(y));
    store(2u, row, first, blur(times(x, x)));
    store(3u, row, first, blur(times(y, y)));
    store(4u, row, first, blur(times(x, y)));
}
