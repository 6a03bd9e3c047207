// One camera and the sizes of one frame. Mirrored by `View` in crates/fastlgs-raster/src/view.rs.
struct View {
    world_to_camera: mat4x4<f32>,
    focal: vec2<f32>,
    centre: vec2<f32>,
    // Image size in pixels, then in tiles.
    size: vec2<u32>,
    tiles: vec2<u32>,
    // Colour (3) and feature (3) behind everything; w unused.
    background_color: vec4<f32>,
    background_feature: vec4<f32>,
    // Position in the world; w unused.
    camera: vec4<f32>,
    gaussians: u32,
    pairs: u32,
    // The page of Gaussians that is bound: its first one and their number (shared/channels.wgsl).
    first: u32,
    page: u32,
    // The window of gradient slots that is bound: its first pair and the number of pairs whose Gaussians start in it.
    slot_first: u32,
    slot_count: u32,
    sh_degree: u32,
    // 1: opacity is lowered by what the dilation of small Gaussians adds (2-D Mip filter).
    antialias: u32,
    // 1: the first feature channel carries the depth (for depth images).
    depth_as_feature: u32,
    // A tile is finished once less than this passes through each of its pixels.
    finished: f32,
    // A step leaves out each Gaussian with the probability dropped / 2^32, by a draw of its own for each `draw`.
    dropped: u32,
    draw: u32,
    // Pairs of a run, within which fold_slots adds up a Gaussian's slots; 1 where it does not run.
    fold: u32,
    // 1: Gaussians that are clear are drawn as solid ones, to see what objects are where.
    solid: u32,
    unused0: u32,
    unused1: u32,
}

// Tile edge in pixels. Pictures on the device are padded to whole tiles; what is outside the picture is zero.
const TILE: u32 = 8u;
// A Gaussian is not drawn where it would add less than one grey level.
const ALPHA_MIN: f32 = 0.00392156862745098;
const ALPHA_MAX: f32 = 0.99;
// A Gaussian is clear from this logit of opacity down: it shows nothing, but stands for a thing that photos see through.
const CLEAR: f32 = -16.0;
// Its opacity where it is drawn as a solid one.
const SOLID: f32 = 0.9;
// Variance (px^2) added to each projected Gaussian so that none falls between pixels (3DGS).
const DILATION: f32 = 0.3;
// A Gaussian is drawn from a depth on of so many times its own size, the length of its three scales: nearer, it would fill the picture, and its
// projection would no longer be one. In units of the scene any bound would be right for some scenes only.
const NEAR: f32 = 0.5;

// Factor on the opacities of those that are not left out, which makes up for the others as far as ALPHA_MAX allows.
fn kept_gain(view: View) -> f32 {
    return 1.0 / (1.0 - f32(view.dropped) / 4294967296.0);
}

// Place of four neighbouring pixels of a row in the planes of a padded picture.
fn quad_at(channel: u32, x: u32, y: u32, view: View) -> u32 {
    return (channel * view.tiles.y * TILE + y) * (view.tiles.x * 2u) + x / 4u;
}
