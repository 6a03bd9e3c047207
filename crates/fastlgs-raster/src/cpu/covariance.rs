//! CPU twin of `shaders/shared/covariance.wgsl` and `shaders/shared/rotation.wgsl`: geometry of one
//! projected Gaussian.

use super::DILATION;
use crate::View;
use glam::{Mat3, Mat4, Quat, Vec2, Vec3};

/// Returns the rotation from world to camera. Its rows are the camera axes.
pub fn world_to_camera_rotation(view: &View) -> Mat3 {
    Mat3::from_mat4(Mat4::from_cols_array(&view.world_to_camera))
}

/// Returns x/z and y/z, clamped to the image extended by 0.3 x its half extent on each side.
pub fn clamped_slope(t: Vec3, view: &View) -> Vec2 {
    let (focal, centre) = (Vec2::from(view.focal), Vec2::from(view.centre));
    let size = Vec2::new(view.size[0] as f32, view.size[1] as f32);
    let margin = 0.15 * size;
    (t.truncate() / t.z).clamp(-(centre + margin) / focal, (size - centre + margin) / focal)
}

/// Returns the two rows of J W, the derivative of the pixel position by the world position.
pub fn affine(t: Vec3, view: &View) -> [Vec3; 2] {
    let slope = clamped_slope(t, view);
    let w = world_to_camera_rotation(view);
    let (x, y, z) = (w.row(0), w.row(1), w.row(2));
    [
        view.focal[0] / t.z * (x - slope.x * z),
        view.focal[1] / t.z * (y - slope.y * z),
    ]
}

/// Returns the stored quaternion (w, x, y, z) and the rotation matrix of its unit quaternion.
pub fn rotation(param: impl Fn(usize) -> f32) -> ([f32; 4], Mat3) {
    let q = [6, 7, 8, 9].map(param);
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    (
        q,
        Mat3::from_quat(Quat::from_xyzw(
            q[1] / length,
            q[2] / length,
            q[3] / length,
            q[0] / length,
        )),
    )
}

/// Returns the dilated covariance (xx, xy, yy) in the image from the rows of A.
pub fn dilated(ax: Vec3, ay: Vec3) -> Vec3 {
    Vec3::new(ax.dot(ax) + DILATION, ax.dot(ay), ay.dot(ay) + DILATION)
}

/// Returns the determinants of the covariance before and after dilation. Lagrange's identity is
/// used because xx yy - xy^2 cancels in f32 for long, thin Gaussians.
pub fn determinants(ax: Vec3, ay: Vec3) -> [f32; 2] {
    let before = ax.cross(ay).length_squared();
    [
        before,
        before + DILATION * (ax.dot(ax) + ay.dot(ay)) + DILATION * DILATION,
    ]
}

/// Returns the determinant before dilation divided by the one after it, at least 1e-6.
pub fn determinant_share([before, after]: [f32; 2]) -> f32 {
    (before / after).max(1e-6)
}

/// Returns the factor on opacity that keeps the brightness of a dilated Gaussian (2-D Mip filter);
/// 1 without antialiasing.
pub fn compensation(determinants: [f32; 2], view: &View) -> f32 {
    if view.antialias == 1 {
        determinant_share(determinants).sqrt()
    } else {
        1.0
    }
}
