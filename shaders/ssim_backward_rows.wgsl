// Blurs the three partial derivatives of SSIM along rows (the window is its own transpose).
#import window
#import flat

@group(0) @binding(0) var<uniform> plane: Plane;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> rows: array<f32>;

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
    var window = WINDOW;
    for (var map = 0u; map < 3u; map++) {
        let base = map * size + row * plane.width;
        var input: array<f32, REACH>;
        for (var k = 0; k < 18; k++) {
            let i = first + k - 5;
            input[k] = 0.0;
            if i >= 0 && i < i32(plane.width) {
                input[k] = partials[base + u32(i)];
            }
        }
        for (var o = 0u; o < RUN; o++) {
            var sum = 0.0;
            for (var k = 0u; k < 11u; k++) {
                sum += window[k] * input[o + k];
            }
            if u32(first) + o < plane.width {
                rows[base + u32(first) + o] = sum;
            }
        }
    }
}
