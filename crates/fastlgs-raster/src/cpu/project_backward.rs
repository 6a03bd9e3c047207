use super::project::rotation;
use super::{ALPHA_MAX, Splat, covariance};
use crate::View;
use fastlgs_core::gaussians::{CHANNELS, SH_C0};
use glam::{Mat4, Vec2, Vec3, Vec4};

/// Twin of `shaders/project_backward.wgsl`.
pub fn project_backward(
    view: &View,
    params: &[f32],
    splats: &[Splat],
    touched: &[u32],
    first_pair: &[u32],
    slots: &[Splat],
    gradients: &mut [f32],
    stats: &mut [f32],
) {
    let n = view.gaussians as usize;
    let w2c = Mat4::from_cols_array(&view.world_to_camera);
    let world = covariance::world(view);
    let (focal, size) = (Vec2::from(view.focal), Vec2::new(view.size[0] as f32, view.size[1] as f32));
    for i in 0..n {
        for c in 0..CHANNELS {
            gradients[c * n + i] = 0.0;
        }
        if touched[i] == 0 {
            continue;
        }
        let mut slot = [[0.0f32; 4]; 3];
        for e in &slots[first_pair[i] as usize..(first_pair[i] + touched[i]) as usize] {
            for k in 0..12 {
                slot[k / 4][k % 4] += e[k / 4][k % 4];
            }
        }
        let [a, b, c] = slot;
        let param3 = |c: usize| Vec3::new(params[c * n + i], params[(c + 1) * n + i], params[(c + 2) * n + i]);
        let mut put3 = |c: usize, v: Vec3| (0..3).for_each(|k| gradients[(c + k) * n + i] = v[k]);
        let raw = Vec3::splat(0.5) + SH_C0 * param3(11);
        put3(11, Vec3::select(raw.cmpgt(Vec3::ZERO), SH_C0 * Vec3::new(b[2], b[3], c[0]), Vec3::ZERO));
        put3(14, Vec3::new(c[1], c[2], c[3]));

        let splat = &splats[i];
        let opacity = splat[1][1];
        let ln2 = std::f32::consts::LN_2;
        let (qa, qb, qc) = (-2.0 * ln2 * splat[0][2], -ln2 * splat[0][3], -2.0 * ln2 * splat[1][0]);
        let d_mean = Vec2::new(qa * a[0] + qb * a[1], qb * a[0] + qc * a[1]);
        stats[i] += (d_mean * 0.5 * size).length();
        stats[n + i] += 1.0;

        let (dq_xx, dq_xy, dq_yy) = (-0.5 * a[2], -0.5 * a[3], -0.5 * b[0]);
        let (mxx, mxy) = (qa * dq_xx + qb * dq_xy, qa * dq_xy + qb * dq_yy);
        let (myx, myy) = (qb * dq_xx + qc * dq_xy, qb * dq_xy + qc * dq_yy);
        let (gxx, gxy, gyy) = (-(mxx * qa + mxy * qb), -(mxx * qb + mxy * qc), -(myx * qb + myy * qc));

        let t = w2c.transform_point3(param3(0));
        let (q, r) = rotation(params, n, i);
        let s = param3(3).map(f32::exp);
        let [jx, jy] = covariance::affine(t, view);
        let (ax, ay) = (r.transpose() * jx * s, r.transpose() * jy * s);
        let (d_ax, d_ay) = (2.0 * (gxx * ax + gxy * ay), 2.0 * (gxy * ax + gyy * ay));
        let v = [0, 1, 2].map(|k| jx * d_ax[k] + jy * d_ay[k]);
        put3(3, s * Vec3::new(r.col(0).dot(v[0]), r.col(1).dot(v[1]), r.col(2).dot(v[2])));

        let [r0, r1, r2] = [v[0] * s.x, v[1] * s.y, v[2] * s.z];
        let length = Vec4::from(q).length().max(1e-12);
        let unit = Vec4::from(q) / length;
        let (w, x, y, z) = (unit.x, unit.y, unit.z, unit.w);
        let d_unit = 2.0
            * Vec4::new(
                z * (r0.y - r1.x) + y * (r2.x - r0.z) + x * (r1.z - r2.y),
                y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r1.z - r2.y) - 2.0 * x * (r1.y + r2.z),
                x * (r0.y + r1.x) + z * (r1.z + r2.y) + w * (r2.x - r0.z) - 2.0 * y * (r0.x + r2.z),
                x * (r0.z + r2.x) + y * (r1.z + r2.y) + w * (r0.y - r1.x) - 2.0 * z * (r0.x + r1.y),
            );
        let d_rotation = (d_unit - unit * unit.dot(d_unit)) / length;

        let rs = [r.col(0) * s.x, r.col(1) * s.y, r.col(2) * s.z];
        let d_jwx = rs[0] * d_ax.x + rs[1] * d_ax.y + rs[2] * d_ax.z;
        let d_jwy = rs[0] * d_ay.x + rs[1] * d_ay.y + rs[2] * d_ay.z;
        let (d_jx, d_jy) = (world * d_jwx, world * d_jwy);
        let inv = 1.0 / t.z;
        let slope = covariance::clamped_slope(t, view);
        let true_slope = t.truncate() / t.z;
        let free = Vec2::select(slope.cmpeq(true_slope), Vec2::ONE, Vec2::ZERO);
        let mut d_t = (focal * inv * d_mean).extend(-(focal * t.truncate() * inv * inv).dot(d_mean));
        let d_slope = -focal * inv * Vec2::new(d_jx.z, d_jy.z) * free;
        d_t.x += d_slope.x * inv;
        d_t.y += d_slope.y * inv;
        let d_rows = Vec2::new(d_jx.x - slope.x * d_jx.z, d_jy.y - slope.y * d_jy.z);
        d_t.z -= inv * inv * focal.dot(d_rows) + inv * inv * d_slope.dot(t.truncate());
        put3(0, world.transpose() * d_t);
        (0..4).for_each(|k| gradients[(6 + k) * n + i] = d_rotation[k]);
        gradients[10 * n + i] = if opacity < ALPHA_MAX { b[1] * opacity * (1.0 - opacity) } else { 0.0 };
    }
}
