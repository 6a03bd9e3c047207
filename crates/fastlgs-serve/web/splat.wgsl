// Draws one Gaussian as a quad, for browsers. WebGPU runs this shader with its imports, WebGL2 a
// translation of it (build.rs). Geometry and colour are those of shaders/project.wgsl and
// shaders/blend.wgsl.
//
// splats   [n][2 + ceil(rest / 4)] texels of four u32 in row-major order (src/splats.rs):
//          (mean xyz, log-scales xy)
//          (log-scale z and opacity, colour, rotation, rotation and object id)
//          (SH coefficients ...)
// objects  [512][256] texels; a Gaussian id is 256 * row + column, and identifies an object
//          or a list of overlapping objects:
//          rows 0..256  state of the id: relevancy, selected, hidden
//          rows 256..   colour of the id
#import view
#import rotation
#import covariance
#import harmonics

struct Frame {
    world_to_camera: mat4x4<f32>,
    // Camera position in scene coordinates; w is 1 if opacity compensates dilation (2-D Mip
    // filter).
    camera: vec4<f32>,
    // Focal lengths and principal point in pixels.
    lens: vec4<f32>,
    // Width and height in pixels; largest coefficient of SH degree 0, and of higher degrees.
    size: vec4<f32>,
    // Mode (COLOR to IDS); SH degree; 1 to dim Gaussians that are not selected; texels per
    // Gaussian.
    mode: vec4<u32>,
}

const COLOR: u32 = 0u;
const RELEVANCY: u32 = 1u;
const OBJECTS: u32 = 2u;
const IDS: u32 = 3u;

const ROW: u32 = 2048u;
const LOG_SCALE_LOW: f32 = -20.0;
const LOG_SCALE_RANGE: f32 = 30.0;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var splats: texture_2d<u32>;
@group(0) @binding(2) var objects: texture_2d<f32>;

fn texel(plane_index: u32) -> vec4<u32> {
    return textureLoad(splats, vec2<i32>(i32(plane_index % ROW), i32(plane_index / ROW)), 0);
}

fn unpack_ten_bits(bits: u32) -> vec3<f32> {
    return vec3<f32>(vec3<u32>(bits, bits >> 10u, bits >> 20u) & vec3<u32>(1023u)) / 511.5 - 1.0;
}

// Unpacks a quaternion (w, x, y, z): the three smallest components in 16, 16 and 14 bits, and the
// index of the largest in two bits.
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

fn color_of(first: u32, packed: u32, direction: vec3<f32>) -> vec3<f32> {
    var color = vec3<f32>(0.5) + SH_C0 * frame.size.z * unpack_ten_bits(packed);
    var b = basis(direction);
    for (var k = 0u; k < rest_of(frame.mode.y); k++) {
        color += b[k] * frame.size.w * unpack_ten_bits(texel(first + 2u + k / 4u)[k % 4u]);
    }
    return max(color, vec3<f32>(0.0));
}

// The turbo colour map (Mikhailov 2019) as its author's polynomial, same as fastlgs_core::turbo.
fn turbo(x: f32) -> vec3<f32> {
    let low = vec4<f32>(1.0, x, x * x, x * x * x);
    let high = vec2<f32>(x * x * x * x, x * x * x * x * x);
    return clamp(vec3<f32>(
        dot(low, vec4<f32>(0.13572138, 4.61539260, -42.66032258, 132.13108234)) + dot(high, vec2<f32>(-152.94239396, 59.28637943)),
        dot(low, vec4<f32>(0.09140261, 2.19418839, 4.84296658, -14.18503333)) + dot(high, vec2<f32>(4.27729857, 2.82956604)),
        dot(low, vec4<f32>(0.10667330, 12.64194608, -60.58204836, 110.36276771)) + dot(high, vec2<f32>(-89.90310912, 27.34824973)),
    ), vec3<f32>(0.0), vec3<f32>(1.0));
}

// Returns the colour of a Gaussian with this id in the current mode.
fn inside_image(color: vec3<f32>, id: u32) -> vec3<f32> {
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
    // Position in the ellipse, in standard deviations.
    @location(0) place: vec2<f32>,
    @location(1) @interpolate(flat) color: vec4<f32>,
}

@vertex
fn corner(@builtin(vertex_index) plane_index: u32, @location(0) gaussian: u32) -> Corner {
    var out = Corner(vec4<f32>(2.0, 2.0, 0.0, 1.0), vec2<f32>(0.0), vec4<f32>(0.0));
    let first = gaussian * frame.mode.w;
    let a = texel(first);
    let b = texel(first + 1u);
    let mean = bitcast<vec3<f32>>(a.xyz);
    let id = b.w >> 16u;
    let hidden = textureLoad(objects, vec2<i32>(i32(id & 255u), i32(id >> 8u)), 0).b > 0.5;
    let t = (frame.world_to_camera * vec4<f32>(mean, 1.0)).xyz;
    let last = unpack2x16unorm(b.x);
    let s = exp(vec3<f32>(unpack2x16unorm(a.w), last.x) * LOG_SCALE_RANGE + LOG_SCALE_LOW);
    if hidden || !(t.z > NEAR * length(s)) {
        return out;
    }
    var view: View;
    view.world_to_camera = frame.world_to_camera;
    view.focal = frame.lens.xy;
    view.centre = frame.lens.zw;
    view.size = vec2<u32>(frame.size.xy);
    view.antialias = u32(frame.camera.w);
    let r = rotation_matrix(unpack_rotation(b.z, b.w & 0xffffu));
    let jw = affine(t, view);
    let ax = (jw.x * r) * s;
    let ay = (jw.y * r) * s;
    let cov = dilated(ax, ay);
    let opacity = last.y * compensation(determinants(ax, ay), view);
    if !(opacity >= ALPHA_MIN) {
        return out;
    }
    // Semi-axes of the ellipse on which alpha equals ALPHA_MIN.
    let mean_variance = 0.5 * (cov.x + cov.z);
    let spread = length(vec2<f32>(0.5 * (cov.x - cov.z), cov.y));
    var axis = vec2<f32>(1.0, 0.0);
    if abs(cov.y) > 1e-6 {
        axis = normalize(vec2<f32>(cov.y, mean_variance + spread - cov.x));
    } else if cov.z > cov.x {
        axis = vec2<f32>(0.0, 1.0);
    }
    let radius = sqrt(2.0 * log(opacity / ALPHA_MIN));
    out.place = radius * (vec2<f32>(f32(plane_index & 1u), f32(plane_index >> 1u)) * 2.0 - 1.0);
    let long = sqrt(mean_variance + spread) * out.place.x * axis;
    let short = sqrt(max(mean_variance - spread, 0.01)) * out.place.y * vec2<f32>(-axis.y, axis.x);
    let pixel = view.focal * t.xy / t.z + view.centre + long + short;
    out.position = vec4<f32>(pixel / frame.size.xy * vec2<f32>(2.0, -2.0) + vec2<f32>(-1.0, 1.0), 0.0, 1.0);
    let color = color_of(first, b.y, normalize(mean - frame.camera.xyz));
    out.color = vec4<f32>(inside_image(color, id), min(opacity, ALPHA_MAX));
    return out;
}

@fragment
fn pixel(in: Corner) -> @location(0) vec4<f32> {
    let alpha = in.color.a * exp(-0.5 * dot(in.place, in.place));
    if frame.mode.x == IDS {
        // No blending: the id is that of the nearest Gaussian with an alpha of at least 0.5.
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
