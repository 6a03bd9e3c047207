// Blurs the three partial derivatives of SSIM along rows (the window is its own transpose).
#import window
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> rows: array<f32>;

fn partial(base: u32, i: i32) -> f32 {
    let value = partials[base + u32(clamp(i, 0, i32(plane.width) - 1))];
    return select(0.0, value, i >= 0 && i < i32(plane.width));
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
    for (var map = 0u; map < 3u; map++) {
        let base = map * size + row * plane.width;
        var out = blur(array<f32, 18>(
            partial(base, first - 5), partial(base, first - 4), partial(base, first - 3), partial(base, first - 2), partial(base, first - 1), partial(base, first + 0),
            partial(base, first + 1), partial(base, first + 2), partial(base, first + 3), partial(base, first + 4), partial(base, first + 5), partial(base, first + 6),
            partial(base, first + 7), partial(base, first + 8), partial(base, first + 9), partial(base, first + 10), partial(base, first + 11), partial(base, first + 12),
        ));
        for (var o = 0u; o < RUN; o++) {
            if u32(first) + o < plane.width {
                rows[base + u32(first) + o] = out[o];
            }
        }
    }
}
