//! CPU twin of `shaders/project_backward.wgsl`: gradients of the trained values.

use super::harmonics::{basis, basis_slopes};
use super::{ALPHA_MAX, DILATION, Splat, covariance};
use crate::View;
use crate::channels::Channels;
use crate::view::{DEPTH_MOMENTS, stride};
use fastlgs_core::gaussians::{BASE_CHANNELS, SH_C0, rest_len, sigmoid};
use glam::{Mat4, Vec2, Vec3, Vec4};

/// Sums the gradient slots of each Gaussian and computes the gradients of its trained values.
/// `slots` holds 12 floats for each pair, or 4 with frozen geometry.
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
        let store_gradient = |c: usize, value: f32| gradients[c * page + i] = value;
        let first = start - view.slot_first;
        let runs = (first / view.fold_length + 1) * view.fold_length;
        let pairs = std::iter::once(first)
            .chain((runs..first + touched[g as usize]).step_by(view.fold_length as usize));
        let slot = sum_of(slots, floats, pairs.take(touched[g as usize] as usize));
        match backward_one(
            view,
            channels,
            |c| params[c * page + i],
            touched[g as usize] > 0,
            &splats[g as usize],
            &slot,
            store_gradient,
        ) {
            Some(length) if channels.color() && view.depth_as_feature != DEPTH_MOMENTS => {
                stats[g as usize] += length;
                stats[(view.gaussians + g) as usize] += 1.0;
            }
            _ => {}
        }
    }
}

/// Sums the slots of `pairs`. Slots of 4 floats are the last 4 of the 12.
fn sum_of(slots: &[f32], floats: usize, pairs: impl Iterator<Item = u32>) -> [f32; 12] {
    let mut slot = [0.0; 12];
    for pair in pairs {
        for (sum, value) in slot[12 - floats..]
            .iter_mut()
            .zip(&slots[pair as usize * floats..])
        {
            *sum += value;
        }
    }
    slot
}

/// Propagates the summed slot of one Gaussian to its trained values, and passes each gradient to
/// `put(channel, gradient)`. Formulas and symbols are those of docs/how-it-works.md, 5.2 to 5.7.
///
/// Returns the length of the gradient of the projected mean in half-image units, 0 with frozen
/// geometry, or none if the Gaussian is not drawn.
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
    let trains_depth = view.depth_as_feature == DEPTH_MOMENTS;
    let d_feature = Vec3::new(slot[9], slot[10], slot[11]);
    // Depth moments are no trained values.
    put3(14, if trains_depth { Vec3::ZERO } else { d_feature });
    if !channels.color() {
        return drawn.then_some(0.0);
    }
    if !drawn {
        (0..12).step_by(3).for_each(|c| put3(c, Vec3::ZERO));
        (12..14).for_each(|c| put(c, 0.0));
        (0..rest_len(view.sh_degree))
            .for_each(|k| (0..3).for_each(|c| put(BASE_CHANNELS + 3 * k + c, 0.0)));
        return None;
    }
    let mean = param3(0);
    let d_mean_by_color = color_gradient(view, param3, splat, slot, put3);

    // Section 5.3: the conic Q of the natural exponent, from the splat's base-2 exponent.
    let ln2 = std::f32::consts::LN_2;
    let (q_xx, q_xy, q_yy) = (
        -2.0 * ln2 * splat[0][2],
        -ln2 * splat[0][3],
        -2.0 * ln2 * splat[1][0],
    );
    let d_center = Vec2::new(
        q_xx * slot[0] + q_xy * slot[1],
        q_xy * slot[0] + q_yy * slot[1],
    );
    let size = Vec2::new(view.size[0] as f32, view.size[1] as f32);

    // dL/dQ = -1/2 sum p d d^T; dL/dcov = -(Q dL/dQ) Q.
    let (d_q_xx, d_q_xy, d_q_yy) = (-0.5 * slot[2], -0.5 * slot[3], -0.5 * slot[4]);
    let (qdq_xx, qdq_xy) = (q_xx * d_q_xx + q_xy * d_q_xy, q_xx * d_q_xy + q_xy * d_q_yy);
    let (qdq_yx, qdq_yy) = (q_xy * d_q_xx + q_yy * d_q_xy, q_xy * d_q_xy + q_yy * d_q_yy);
    let (mut d_cov_xx, mut d_cov_xy, mut d_cov_yy) = (
        -(qdq_xx * q_xx + qdq_xy * q_xy),
        -(qdq_xx * q_xy + qdq_xy * q_yy),
        -(qdq_yx * q_xy + qdq_yy * q_yy),
    );

    let t = Mat4::from_cols_array(&view.world_to_camera).transform_point3(mean);
    let (q, r) = covariance::rotation(&param);
    let s = param3(3).map(f32::exp);
    let [jw_x, jw_y] = covariance::affine(t, view);
    let (a_x, a_y) = (r.transpose() * jw_x * s, r.transpose() * jw_y * s);
    let cov = covariance::dilated(a_x, a_y);
    // Section 5.2. Where opacity is clamped at ALPHA_MAX, only a gradient that lowers it passes.
    let opacity = sigmoid(param(10));
    let dets = covariance::determinants(a_x, a_y);
    let clamped = view.kept_gain() * opacity * covariance::compensation(dets, view) >= ALPHA_MAX;
    let unclamped_opacity = if clamped && slot[5] < 0.0 { 0.0 } else { 1.0 };
    put(10, slot[5] * (1.0 - opacity) * unclamped_opacity);
    if view.antialias == 1 && covariance::determinant_share(dets) > 1e-6 {
        // d log(compensation) / d cov = (inverse before dilation - inverse after it) / 2.
        let (xx, yy) = (cov.x - DILATION, cov.z - DILATION);
        let det = dets[0];
        let half = 0.5 * slot[5] * unclamped_opacity;
        d_cov_xx += half * (yy / det - q_xx);
        d_cov_xy += half * (-cov.y / det - q_xy);
        d_cov_yy += half * (xx / det - q_yy);
    }
    // Section 5.4: cov = A A^T + dilation, A = (J W) M, M = R S.
    let (d_a_x, d_a_y) = (
        2.0 * (d_cov_xx * a_x + d_cov_xy * a_y),
        2.0 * (d_cov_xy * a_x + d_cov_yy * a_y),
    );
    let d_m = [0, 1, 2].map(|k| jw_x * d_a_x[k] + jw_y * d_a_y[k]);
    let d_scale = Vec3::new(
        r.col(0).dot(d_m[0]),
        r.col(1).dot(d_m[1]),
        r.col(2).dot(d_m[2]),
    );
    let d_rotation = rotation_gradient(q, [d_m[0] * s.x, d_m[1] * s.y, d_m[2] * s.z]);

    // Section 5.5: the mean, through the projected centre and through J.
    let m = [r.col(0) * s.x, r.col(1) * s.y, r.col(2) * s.z];
    let d_jw = [d_a_x, d_a_y].map(|d_a| m[0] * d_a.x + m[1] * d_a.y + m[2] * d_a.z);
    let world = covariance::world_to_camera_rotation(view);
    let mut d_t = camera_gradient(view, t, d_center, d_jw.map(|d_jw| world * d_jw));
    if trains_depth {
        // Section 5.7: through ln z and its square.
        d_t.z += (d_feature.x + 2.0 * t.z.ln() * d_feature.y) / t.z;
    }
    let mut put3 = |c: usize, v: Vec3| (0..3).for_each(|k| put(c + k, v[k]));
    put3(3, s * d_scale);
    put3(0, world.transpose() * d_t + d_mean_by_color);
    (0..4).for_each(|k| put(6 + k, d_rotation[k]));
    Some((d_center * 0.5 * size).length())
}

/// Section 5.6: puts the gradients of the SH coefficients. Returns the gradient of the mean through
/// the viewing direction. Colour is clamped at 0 from below.
#[inline(always)]
fn color_gradient(
    view: &View,
    param3: impl Fn(usize) -> Vec3,
    splat: &Splat,
    slot: &[f32; 12],
    mut put3: impl FnMut(usize, Vec3),
) -> Vec3 {
    let positive = Vec3::new(splat[1][2], splat[1][3], splat[2][0]).cmpgt(Vec3::ZERO);
    let d_color = Vec3::select(positive, Vec3::new(slot[6], slot[7], slot[8]), Vec3::ZERO);
    put3(11, SH_C0 * d_color);
    if view.sh_degree == 0 {
        return Vec3::ZERO;
    }
    let ray = param3(0) - Vec3::from_slice(&view.camera);
    let (distance, direction) = (ray.length(), ray.normalize());
    let (y, slopes) = (basis(direction), basis_slopes(direction));
    let mut d_direction = Vec3::ZERO;
    for k in 0..rest_len(view.sh_degree) {
        put3(BASE_CHANNELS + 3 * k, y[k] * d_color);
        d_direction += param3(BASE_CHANNELS + 3 * k).dot(d_color) * slopes[k];
    }
    (d_direction - direction * direction.dot(d_direction)) / distance
}

/// Returns the gradient of the quaternion `q` from those of the columns of its rotation matrix.
#[inline(always)]
fn rotation_gradient(q: [f32; 4], [d_r0, d_r1, d_r2]: [Vec3; 3]) -> Vec4 {
    let length = Vec4::from(q).length().max(1e-12);
    let unit = Vec4::from(q) / length;
    let (w, x, y, z) = (unit.x, unit.y, unit.z, unit.w);
    let d_unit = 2.0
        * Vec4::new(
            z * (d_r0.y - d_r1.x) + y * (d_r2.x - d_r0.z) + x * (d_r1.z - d_r2.y),
            y * (d_r0.y + d_r1.x) + z * (d_r0.z + d_r2.x) + w * (d_r1.z - d_r2.y)
                - 2.0 * x * (d_r1.y + d_r2.z),
            x * (d_r0.y + d_r1.x) + z * (d_r1.z + d_r2.y) + w * (d_r2.x - d_r0.z)
                - 2.0 * y * (d_r0.x + d_r2.z),
            x * (d_r0.z + d_r2.x) + y * (d_r1.z + d_r2.y) + w * (d_r0.y - d_r1.x)
                - 2.0 * z * (d_r0.x + d_r1.y),
        );
    (d_unit - unit * unit.dot(d_unit)) / length
}

/// Section 5.5: returns the gradient of the mean in camera coordinates `t`, from those of the
/// projected centre and of the rows of J.
#[inline(always)]
fn camera_gradient(view: &View, t: Vec3, d_center: Vec2, [d_j_x, d_j_y]: [Vec3; 2]) -> Vec3 {
    let (inverse_z, focal) = (1.0 / t.z, Vec2::from(view.focal));
    let slope = covariance::clamped_slope(t, view);
    let unclamped = Vec2::select(slope.cmpeq(t.truncate() / t.z), Vec2::ONE, Vec2::ZERO);
    let mut d_t = (focal * inverse_z * d_center)
        .extend(-(focal * t.truncate() * inverse_z * inverse_z).dot(d_center));
    let d_slope = -focal * inverse_z * Vec2::new(d_j_x.z, d_j_y.z) * unclamped;
    d_t.x += d_slope.x * inverse_z;
    d_t.y += d_slope.y * inverse_z;
    let d_rows = Vec2::new(d_j_x.x - slope.x * d_j_x.z, d_j_y.y - slope.y * d_j_y.z);
    d_t.z -= inverse_z * inverse_z * focal.dot(d_rows)
        + inverse_z * inverse_z * d_slope.dot(t.truncate());
    d_t
}
