//! CPU twin of `shaders/shared/harmonics.wgsl`: spherical harmonics.

use glam::Vec3;

/// Returns the real spherical harmonics of degrees 1 to 3 in the direction `d` of length 1, with
/// the signs of 3DGS.
pub fn basis(d: Vec3) -> [f32; 15] {
    let (xx, yy, zz) = (d.x * d.x, d.y * d.y, d.z * d.z);
    [
        -0.488_602_5 * d.y,
        0.488_602_5 * d.z,
        -0.488_602_5 * d.x,
        1.092_548_4 * d.x * d.y,
        -1.092_548_4 * d.y * d.z,
        0.315_391_57 * (2.0 * zz - xx - yy),
        -1.092_548_4 * d.x * d.z,
        0.546_274_2 * (xx - yy),
        -0.590_043_6 * d.y * (3.0 * xx - yy),
        2.890_611_4 * d.x * d.y * d.z,
        -0.457_045_8 * d.y * (4.0 * zz - xx - yy),
        0.373_176_33 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_8 * d.x * (4.0 * zz - xx - yy),
        1.445_305_7 * d.z * (xx - yy),
        -0.590_043_6 * d.x * (xx - 3.0 * yy),
    ]
}

/// Returns the derivatives of `basis` by the direction.
pub fn basis_slopes(d: Vec3) -> [Vec3; 15] {
    let (xx, yy, zz) = (d.x * d.x, d.y * d.y, d.z * d.z);
    let v = Vec3::new;
    [
        v(0.0, -0.488_602_5, 0.0),
        v(0.0, 0.0, 0.488_602_5),
        v(-0.488_602_5, 0.0, 0.0),
        1.092_548_4 * v(d.y, d.x, 0.0),
        -1.092_548_4 * v(0.0, d.z, d.y),
        0.630_783_13 * v(-d.x, -d.y, 2.0 * d.z),
        -1.092_548_4 * v(d.z, 0.0, d.x),
        1.092_548_4 * v(d.x, -d.y, 0.0),
        -0.590_043_6 * v(6.0 * d.x * d.y, 3.0 * (xx - yy), 0.0),
        2.890_611_4 * v(d.y * d.z, d.x * d.z, d.x * d.y),
        -0.457_045_8 * v(-2.0 * d.x * d.y, 4.0 * zz - xx - 3.0 * yy, 8.0 * d.y * d.z),
        0.373_176_33
            * v(
                -6.0 * d.x * d.z,
                -6.0 * d.y * d.z,
                6.0 * zz - 3.0 * (xx + yy),
            ),
        -0.457_045_8 * v(4.0 * zz - 3.0 * xx - yy, -2.0 * d.x * d.y, 8.0 * d.x * d.z),
        1.445_305_7 * v(2.0 * d.x * d.z, -2.0 * d.y * d.z, xx - yy),
        -0.590_043_6 * v(3.0 * (xx - yy), -6.0 * d.x * d.y, 0.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_derivatives() {
        let (d, step) = (Vec3::new(0.48, -0.6, 0.64), 1e-2);
        let slopes = basis_slopes(d);
        for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
            let (after, before) = (basis(d + axis * step), basis(d - axis * step));
            for k in 0..15 {
                let measured = (after[k] - before[k]) / (2.0 * step);
                assert!(
                    (measured - slopes[k].dot(axis)).abs() < 2e-3,
                    "coefficient {k}: {measured} against {}",
                    slopes[k].dot(axis)
                );
            }
        }
    }
}
