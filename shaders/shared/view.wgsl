// Camera and sizes of one frame. Mirrored by `View` in crates/fastlgs-raster/src/view.rs.
struct View {
    world_to_camera: mat4x4<f32>,
    focal: vec2<f32>,
    centre: vec2<f32>,
    // Image size in pixels, then in tiles.
    size: vec2<u32>,
    tiles: vec2<u32>,
    // Background colour and background feature; w unused.
    background_color: vec4<f32>,
    background_feature: vec4<f32>,
    // Camera position in the world; w unused.
    camera: vec4<f32>,
    gaussians: u32,
    pairs: u32,
    // The bound page of Gaussians: its first Gaussian and their number (shared/channels.wgsl).
    first: u32,
    page: u32,
    // The bound window of gradient slots: its first pair and its length in pairs. A Gaussian
    // belongs to the window that contains its first pair.
    slot_first: u32,
    slot_count: u32,
    sh_degree: u32,
    // 1: opacity compensates for the dilation of small Gaussians (2-D Mip filter).
    antialias: u32,
    // 1: the first feature channel is the depth z (for depth images). 2: the features are ln z, its
    // square, and 1 (for the depth loss).
    depth_as_feature: u32,
    // A tile is finished once the transmittance of all its pixels is below this.
    finished: f32,
    // A step leaves out each Gaussian with the probability dropped / 2^32. `draw` is the random
    // seed.
    dropped: u32,
    draw: u32,
    // Length of the runs of pairs in which fold_slots adds up slots; 1 if it does not run.
    fold: u32,
    // 1: transparent Gaussians are drawn with the opacity SOLID, to show which objects are where.
    solid: u32,
    unused0: u32,
    unused1: u32,
}

// Value of depth_as_feature for the depth loss.
const DEPTH_MOMENTS: u32 = 2u;
// Tile edge in pixels. Images on the device are padded to whole tiles; the padding is zero.
const TILE: u32 = 8u;
// A Gaussian is not drawn where it would add less than one grey level (1 / 255).
const ALPHA_MIN: f32 = 0.00392156862745098;
const ALPHA_MAX: f32 = 0.99;
// Logit of opacity at or below which a Gaussian is transparent: it adds no colour, but belongs to
// an object that photos see through.
const CLEAR: f32 = -16.0;
// Opacity of a transparent Gaussian if `solid` is 1.
const SOLID: f32 = 0.9;
// Variance in px^2 added to each projected Gaussian, so that none falls between pixels (3DGS).
const DILATION: f32 = 0.3;
// Smallest depth of a drawn Gaussian, in units of its size (the length of its three scales). Nearer
// ones would fill the image, and their affine projection is invalid. An absolute bound would not
// suit scenes of all units.
const NEAR: f32 = 0.5;

// Returns the factor on the opacities of Gaussians that are kept. It compensates for the dropped
// ones, up to ALPHA_MAX.
fn kept_gain(view: View) -> f32 {
    return 1.0 / (1.0 - f32(view.dropped) / 4294967296.0);
}

// Returns the index of a quad (four neighbouring pixels of a row) in the planes of a padded image.
fn quad_at(channel: u32, x: u32, y: u32, view: View) -> u32 {
    return (channel * view.tiles.y * TILE + y) * (view.tiles.x * 2u) + x / 4u;
}
