// Blurs x, y, x^2 + y^2 and x y along rows: the first half of the SSIM window.
//
// frame   [..][padded rows][quads]  rendered x
// targets [2][padded rows][quads]   8-bit y of colour and feature; y = x for ignored pixels
// rows    [planes][4][padded rows][quads]
#import rows
#import flat

@group(0) @binding(0) var<uniform> planes: Planes;
@group(0) @binding(1) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> targets: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> rows: array<vec4<f32>>;

struct Pair {
    x: vec4<f32>,
    y: vec4<f32>,
}

// Loading always and selecting afterwards avoids branches.
fn load(quad: i32, row: u32) -> Pair {
    let q = u32(clamp(quad, 0, i32(plane.quads) - 1));
    let place = row * plane.quads + q;
    let x = exposed(frame[plane.channel * plane.rows * plane.quads + place], q, row);
    let y = unpack_target(targets[(plane.channel / 3u) * plane.rows * plane.quads + place], plane.channel);
    let in_picture = quad >= 0 && quad < i32(plane.quads);
    return Pair(select(vec4<f32>(0.0), x, in_picture), select(vec4<f32>(0.0), select(x, y.value, y.counts), in_picture));
}

fn squares(pair: Pair) -> vec4<f32> {
    return fma(pair.x, pair.x, pair.y * pair.y);
}

fn store(map: u32, quad: u32, row: u32, values: array<vec4<f32>, 2>) {
    let place = ((4u * plane_index + map) * plane.rows + row) * plane.quads + quad;
    rows[place] = values[0];
    rows[place + 1u] = values[1];
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    take_plane(group);
    let id = flat_group(group, groups) * 64u + lane;
    let runs = plane.quads / 2u;
    if id >= runs * plane.rows {
        return;
    }
    let row = id / runs;
    let quad = 2u * (id % runs);
#each K 6
    let p$K = load(i32(quad) + $K - 2, row);
#end
    store(0u, quad, row, blurred_row(array<vec4<f32>, 6>(p0.x, p1.x, p2.x, p3.x, p4.x, p5.x)));
    store(1u, quad, row, blurred_row(array<vec4<f32>, 6>(p0.y, p1.y, p2.y, p3.y, p4.y, p5.y)));
    store(2u, quad, row, blurred_row(array<vec4<f32>, 6>(squares(p0), squares(p1), squares(p2), squares(p3), squares(p4), squares(p5))));
    store(3u, quad, row, blurred_row(array<vec4<f32>, 6>(p0.x * p0.y, p1.x * p1.y, p2.x * p2.y, p3.x * p3.y, p4.x * p4.y, p5.x * p5.y)));
}
