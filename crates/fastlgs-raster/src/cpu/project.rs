use super::footprint::{Footprint, span};
use super::{ALPHA_MAX, ALPHA_MIN, DILATION, NEAR, Splat, covariance};
use crate::View;
use crate::view::TILE;
use fastlgs_core::gaussians::{SH_C0, sigmoid};
use glam::{Mat3, Mat4, Quat, Vec2, Vec3};

/// Twin of `shaders/project.wgsl`.
pub fn project(view: &View, params: &[f32], splats: &mut [Splat], depths: &mut [u32], footprints: &mut [Footprint], touched: &mut [u32]) {
    let n = view.gaussians as usize;
    let w2c = Mat4::from_cols_array(&view.world_to_camera);
    for i in 0..n {
        depths[i] = 0xff_ffff;
        touched[i] = 0;
        let param3 = |c: usize| Vec3::new(params[c * n + i], params[(c + 1) * n + i], params[(c + 2) * n + i]);
        let t = w2c.transform_point3(param3(0));
        let opacity = sigmoid(params[10 * n + i]);
        if t.z.is_nan() || t.z <= NEAR || opacity.is_nan() || opacity < ALPHA_MIN {
            continue;
        }
        let r = rotation(params, n, i).1;
        let s = param3(3).map(f32::exp);
        let [jx, jy] = covariance::affine(t, view);
        let (ax, ay) = (r.transpose() * jx * s, r.transpose() * jy * s);
        let (cxx, cxy, cyy) = (ax.dot(ax) + DILATION, ax.dot(ay), ay.dot(ay) + DILATION);
        let det = cxx * cyy - cxy * cxy;
        let mean = Vec2::from(view.focal) * t.truncate() / t.z + Vec2::from(view.centre);
        let reach2 = 2.002 * (opacity / ALPHA_MIN).ln() + 1e-4;
        let half_height = (reach2 * cyy).sqrt();
        let finite = det > 0.0 && det < 1e30 && mean.x.abs() < 1e9 && mean.y.abs() < 1e9 && half_height < 1e9 && cxx < 1e15;
        if !finite {
            continue;
        }
        let (size, rows) = (TILE as f32, view.tiles[1] as f32);
        let first_row = (((mean.y - half_height + 0.5) / size).ceil() - 1.0).clamp(0.0, rows);
        let end_row = (((mean.y + half_height - 0.5) / size).floor() + 1.0).clamp(0.0, rows);
        let footprint = [[mean.x, mean.y, cxy / cyy, det / (cyy * cyy)], [reach2 * cyy, (reach2 / cxx).sqrt() * cxy, first_row, end_row]];
        let count = (first_row as u32..end_row as u32).map(|row| span(&footprint, row, view.tiles[0]).len() as u32).sum();
        if count == 0 {
            continue;
        }
        let color = (Vec3::splat(0.5) + SH_C0 * param3(11)).max(Vec3::ZERO);
        let f = if view.depth_as_feature == 1 { Vec3::new(t.z, 0.0, 0.0) } else { param3(14) };
        let log2e = std::f32::consts::LOG2_E;
        let (qa, qb, qc) = (cyy / det, -cxy / det, cxx / det);
        splats[i] = [
            [mean.x, mean.y, -0.5 * log2e * qa, -log2e * qb],
            [-0.5 * log2e * qc, opacity.min(ALPHA_MAX), color.x, color.y],
            [color.z, f.x, f.y, f.z],
        ];
        depths[i] = (t.z.to_bits() >> 7).min(0xff_fffe);
        footprints[i] = footprint;
        touched[i] = count;
    }
}

/// Quaternion as stored (w, x, y, z) and the rotation matrix of its unit quaternion.
pub(super) fn rotation(params: &[f32], n: usize, i: usize) -> ([f32; 4], Mat3) {
    let q = [params[6 * n + i], params[7 * n + i], params[8 * n + i], params[9 * n + i]];
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    (q, Mat3::from_quat(Quat::from_xyzw(q[1] / length, q[2] / length, q[3] / length, q[0] / length)))
}
