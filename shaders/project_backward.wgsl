// Sums the gradient slots of each Gaussian and propagates them through the projection to the
// trained values: docs/how-it-works.md, 5.2 to 5.6, with the same symbols (d_x is dL/dx).
//
// Invocations take the Gaussians in depth order. Neighbours then touch similar numbers of tiles,
// and their slots are contiguous.
//
// gradients [page]  dL/d(params), with the same layout; untrained channels are not written
// stats     [2][n]  += length of the projected mean's gradient (half-image units), += 1 if drawn
#import view
#import channels
#import harmonics
#import covariance
#import flat
#import slot

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> touched: array<u32>;
@group(0) @binding(5) var<storage, read> first_pair: array<u32>;
@group(0) @binding(6) var<storage, read> slots: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(8) var<storage, read_write> stats: array<f32>;

fn param(channel: u32, i: u32) -> f32 {
    return params[channel * stride(view.page) + i];
}

fn param3(channel: u32, i: u32) -> vec3<f32> {
    return vec3<f32>(param(channel, i), param(channel + 1u, i), param(channel + 2u, i));
}

fn put(channel: u32, i: u32, value: f32) {
    gradients[channel * stride(view.page) + i] = value;
}

fn put3(channel: u32, i: u32, value: vec3<f32>) {
    put(channel, i, value.x);
    put(channel + 1u, i, value.y);
    put(channel + 2u, i, value.z);
}

// Section 5.6: computes the gradients of the SH coefficients from that of the colour. Returns the
// gradient of the mean, on which the viewing direction depends.
fn color_backward(i: u32, mean: vec3<f32>, splat_color: vec3<f32>, gradient: vec3<f32>) -> vec3<f32> {
    // Colour is clamped at 0 from below.
    let d_color = select(vec3<f32>(0.0), gradient, splat_color > vec3<f32>(0.0));
    put3(COLOR, i, SH_C0 * d_color);
#ifdef WITH_SH
    let ray = mean - view.camera.xyz;
    let distance = length(ray);
    let direction = ray / distance;
    let y = basis(direction);
    let slopes = basis_slopes(direction);
    let rest = rest_of(view.sh_degree);
    var d_direction = vec3<f32>(0.0);
    // Unrolled, so that the basis stays in registers.
#each K 15
    if $Ku < rest {
        put3(SH_REST + 3u * $Ku, i, y[$K] * d_color);
        d_direction += dot(param3(SH_REST + 3u * $Ku, i), d_color) * slopes[$K];
    }
#end
    return (d_direction - direction * dot(direction, d_direction)) / distance;
#else
    return vec3<f32>(0.0);
#endif
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rank = flat_group(group, groups) * 64u + lane;
    if rank >= view.gaussians {
        return;
    }
    let g = order[rank];
    let start = first_pair[g];
    let i = g - view.first;
    if g < view.first || i >= view.page || start < view.slot_first || start - view.slot_first >= view.slot_count {
        return;
    }
    let count = touched[g];
    if count == 0u {
#ifdef WITH_COLOR
        for (var c = 0u; c < FEATURE; c++) {
            put(c, i, 0.0);
        }
#ifdef WITH_SH
        for (var c = 0u; c < 3u * rest_of(view.sh_degree); c++) {
            put(SH_REST + c, i, 0.0);
        }
#endif
#endif
        put3(FEATURE, i, vec3<f32>(0.0));
        return;
    }
    // Sums of section 5.1 over all pixels:
    // (p dx, p dy, p dx^2, p dx dy) (p dy^2, p, dL/dr, dL/dg) (dL/db, dL/df).
    var sum0 = vec4<f32>(0.0);
    var sum1 = vec4<f32>(0.0);
    var sum2 = vec4<f32>(0.0);
    // After fold_slots, sums are in the first slot of the Gaussian and in the first slot of each
    // further run.
    let first = start - view.slot_first;
    let end = first + count;
    var e = first;
    while e < end {
#ifdef WITH_COLOR
        sum0 += slots[SLOT * e];
        sum1 += slots[SLOT * e + 1u];
#endif
        sum2 += slots[SLOT * e + SLOT - 1u];
#ifdef WIDE
        e++;
#else
        e = (e / view.fold + 1u) * view.fold;
#endif
    }
    // Depth moments are no trained values.
    let trains_depth = view.depth_as_feature == DEPTH_MOMENTS;
    put3(FEATURE, i, select(sum2.yzw, vec3<f32>(0.0), trains_depth));
#ifdef WITH_COLOR
    let mean = param3(MEAN, i);
    let s0 = splats[3u * g];
    let s1 = splats[3u * g + 1u];
    let d_mean_by_color = color_backward(i, mean, vec3<f32>(s1.zw, splats[3u * g + 2u].x), vec3<f32>(sum1.zw, sum2.x));

    // Section 5.3: the conic Q of the natural exponent, from the splat's base-2 exponent.
    let ln2 = 0.6931471805599453;
    let q_xx = -2.0 * ln2 * s0.z;
    let q_xy = -ln2 * s0.w;
    let q_yy = -2.0 * ln2 * s1.x;
    let d_center = vec2<f32>(q_xx * sum0.x + q_xy * sum0.y, q_xy * sum0.x + q_yy * sum0.y);
    // In half-image units, the threshold of density control does not depend on the resolution.
    // Gaussians are added where colours differ, not where depths do.
    if !trains_depth {
        stats[g] += length(d_center * 0.5 * vec2<f32>(view.size));
        stats[view.gaussians + g] += 1.0;
    }

    // dL/dQ = -1/2 sum p d d^T; dL/dcov = -(Q dL/dQ) Q.
    let d_q_xx = -0.5 * sum0.z;
    let d_q_xy = -0.5 * sum0.w;
    let d_q_yy = -0.5 * sum1.x;
    let qdq_xx = q_xx * d_q_xx + q_xy * d_q_xy;
    let qdq_xy = q_xx * d_q_xy + q_xy * d_q_yy;
    let qdq_yx = q_xy * d_q_xx + q_yy * d_q_xy;
    let qdq_yy = q_xy * d_q_xy + q_yy * d_q_yy;
    var d_cov_xx = -(qdq_xx * q_xx + qdq_xy * q_xy);
    var d_cov_xy = -(qdq_xx * q_xy + qdq_xy * q_yy);
    var d_cov_yy = -(qdq_yx * q_xy + qdq_yy * q_yy);

    let t = (view.world_to_camera * vec4<f32>(mean, 1.0)).xyz;
    let quaternion = vec4<f32>(param(ROTATION, i), param(ROTATION + 1u, i), param(ROTATION + 2u, i), param(ROTATION + 3u, i));
    let quaternion_length = max(length(quaternion), 1e-12);
    let unit = quaternion / quaternion_length;
    let r = rotation_matrix(unit);
    let s = exp(param3(LOG_SCALE, i));
    let jw = affine(t, view);
    let a_x = (jw.x * r) * s;
    let a_y = (jw.y * r) * s;
    let cov = dilated(a_x, a_y);
    // Section 5.2. Where opacity is clamped at ALPHA_MAX, only a gradient that lowers it passes.
    let opacity = 1.0 / (1.0 + exp(-param(OPACITY, i)));
    let dets = determinants(a_x, a_y);
    let clamped = kept_gain(view) * opacity * compensation(dets, view) >= ALPHA_MAX;
    let unclamped_opacity = select(1.0, 0.0, clamped && sum1.y < 0.0);
    put(OPACITY, i, sum1.y * (1.0 - opacity) * unclamped_opacity);
    if view.antialias == 1u && determinant_share(dets) > 1e-6 {
        // d log(compensation) / d cov = (inverse before dilation - inverse after it) / 2.
        let before = vec3<f32>(cov.x - DILATION, cov.y, cov.z - DILATION);
        let det = dets.x;
        let half = 0.5 * sum1.y * unclamped_opacity;
        d_cov_xx += half * (before.z / det - q_xx);
        d_cov_xy += half * (-before.y / det - q_xy);
        d_cov_yy += half * (before.x / det - q_yy);
    }
    // Section 5.4: cov = A A^T + dilation, A = (J W) M, M = R S.
    let d_a_x = 2.0 * (d_cov_xx * a_x + d_cov_xy * a_y);
    let d_a_y = 2.0 * (d_cov_xy * a_x + d_cov_yy * a_y);
    // Columns of dL/dM = (J W)^T dL/dA.
    let d_m0 = jw.x * d_a_x.x + jw.y * d_a_y.x;
    let d_m1 = jw.x * d_a_x.y + jw.y * d_a_y.y;
    let d_m2 = jw.x * d_a_x.z + jw.y * d_a_y.z;
    put3(LOG_SCALE, i, s * vec3<f32>(dot(r[0], d_m0), dot(r[1], d_m1), dot(r[2], d_m2)));

    // Columns of dL/dR, propagated to the quaternion and through its normalisation.
    let d_r0 = d_m0 * s.x;
    let d_r1 = d_m1 * s.y;
    let d_r2 = d_m2 * s.z;
    let w = unit.x;
    let x = unit.y;
    let y = unit.z;
    let z = unit.w;
    let d_unit = 2.0 * vec4<f32>(
        z * (d_r0.y - d_r1.x) + y * (d_r2.x - d_r0.z) + x * (d_r1.z - d_r2.y),
        y * (d_r0.y + d_r1.x) + z * (d_r0.z + d_r2.x) + w * (d_r1.z - d_r2.y) - 2.0 * x * (d_r1.y + d_r2.z),
        x * (d_r0.y + d_r1.x) + z * (d_r1.z + d_r2.y) + w * (d_r2.x - d_r0.z) - 2.0 * y * (d_r0.x + d_r2.z),
        x * (d_r0.z + d_r2.x) + y * (d_r1.z + d_r2.y) + w * (d_r0.y - d_r1.x) - 2.0 * z * (d_r0.x + d_r1.y),
    );
    let d_rotation = (d_unit - unit * dot(unit, d_unit)) / quaternion_length;
    put(ROTATION, i, d_rotation.x);
    put(ROTATION + 1u, i, d_rotation.y);
    put(ROTATION + 2u, i, d_rotation.z);
    put(ROTATION + 3u, i, d_rotation.w);

    // Section 5.5: the mean, through the projected centre and through J.
    let m0 = r[0] * s.x;
    let m1 = r[1] * s.y;
    let m2 = r[2] * s.z;
    let d_jw_x = m0 * d_a_x.x + m1 * d_a_x.y + m2 * d_a_x.z;
    let d_jw_y = m0 * d_a_y.x + m1 * d_a_y.y + m2 * d_a_y.z;
    let world = mat3x3<f32>(view.world_to_camera[0].xyz, view.world_to_camera[1].xyz, view.world_to_camera[2].xyz);
    // Rows of dL/dJ = (dL/dJW) W^T.
    let d_j_x = world * d_jw_x;
    let d_j_y = world * d_jw_y;
    let inverse_z = 1.0 / t.z;
    let slope = clamped_slope(t, view);
    let unclamped = select(vec2<f32>(0.0), vec2<f32>(1.0), slope == t.xy / t.z);
    // J = focal / z (1, 0, -slope.x; 0, 1, -slope.y); slope = xy / z where it is not clamped.
    var d_t = vec3<f32>(view.focal * inverse_z * d_center, -dot(view.focal * t.xy * inverse_z * inverse_z, d_center));
    let d_slope = -view.focal * inverse_z * vec2<f32>(d_j_x.z, d_j_y.z) * unclamped;
    d_t.x += d_slope.x * inverse_z;
    d_t.y += d_slope.y * inverse_z;
    d_t.z -= inverse_z * inverse_z * (dot(view.focal, vec2<f32>(d_j_x.x - slope.x * d_j_x.z, d_j_y.y - slope.y * d_j_y.z))) + inverse_z * inverse_z * dot(d_slope, t.xy);
    if trains_depth {
        // Section 5.7: through ln z and its square.
        d_t.z += (sum2.y + 2.0 * log(t.z) * sum2.z) * inverse_z;
    }
    put3(MEAN, i, transpose(world) * d_t + d_mean_by_color);
#endif
}
