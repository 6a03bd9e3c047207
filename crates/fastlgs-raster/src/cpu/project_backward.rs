use super::harmonics::{basis, basis_slopes};
use super::{ALPHA_MAX, DILATION, Splat, covariance};
use crate::View;
use crate::pass::Channels;
use crate::view::stride;
use fastlgs_core::gaussians::{BASE_CHANNELS, SH_C0, rest_len, sigmoid};
use glam::{Mat4, Vec2, Vec3, Vec4};

/// Twin of `shaders/project_backward.wgsl`. `slots` holds 12 floats a pair, or 4 with frozen geometry.
pub fn project_backward(
    view: &View,
    channels: Channels,
    params: &[f32],
    splats: &[Splat],
    order: &[u32],
    touched: &[u32],
    first_pair: &[u32],
    slots: &[f32],
    gradients: &mut [f32],
    stats: &mut [f32],
) {
    let page = stride(view.page as usize);
    let floats = 4 * channels.slot();
    for &g in &order[..view.gaussians as usize] {
        let start = first_pair[g as usize];
        let in_page = g >= view.first && g - view.first < view.page;
        if !in_page || start < view.slot_first || start - view.slot_first >= view.slot_count {
            continue;
        }
        let i = (g - view.first) as usize;
        let put = |c: usize, value: f32| gradients[c * page + i] = value;
        let pairs = (start - view.slot_first) as usize..(start - view.slot_first + touched[g as usize]) as usize;
        let slot = sum_of(slots, floats, pairs);
        match backward_one(view, channels, |c| params[c * page + i], touched[g as usize] > 0, &splats[g as usize], &slot, put) {
            Some(length) if channels.color() => {
                stats[g as usize] += length;
                stats[(view.gaussians + g) as usize] += 1.0;
            }
            _ => {}
        }
    }
}

/// Sum of the slots of `pairs`; slots of four floats are the last four of the twelve.
fn sum_of(slots: &[f32], floats: usize, pairs: std::ops::Range<usize>) -> [f32; 12] {
    let mut slot = [0.0; 12];
    for pair in slots[pairs.start * floats..pairs.end * floats].chunks_exact(floats) {
        for (sum, value) in slot[12 - floats..].iter_mut().zip(pair) {
            *sum += value;
        }
    }
    slot
}

/// Carries one Gaussian's summed slot to its trained values, which `put(channel, gradient)` receives. Returns the length
/// of the projected mean's gradient in half-image units for Gaussians that are drawn.
pub(crate) fn backward_one(
    view: &View,
    channels: Channels,
    param: impl Fn(usize) -> f32,
    drawn: bool,
    splat: &Splat,
    slot: &[f32; 12],
    mut put: impl FnMut(usize, f32),
) -> Option<f32> {
    let param3 = |c: usize| Vec3::new(param(c), param(c + 1), param(c + 2));
    let mut put3 = |c: usize, v: Vec3| (0..3).for_each(|k| put(c + k, v[k]));
    put3(14, Vec3::new(slot[9], slot[10], slot[11]));
    if !channels.color() {
        return drawn.then_some(0.0);
    }
    if !drawn {
        (0..12).step_by(3).for_each(|c| put3(c, Vec3::ZERO));
        (12..14).for_each(|c| put(c, 0.0));
        (0..rest_len(view.sh_degree)).for_each(|k| (0..3).for_each(|c| put(BASE_CHANNELS + 3 * k + c, 0.0)));
        return None;
    }
    let mean = param3(0);
    // Colour is cut off at 0 from below.
    let shown = Vec3::new(splat[1][2], splat[1][3], splat[2][0]).cmpgt(Vec3::ZERO);
    let d_color = Vec3::select(shown, Vec3::new(slot[6], slot[7], slot[8]), Vec3::ZERO);
    put3(11, SH_C0 * d_color);
    let mut d_mean_by_color = Vec3::ZERO;
    if view.sh_degree > 0 {
        let ray = mean - Vec3::from_slice(&view.camera);
        let (distance, direction) = (ray.length(), ray.normalize());
        let (b, slopes) = (basis(direction), basis_slopes(direction));
        let mut d_direction = Vec3::ZERO;
        for k in 0..rest_len(view.sh_degree) {
            put3(BASE_CHANNELS + 3 * k, b[k] * d_color);
            d_direction += param3(BASE_CHANNELS + 3 * k).dot(d_color) * slopes[k];
        }
        d_mean_by_color = (d_direction - direction * direction.dot(d_direction)) / distance;
    }

    let ln2 = std::f32::consts::LN_2;
    let (qa, qb, qc) = (-2.0 * ln2 * splat[0][2], -ln2 * splat[0][3], -2.0 * ln2 * splat[1][0]);
    let d_center = Vec2::new(qa * slot[0] + qb * slot[1], qb * slot[0] + qc * slot[1]);
    let size = Vec2::new(view.size[0] as f32, view.size[1] as f32);

    // dL/dQ = -1/2 sum p d d^T; dL/dcov = -Q (dL/dQ) Q.
    let (dq_xx, dq_xy, dq_yy) = (-0.5 * slot[2], -0.5 * slot[3], -0.5 * slot[4]);
    let (mxx, mxy) = (qa * dq_xx + qb * dq_xy, qa * dq_xy + qb * dq_yy);
    let (myx, myy) = (qb * dq_xx + qc * dq_xy, qb * dq_xy + qc * dq_yy);
    let (mut gxx, mut gxy, mut gyy) = (-(mxx * qa + mxy * qb), -(mxx * qb + mxy * qc), -(myx * qb + myy * qc));

    let t = Mat4::from_cols_array(&view.world_to_camera).transform_point3(mean);
    let (q, r) = covariance::rotation(&param);
    let s = param3(3).map(f32::exp);
    let [jx, jy] = covariance::affine(t, view);
    let (ax, ay) = (r.transpose() * jx * s, r.transpose() * jy * s);
    let cov = covariance::dilated(ax, ay);
    let opacity = sigmoid(param(10));
    let free_opacity = if opacity * covariance::compensation(cov, view) < ALPHA_MAX { 1.0 } else { 0.0 };
    put(10, slot[5] * (1.0 - opacity) * free_opacity);
    let mut put3 = |c: usize, v: Vec3| (0..3).for_each(|k| put(c + k, v[k]));
    if view.antialias == 1 && covariance::determinant_share(cov) > 1e-6 {
        // d log(compensation) / d cov = (inverse before dilation - inverse after it) / 2.
        let (xx, yy) = (cov.x - DILATION, cov.z - DILATION);
        let det = xx * yy - cov.y * cov.y;
        let half = 0.5 * slot[5] * free_opacity;
        gxx += half * (yy / det - qa);
        gxy += half * (-cov.y / det - qb);
        gyy += half * (xx / det - qc);
    }
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
    let world = covariance::world(view);
    let (d_jx, d_jy) = (world * d_jwx, world * d_jwy);
    let (inv, focal) = (1.0 / t.z, Vec2::from(view.focal));
    let slope = covariance::clamped_slope(t, view);
    let free = Vec2::select(slope.cmpeq(t.truncate() / t.z), Vec2::ONE, Vec2::ZERO);
    let mut d_t = (focal * inv * d_center).extend(-(focal * t.truncate() * inv * inv).dot(d_center));
    let d_slope = -focal * inv * Vec2::new(d_jx.z, d_jy.z) * free;
    d_t.x += d_slope.x * inv;
    d_t.y += d_slope.y * inv;
    let d_rows = Vec2::new(d_jx.x - slope.x * d_jx.z, d_jy.y - slope.y * d_jy.z);
    d_t.z -= inv * inv * focal.dot(d_rows) + inv * inv * d_slope.dot(t.truncate());
    put3(0, world.transpose() * d_t + d_mean_by_color);
    (0..4).for_each(|k| put(6 + k, d_rotation[k]));
    Some((d_center * 0.5 * size).length())
}
