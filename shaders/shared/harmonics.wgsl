// Real spherical harmonics up to degree 3, with the signs of 3DGS.
const SH_C0: f32 = 0.28209479;

fn basis(d: vec3<f32>) -> array<f32, 15> {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<f32, 15>(
        -0.48860251 * d.y,
        0.48860251 * d.z,
        -0.48860251 * d.x,
        1.0925484 * d.x * d.y,
        -1.0925484 * d.y * d.z,
        0.31539157 * (2.0 * zz - xx - yy),
        -1.0925484 * d.x * d.z,
        0.54627422 * (xx - yy),
        -0.59004359 * d.y * (3.0 * xx - yy),
        2.8906114 * d.x * d.y * d.z,
        -0.45704579 * d.y * (4.0 * zz - xx - yy),
        0.37317633 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.45704579 * d.x * (4.0 * zz - xx - yy),
        1.4453057 * d.z * (xx - yy),
        -0.59004359 * d.x * (xx - 3.0 * yy),
    );
}

// Returns the derivatives of the basis by the direction.
fn basis_slopes(d: vec3<f32>) -> array<vec3<f32>, 15> {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<vec3<f32>, 15>(
        vec3<f32>(0.0, -0.48860251, 0.0),
        vec3<f32>(0.0, 0.0, 0.48860251),
        vec3<f32>(-0.48860251, 0.0, 0.0),
        1.0925484 * vec3<f32>(d.y, d.x, 0.0),
        -1.0925484 * vec3<f32>(0.0, d.z, d.y),
        0.63078313 * vec3<f32>(-d.x, -d.y, 2.0 * d.z),
        -1.0925484 * vec3<f32>(d.z, 0.0, d.x),
        1.0925484 * vec3<f32>(d.x, -d.y, 0.0),
        -0.59004359 * vec3<f32>(6.0 * d.x * d.y, 3.0 * (xx - yy), 0.0),
        2.8906114 * vec3<f32>(d.y * d.z, d.x * d.z, d.x * d.y),
        -0.45704579 * vec3<f32>(-2.0 * d.x * d.y, 4.0 * zz - xx - 3.0 * yy, 8.0 * d.y * d.z),
        0.37317633 * vec3<f32>(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * zz - 3.0 * (xx + yy)),
        -0.45704579 * vec3<f32>(4.0 * zz - 3.0 * xx - yy, -2.0 * d.x * d.y, 8.0 * d.x * d.z),
        1.4453057 * vec3<f32>(2.0 * d.x * d.z, -2.0 * d.y * d.z, xx - yy),
        -0.59004359 * vec3<f32>(3.0 * (xx - yy), -6.0 * d.x * d.y, 0.0),
    );
}

// Returns the number of coefficients above degree 0.
fn rest_of(degree: u32) -> u32 {
    return (degree + 1u) * (degree + 1u) - 1u;
}
