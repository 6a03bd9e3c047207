//! Twin of `shaders/shared/covariance.wgsl` and `shaders/shared/rotation.wgsl`: geometry of one projected Gaussian.

use super::DILATION;
use crate::View;
use glam::{Mat3, Mat4, Quat, Vec2, Vec3};

/// World to camera rotation, its rows being the camera axes.
pub fn world(view: &View) -> Mat3 {
    Mat3::from_mat4(Mat4::from_cols_array(&view.world_to_camera))
}

/// x/z and y/z, clamped to what the image shows and 0.3 x its half extent beside it.
pub fn clamped_slope(t: Vec3, view: &View) -> Vec2 {
    let (focal, centre) = (Vec2::from(view.focal), Vec2::from(view.centre));
    let size = Vec2::new(view.size[0] as f32, view.size[1] as f32);
    let beside = 0.15 * size;
    (t.truncate() / t.z).clamp(-(centre + beside) / focal, (size - centre + beside) / focal)
}

/// The two rows of J W.
pub fn affine(t: Vec3, view: &View) -> [Vec3; 2] {
    let slope = clamped_slope(t, view);
    let w = world(view);
    let (x, y, z) = (w.row(0), w.row(1), w.row(2));
    [view.focal[0] / t.z * (x - slope.x * z), view.focal[1] / t.z * (y - slope.y * z)]
}

/// Quaternion as stored (w, x, y, z) and the rotation matrix of its unit quaternion.
pub fn rotation(param: impl Fn(usize) -> f32) -> ([f32; 4], Mat3) {
    let q = [6, 7, 8, 9].map(param);
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    (q, Mat3::from_quat(Quat::from_xyzw(q[1] / length, q[2] / length, q[3] / length, q[0] / length)))
}

/// Covariance (xx, xy, yy) in the image from the rows of A, dilated.
pub fn dilated(ax: Vec3, ay: Vec3) -> Vec3 {
    Vec3::new(ax.dot(ax) + DILATION, ax.dot(ay), ay.dot(ay) + DILATION)
}

/// Determinants of the covariance before and after dilation, by Lagrange's identity: of a needle nothing of xx yy - xy^2 is left once it is rounded.
pub fn determinants(ax: Vec3, ay: Vec3) -> [f32; 2] {
    let before = ax.cross(ay).length_squared();
    [before, before + DILATION * (ax.dot(ax) + ay.dot(ay)) + DILATION * DILATION]
}

/// What dilation leaves of the determinant, at least a millionth.
pub fn determinant_share([before, after]: [f32; 2]) -> f32 {
    (before / after).max(1e-6)
}

/// Factor on the opacity that keeps a dilated Gaussian as bright as it was.
pub fn compensation(determinants: [f32; 2], view: &View) -> f32 {
    if view.antialias == 1 { determinant_share(determinants).sqrt() } else { 1.0 }
}
