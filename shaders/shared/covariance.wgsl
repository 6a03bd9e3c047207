// Geometry of one projected Gaussian (3DGS, section 4; EWA splatting).
#import rotation

// Ray slopes beyond 1.3 x the image's half extent are clamped: the affine approximation explodes there.
fn clamped_slope(t: vec3<f32>, view: View) -> vec2<f32> {
    let size = vec2<f32>(view.size);
    let low = -1.3 * view.centre / view.focal;
    let high = 1.3 * (size - view.centre) / view.focal;
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

// What dilation takes from the determinant, at least a millionth: squared share of light that stays (Mip-Splatting, 2-D
// filter).
fn determinant_share(cov: vec3<f32>) -> f32 {
    let det = cov.x * cov.z - cov.y * cov.y;
    return max(((cov.x - DILATION) * (cov.z - DILATION) - cov.y * cov.y) / det, 1e-6);
}

// Factor on the opacity that keeps a dilated Gaussian as bright as it was.
fn compensation(cov: vec3<f32>, view: View) -> f32 {
    return select(1.0, sqrt(determinant_share(cov)), view.antialias == 1u);
}
