// Blurs the three partial derivatives of SSIM along rows (the window is its own transpose).
#import rows
#import flat

@group(0) @binding(0) var<uniform> planes: Planes;
@group(0) @binding(1) var<storage, read> partials: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> rows: array<vec4<f32>>;

fn load(base: u32, quad: i32) -> vec4<f32> {
    let value = partials[base + u32(clamp(quad, 0, i32(plane.quads) - 1))];
    return select(vec4<f32>(0.0), value, quad >= 0 && quad < i32(plane.quads));
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
    for (var map = 0u; map < 3u; map++) {
        let base = ((3u * plane_index + map) * plane.rows + row) * plane.quads;
        let out = blurred_row(array<vec4<f32>, 6>(
#each K 6
            load(base, i32(quad) + $K - 2),
#end
        ));
        let place = ((4u * plane_index + map) * plane.rows + row) * plane.quads + quad;
        rows[place] = out[0];
        rows[place + 1u] = out[1];
    }
}
