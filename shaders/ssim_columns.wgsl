// Blurs x, y, x^2, y^2 and x y along columns, into every second row: the first half of SSIM's window.
//
// frame   [..][padded rows][quads]     rendered x
// targets [2][padded rows][quads]      8-bit y of colour and feature; where a pixel does not count, y := x
// moments [5][padded rows / 2][quads]
#import window
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> targets: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4<f32>>;

struct Pair {
    x: vec4<f32>,
    y: vec4<f32>,
}

// Loading in any case and choosing afterwards avoids branches.
fn load(quad: u32, j: i32) -> Pair {
    let row = u32(clamp(j, 0, i32(plane.rows) - 1));
    let place = row * plane.quads + quad;
    let x = exposed(frame[plane.channel * plane.rows * plane.quads + place], quad, row);
    let y = wanted(targets[(plane.channel / 3u) * plane.rows * plane.quads + place], plane.channel);
    let in_picture = j >= 0 && j < i32(plane.rows);
    return Pair(select(vec4<f32>(0.0), x, in_picture), select(vec4<f32>(0.0), select(x, y.value, y.counts), in_picture));
}

// Writes every second row of a map from 17 rows.
fn store(map: u32, quad: u32, first: u32, a: array<vec4<f32>, 17>) {
    let place = (map * (plane.rows / 2u) + first / 2u) * plane.quads + quad;
#each K 4
    moments[place + $Ku * plane.quads] = window(
        a[2u * $Ku + 5u],
        a[2u * $Ku + 4u] + a[2u * $Ku + 6u],
        a[2u * $Ku + 3u] + a[2u * $Ku + 7u],
        a[2u * $Ku + 2u] + a[2u * $Ku + 8u],
        a[2u * $Ku + 1u] + a[2u * $Ku + 9u],
        a[2u * $Ku] + a[2u * $Ku + 10u],
    );
#end
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = flat_group(group, groups) * 64u + lane;
    let runs = plane.rows / 8u;
    if id >= runs * plane.quads {
        return;
    }
    let quad = id % plane.quads;
    let first = 8u * (id / plane.quads);
#each K 17
    let p$K = load(quad, i32(first + plane.phase) + $K - 5);
#end
    store(0u, quad, first, array<vec4<f32>, 17>(
#each K 17
        p$K.x,
#end
    ));
    store(1u, quad, first, array<vec4<f32>, 17>(
#each K 17
        p$K.y,
#end
    ));
    store(2u, quad, first, array<vec4<f32>, 17>(
#each K 17
        p$K.x * p$K.x,
#end
    ));
    store(3u, quad, first, array<vec4<f32>, 17>(
#each K 17
        p$K.y * p$K.y,
#end
    ));
    store(4u, quad, first, array<vec4<f32>, 17>(
#each K 17
        p$K.x * p$K.y,
#end
    ));
}
