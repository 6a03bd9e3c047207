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
    gaussians: u32,
    pairs: u32,
    // 1: the first feature channel carries the depth (for depth images).
    depth_as_feature: u32,
    // 1: the feature loss also moves geometry.
    feature_moves_geometry: u32,
}

// Tile edge in pixels; an invocation owns 4x2 pixels, so 8 invocations a tile.
const TILE: u32 = 8u;
// A Gaussian is not drawn where it would add less than one grey level.
const ALPHA_MIN: f32 = 0.00392156862745098;
const ALPHA_MAX: f32 = 0.99;
// A pixel is finished once less than this passes through.
const TRANSMITTANCE_MIN: f32 = 0.0001;
// Variance (px^2) added to each projected Gaussian so that none falls between pixels (3DGS).
const DILATION: f32 = 0.3;
const NEAR: f32 = 0.05;
