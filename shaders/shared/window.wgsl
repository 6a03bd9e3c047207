// The 11-tap Gaussian window (sigma 1.5) of SSIM, and the uniform of the loss passes. They process
// several channels at once, one for each z of the workgroups, in quads of four neighbouring pixels.
// Images are padded to whole tiles; the padding is zero.
struct Planes {
    each: array<Plane, 6>,
    count: u32,
    unused0: u32,
    unused1: u32,
    unused2: u32,
}

struct Plane {
    // Image size in pixels.
    size: vec2<u32>,
    // Quads in a padded row, and padded rows.
    quads: u32,
    rows: u32,
    // Channel of the frame.
    channel: u32,
    // Weight of this channel's loss divided by 3 x the number of pixels.
    scale: f32,
    // The paper's lambda: weight of D-SSIM against L1.
    lambda: f32,
    // Exposure of the view: the target is compared with gain * rendered + offset.
    gain: f32,
    offset: f32,
    unused0: u32,
    unused1: u32,
    unused2: u32,
}

// The invocation's plane, and its index among the planes processed at once. Each of them has its
// own maps.
var<private> plane: Plane;
var<private> plane_index: u32;

fn take_plane(group: vec3<u32>) {
    plane_index = group.z;
    plane = planes.each[plane_index];
}

// Returns the blurred value from the middle input a0 and from a1 to a5, where ak is the sum of the
// two inputs at distance k.
fn window(a0: vec4<f32>, a1: vec4<f32>, a2: vec4<f32>, a3: vec4<f32>, a4: vec4<f32>, a5: vec4<f32>) -> vec4<f32> {
    return 0.2660117249 * a0 + 0.2130055377 * a1 + 0.1093606895 * a2 + 0.0360007721 * a3 + 0.0075987581 * a4 + 0.0010283801 * a5;
}

// Returns 1 for pixels of a quad that lie in the image, else 0.
fn inside_image(quad: u32, row: u32) -> vec4<f32> {
    let in_row = vec4<u32>(4u * quad) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(plane.size.x);
    return select(vec4<f32>(0.0), vec4<f32>(1.0), in_row & vec4<bool>(row < plane.size.y));
}

struct Wanted {
    value: vec4<f32>,
    counts: vec4<bool>,
}

// Unpacks a quad of an 8-bit target: three channels, then 255 for pixels that enter the loss.
fn unpack_target(packed: vec4<u32>, channel: u32) -> Wanted {
    let value = vec4<f32>((packed >> vec4<u32>(8u * (channel % 3u))) & vec4<u32>(255u)) / 255.0;
    return Wanted(value, packed >= vec4<u32>(0x80000000u));
}

// Returns a rendered quad with exposure applied, and 0 outside the image.
fn exposed(rendered: vec4<f32>, quad: u32, row: u32) -> vec4<f32> {
    return inside_image(quad, row) * (plane.gain * rendered + plane.offset);
}
