// Geometry of one projected Gaussian (3DGS, section 4; EWA splatting).
#import rotation

// Ray slopes beyond what the image shows and 0.3 x its half extent beside it are clamped: the affine approximation explodes there.
fn clamped_slope(t: vec3<f32>, view: View) -> vec2<f32> {
    let size = vec2<f32>(view.size);
    let beside = 0.15 * size;
    let low = -(view.centre + beside) / view.focal;
    let high = (size - view.centre + beside) / view.focal;
    return clamp(t.xy / t.z, low, high);
}

// The two rows of J W: derivative of the pixel position by the world position.
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

// Covariance (xx, xy, yy) in the image from the rows of A, dilated.
fn dilated(ax: vec3<f32>, ay: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(dot(ax, ax) + DILATION, dot(ax, ay), dot(ay, ay) + DILATION);
}

// Determinants of the covariance before and after dilation, by Lagrange's identity: of a needle nothing of xx yy - xy^2 is left once it is rounded.
fn determinants(ax: vec3<f32>, ay: vec3<f32>) -> vec2<f32> {
    let across = cross(ax, ay);
    let before = dot(across, across);
    return vec2<f32>(before, before + DILATION * (dot(ax, ax) + dot(ay, ay)) + DILATION * DILATION);
}

// What dilation leaves of the determinant, at least a millionth: squared share of light that stays (Mip-Splatting, 2-D
// filter).
fn determinant_share(determinants: vec2<f32>) -> f32 {
    return max(determinants.x / determinants.y, 1e-6);
}

// Factor on the opacity that keeps a dilated Gaussian as bright as it was.
fn compensation(determinants: vec2<f32>, view: View) -> f32 {
    return select(1.0, sqrt(determinant_share(determinants)), view.antialias == 1u);
}
