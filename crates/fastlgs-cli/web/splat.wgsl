// Draws one Gaussian as a quad, for browsers: WebGPU takes this file as it is, WebGL2 its translation (build.rs).
// The picture is that of shaders/project.wgsl and shaders/blend.wgsl but for the eight bits of a canvas.
//
// splats   [n][2 + ceil(rest / 4)] texels of four u32, row by row (src/serve/splats.rs):
//          (mean.xyz, log-scales xy) (log-scale z and opacity, colour, rotation, rotation and object id) (SH coefficients ...)
// objects  [512][256] texels: rows 0..256 the state of object id = 256 row + column: relevancy, selected, hidden;
//          rows 256.. its colour

struct Frame {
    world_to_camera: mat4x4<f32>,
    // Position of the camera in the world; w: 1 where opacity pays for dilation (2-D Mip filter).
    camera: vec4<f32>,
    // Focal lengths and principal point in pixels.
    lens: vec4<f32>,
    // Pixels along x and y; largest coefficient of colour, and of the SH coefficients above degree 0.
    size: vec4<f32>,
    // What is drawn; SH degree; 1 where what is not selected is dimmed; texels of a Gaussian.
    mode: vec4<u32>,
}

const COLOR: u32 = 0u;
const RELEVANCY: u32 = 1u;
const OBJECTS: u32 = 2u;
const IDS: u32 = 3u;

const ROW: u32 = 2048u;
const NEAR: f32 = 0.05;
const DILATION: f32 = 0.3;
const ALPHA_MIN: f32 = 0.00392156862745098;
const ALPHA_MAX: f32 = 0.99;
const SH_C0: f32 = 0.28209479;
const LOG_SCALE_LOW: f32 = -20.0;
const LOG_SCALE_RANGE: f32 = 30.0;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var splats: texture_2d<u32>;
@group(0) @binding(2) var objects: texture_2d<f32>;

fn texel(number: u32) -> vec4<u32> {
    return textureLoad(splats, vec2<i32>(i32(number % ROW), i32(number / ROW)), 0);
}

fn unit10(bits: u32) -> vec3<f32> {
    return vec3<f32>(vec3<u32>(bits, bits >> 10u, bits >> 20u) & vec3<u32>(1023u)) / 511.5 - 1.0;
}

// The three smallest components in 16, 16 and 14 bits, and in two bits which one is the largest; (w, x, y, z).
fn unpack_rotation(low: u32, high: u32) -> vec4<f32> {
    let whole = vec3<f32>(f32(low & 0xffffu) / 65535.0, f32(low >> 16u) / 65535.0, f32(high & 0x3fffu) / 16383.0);
    let v = (whole * 2.0 - 1.0) * 0.70710678;
    let largest = sqrt(max(1.0 - dot(v, v), 0.0));
    switch (high >> 14u) & 3u {
        case 0u: { return vec4<f32>(largest, v); }
        case 1u: { return vec4<f32>(v.x, largest, v.yz); }
        case 2u: { return vec4<f32>(v.xy, largest, v.z); }
        default: { return vec4<f32>(v, largest); }
    }
}

fn rotation_matrix(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

// Real spherical harmonics above degree 0, with the signs of 3DGS.
fn harmonic(k: u32, d: vec3<f32>) -> f32 {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    switch k {
        case 0u: { return -0.48860251 * d.y; }
        case 1u: { return 0.48860251 * d.z; }
        case 2u: { return -0.48860251 * d.x; }
        case 3u: { return 1.0925484 * d.x * d.y; }
        case 4u: { return -1.0925484 * d.y * d.z; }
        case 5u: { return 0.31539157 * (2.0 * zz - xx - yy); }
        case 6u: { return -1.0925484 * d.x * d.z; }
        case 7u: { return 0.54627422 * (xx - yy); }
        case 8u: { return -0.59004359 * d.y * (3.0 * xx - yy); }
        case 9u: { return 2.8906114 * d.x * d.y * d.z; }
        case 10u: { return -0.45704579 * d.y * (4.0 * zz - xx - yy); }
        case 11u: { return 0.37317633 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy); }
        case 12u: { return -0.45704579 * d.x * (4.0 * zz - xx - yy); }
        case 13u: { return 1.4453057 * d.z * (xx - yy); }
        default: { return -0.59004359 * d.x * (xx - 3.0 * yy); }
    }
}

fn color_of(first: u32, packed: u32, direction: vec3<f32>) -> vec3<f32> {
    var color = vec3<f32>(0.5) + SH_C0 * frame.size.z * unit10(packed);
    let rest = (frame.mode.y + 1u) * (frame.mode.y + 1u) - 1u;
    for (var k = 0u; k < rest; k++) {
        color += harmonic(k, direction) * frame.size.w * unit10(texel(first + 2u + k / 4u)[k % 4u]);
    }
    return max(color, vec3<f32>(0.0));
}

// The turbo colour map (Mikhailov 2019) by its author's polynomial, as fastlgs_core::turbo has it.
fn turbo(x: f32) -> vec3<f32> {
    let low = vec4<f32>(1.0, x, x * x, x * x * x);
    let high = vec2<f32>(x * x * x * x, x * x * x * x * x);
    return clamp(vec3<f32>(
        dot(low, vec4<f32>(0.13572138, 4.61539260, -42.66032258, 132.13108234)) + dot(high, vec2<f32>(-152.94239396, 59.28637943)),
        dot(low, vec4<f32>(0.09140261, 2.19418839, 4.84296658, -14.18503333)) + dot(high, vec2<f32>(4.27729857, 2.82956604)),
        dot(low, vec4<f32>(0.10667330, 12.64194608, -60.58204836, 110.36276771)) + dot(high, vec2<f32>(-89.90310912, 27.34824973)),
    ), vec3<f32>(0.0), vec3<f32>(1.0));
}

// What a Gaussian of an object looks like in the current mode.
fn shown(color: vec3<f32>, id: u32) -> vec3<f32> {
    let at = vec2<i32>(i32(id & 255u), i32(id >> 8u));
    let state = textureLoad(objects, at, 0);
    switch frame.mode.x {
        case IDS: { return vec3<f32>(f32(id & 255u), f32(id >> 8u), 0.0) / 255.0; }
        case OBJECTS: { return textureLoad(objects, at + vec2<i32>(0, 256), 0).rgb; }
        case RELEVANCY: { return 0.75 * turbo(state.r) + 0.25 * color; }
        default: {}
    }
    if frame.mode.z == 0u {
        return color;
    }
    return select(color / 3.0, color / 2.0 + vec3<f32>(0.5, 0.157, 0.0), state.g > 0.5);
}

struct Corner {
    @builtin(position) position: vec4<f32>,
    // Place in the ellipse, in standard deviations.
    @location(0) place: vec2<f32>,
    @location(1) @interpolate(flat) color: vec4<f32>,
}

@vertex
fn corner(@builtin(vertex_index) number: u32, @location(0) gaussian: u32) -> Corner {
    var out = Corner(vec4<f32>(2.0, 2.0, 0.0, 1.0), vec2<f32>(0.0), vec4<f32>(0.0));
    let first = gaussian * frame.mode.w;
    let a = texel(first);
    let b = texel(first + 1u);
    let mean = bitcast<vec3<f32>>(a.xyz);
    let id = b.w >> 16u;
    let hidden = textureLoad(objects, vec2<i32>(i32(id & 255u), i32(id >> 8u)), 0).b > 0.5;
    let t = (frame.world_to_camera * vec4<f32>(mean, 1.0)).xyz;
    if hidden || !(t.z > NEAR) {
        return out;
    }
    let lens = frame.lens;
    let size = frame.size.xy;
    let last = unpack2x16unorm(b.x);
    let s = exp(vec3<f32>(unpack2x16unorm(a.w), last.x) * LOG_SCALE_RANGE + LOG_SCALE_LOW);
    let r = rotation_matrix(unpack_rotation(b.z, b.w & 0xffffu));
    let slope = clamp(t.xy / t.z, -1.3 * lens.zw / lens.xy, 1.3 * (size - lens.zw) / lens.xy);
    let rows = transpose(mat3x3<f32>(frame.world_to_camera[0].xyz, frame.world_to_camera[1].xyz, frame.world_to_camera[2].xyz));
    let ax = ((lens.x / t.z * (rows[0] - slope.x * rows[2])) * r) * s;
    let ay = ((lens.y / t.z * (rows[1] - slope.y * rows[2])) * r) * s;
    let xx = dot(ax, ax) + DILATION;
    let xy = dot(ax, ay);
    let yy = dot(ay, ay) + DILATION;
    let det = xx * yy - xy * xy;
    var opacity = last.y;
    if frame.camera.w > 0.5 {
        opacity *= sqrt(max(((xx - DILATION) * (yy - DILATION) - xy * xy) / det, 1e-6));
    }
    if !(opacity >= ALPHA_MIN) {
        return out;
    }
    // Half axes of the ellipse on which alpha falls to ALPHA_MIN.
    let middle = 0.5 * (xx + yy);
    let spread = length(vec2<f32>(0.5 * (xx - yy), xy));
    var axis = vec2<f32>(1.0, 0.0);
    if abs(xy) > 1e-6 {
        axis = normalize(vec2<f32>(xy, middle + spread - xx));
    } else if yy > xx {
        axis = vec2<f32>(0.0, 1.0);
    }
    let reach = sqrt(2.0 * log(opacity / ALPHA_MIN));
    out.place = reach * (vec2<f32>(f32(number & 1u), f32(number >> 1u)) * 2.0 - 1.0);
    let long = sqrt(middle + spread) * out.place.x * axis;
    let short = sqrt(max(middle - spread, 0.01)) * out.place.y * vec2<f32>(-axis.y, axis.x);
    let pixel = lens.xy * t.xy / t.z + lens.zw + long + short;
    out.position = vec4<f32>(pixel / size * vec2<f32>(2.0, -2.0) + vec2<f32>(-1.0, 1.0), 0.0, 1.0);
    let color = color_of(first, b.y, normalize(mean - frame.camera.xyz));
    out.color = vec4<f32>(shown(color, id), min(opacity, ALPHA_MAX));
    return out;
}

@fragment
fn pixel(in: Corner) -> @location(0) vec4<f32> {
    let alpha = in.color.a * exp(-0.5 * dot(in.place, in.place));
    if frame.mode.x == IDS {
        // No blending: what was drawn last and is solid enough is what one points at.
        if alpha < 0.5 {
            discard;
        }
        return vec4<f32>(in.color.rgb, 1.0);
    }
    if alpha < ALPHA_MIN {
        discard;
    }
    return vec4<f32>(in.color.rgb * alpha, alpha);
}
