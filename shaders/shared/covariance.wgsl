// Geometry of one projected Gaussian (3DGS, section 4; EWA splatting).
#import rotation

// Returns the ray slopes x/z and y/z, clamped to the image extended by 0.3 x its half extent on
// each side. The affine approximation diverges beyond.
fn clamped_slope(t: vec3<f32>, view: View) -> vec2<f32> {
    let size = vec2<f32>(view.size);
    let margin = 0.15 * size;
    let low = -(view.centre + margin) / view.focal;
    let high = (size - view.centre + margin) / view.focal;
    return clamp(t.xy / t.z, low, high);
}

// The two rows of J W, the derivative of the pixel position by the world position.
struct Affine {
    x: vec3<f32>,
    y: vec3<f32>,
}

fn affine(t: vec3<f32>, view: View) -> Affine {
    let slope = clamped_slope(t, view);
    let rows = transpose(mat3x3<f32>(view.world_to_camera[0].xyz, view.world_to_camera[1].xyz, view.world_to_camera[2].xyz));
    return Affine(
        view.focal.x / t.z * (rows[0] - slope.x * rows[2]),
        view.focal.y / t.z * (rows[1] - slope.y * rows[2]),
    );
}

// Returns the dilated covariance (xx, xy, yy) in the image from the rows of A.
fn dilated(ax: vec3<f32>, ay: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(dot(ax, ax) + DILATION, dot(ax, ay), dot(ay, ay) + DILATION);
}

// Returns the determinants of the covariance before and after dilation. Lagrange's identity is used
// because xx yy - xy^2 cancels in f32 for long, thin Gaussians.
fn determinants(ax: vec3<f32>, ay: vec3<f32>) -> vec2<f32> {
    let across = cross(ax, ay);
    let before = dot(across, across);
    return vec2<f32>(before, before + DILATION * (dot(ax, ax) + dot(ay, ay)) + DILATION * DILATION);
}

// Returns the determinant before dilation divided by the one after it, at least 1e-6. Its square
// root is the share of brightness that remains (Mip-Splatting, 2-D filter).
fn determinant_share(determinants: vec2<f32>) -> f32 {
    return max(determinants.x / determinants.y, 1e-6);
}

// Returns the factor on opacity that keeps the brightness of a dilated Gaussian; 1 without
// antialiasing.
fn compensation(determinants: vec2<f32>, view: View) -> f32 {
    return select(1.0, sqrt(determinant_share(determinants)), view.antialias == 1u);
}
