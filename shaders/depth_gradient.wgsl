// Computes the gradient of the depth loss with respect to the blended depth moments
// m1 = sum w ln z, m2 = sum w (ln z)^2 and m0 = sum w: docs/how-it-works.md, 5.7.
//
// frame    [8][padded rows][quads]  channels 3 to 5 hold m1, m2 and m0
// targets  [3][padded rows][quads]  plane 2 holds the bits of the depth: 0 is unknown, and
//                                   pixels with a negative one are ignored
// gradient [6][padded rows][quads]  channels 3 to 5 receive dL/d m1, dL/d m2 and dL/d m0
#import flat

struct DepthLoss {
    // Image size in pixels.
    size: vec2<u32>,
    // Quads in a padded row, and padded rows.
    quads: u32,
    rows: u32,
    // Weight of one pixel.
    scale: f32,
    unused0: u32,
    unused1: u32,
    unused2: u32,
}

@group(0) @binding(0) var<uniform> loss: DepthLoss;
@group(0) @binding(1) var<storage, read> frame: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> targets: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> gradient: array<vec4<f32>>;

// Spread of ln z below which the loss is quadratic.
const SOFTNESS: f32 = 0.01;
// Weight of pixels with an unknown depth, relative to the others.
const GATHERING: f32 = 0.25;
// Opacity below which a pixel has no depth.
const MIN_OPACITY: f32 = 0.001;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let place = flat_group(group, groups) * 64u + lane;
    let plane = loss.rows * loss.quads;
    if place >= plane {
        return;
    }
    let row = place / loss.quads;
    let columns = vec4<u32>(4u * (place % loss.quads)) + vec4<u32>(0u, 1u, 2u, 3u);
    let m1 = frame[3u * plane + place];
    let m2 = frame[4u * plane + place];
    let m0 = frame[5u * plane + place];
    let depth = bitcast<vec4<f32>>(targets[2u * plane + place]);
    let known = depth > vec4<f32>(0.0);
    let mean = m1 / max(m0, vec4<f32>(MIN_OPACITY));
    let u = select(mean, log(select(vec4<f32>(1.0), depth, known)), known);
    let squares = max(m2 - 2.0 * u * m1 + u * u * m0, vec4<f32>(0.0));
    let inside = columns < vec4<u32>(loss.size.x) & vec4<bool>(row < loss.size.y);
    let counts = inside & m0 >= vec4<f32>(MIN_OPACITY) & depth >= vec4<f32>(0.0);
    let scale = loss.scale * select(vec4<f32>(GATHERING), vec4<f32>(1.0), known);
    let weight = select(vec4<f32>(0.0), scale, counts);
    let by_m2 = 0.5 * weight / sqrt(squares + SOFTNESS * SOFTNESS);
    gradient[3u * plane + place] = -2.0 * u * by_m2;
    gradient[4u * plane + place] = by_m2;
    gradient[5u * plane + place] = u * u * by_m2;
}
