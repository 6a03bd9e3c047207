// Geometry of one projected Gaussian (3DGS, section 4; EWA splatting).

// Rotation matrix of a unit quaternion (w, x, y, z).
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
