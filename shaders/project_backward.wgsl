// Sums each Gaussian's gradient slots and carries them through the projection to the trained values.
//
// Invocations take the Gaussians in depth order: neighbours then touch about as many tiles, and their slots lie in a row.
//
// gradients [page]  dL/d(params), laid out like them; channels that are not trained are left alone
// stats     [2][n]  += norm of the 2-D mean's gradient (in half-image units), += 1 when drawn
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

// Colour's gradient to the SH coefficients; returns what it asks of the mean, which turns the viewing direction.
fn color_backward(i: u32, mean: vec3<f32>, splat_color: vec3<f32>, gradient: vec3<f32>) -> vec3<f32> {
    // Colour is cut off at 0 from below.
    let d = select(vec3<f32>(0.0), gradient, splat_color > vec3<f32>(0.0));
    put3(COLOR, i, SH_C0 * d);
#ifdef WITH_SH
    let ray = mean - view.camera.xyz;
    let distance = length(ray);
    let direction = ray / distance;
    let b = basis(direction);
    let slopes = basis_slopes(direction);
    let rest = rest_of(view.sh_degree);
    var d_direction = vec3<f32>(0.0);
    // Written out, so that the basis stays in registers.
#each K 15
    if $Ku < rest {
        put3(SH_REST + 3u * $Ku, i, b[$K] * d);
        d_direction += dot(param3(SH_REST + 3u * $Ku, i), d) * slopes[$K];
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
    var a = vec4<f32>(0.0);
    var b = vec4<f32>(0.0);
    var c = vec4<f32>(0.0);
    for (var e = start - view.slot_first; e < start - view.slot_first + count; e++) {
#ifdef WITH_COLOR
        a += slots[SLOT * e];
        b += slots[SLOT * e + 1u];
#endif
        c += slots[SLOT * e + SLOT - 1u];
    }
    put3(FEATURE, i, c.yzw);
#ifdef WITH_COLOR
    let mean = param3(MEAN, i);
    let s0 = splats[3u * g];
    let s1 = splats[3u * g + 1u];
    let d_mean_by_color = color_backward(i, mean, vec3<f32>(s1.zw, splats[3u * g + 2u].x), vec3<f32>(b.zw, c.x));

    // Conic (natural exponent) from the base-2 exponent.
    let ln2 = 0.6931471805599453;
    let qa = -2.0 * ln2 * s0.z;
    let qb = -ln2 * s0.w;
    let qc = -2.0 * ln2 * s1.x;
    let d_mean = vec2<f32>(qa * a.x + qb * a.y, qb * a.x + qc * a.y);
    // Half-image units make the threshold of density control independent of the resolution.
    stats[g] += length(d_mean * 0.5 * vec2<f32>(view.size));
    stats[view.gaussians + g] += 1.0;

    // dL/dQ = -1/2 sum p d d^T; dL/dcov = -Q (dL/dQ) Q.
    let dq_xx = -0.5 * a.z;
    let dq_xy = -0.5 * a.w;
    let dq_yy = -0.5 * b.x;
    let mxx = qa * dq_xx + qb * dq_xy;
    let mxy = qa * dq_xy + qb * dq_yy;
    let myx = qb * dq_xx + qc * dq_xy;
    let myy = qb * dq_xy + qc * dq_yy;
    var gxx = -(mxx * qa + mxy * qb);
    var gxy = -(mxx * qb + mxy * qc);
    var gyy = -(myx * qb + myy * qc);

    let t = (view.world_to_camera * vec4<f32>(mean, 1.0)).xyz;
    let q = vec4<f32>(param(ROTATION, i), param(ROTATION + 1u, i), param(ROTATION + 2u, i), param(ROTATION + 3u, i));
    let q_length = max(length(q), 1e-12);
    let unit = q / q_length;
    let r = rotation_matrix(unit);
    let s = exp(param3(LOG_SCALE, i));
    let jw = affine(t, view);
    let ax = (jw.x * r) * s;
    let ay = (jw.y * r) * s;
    let cov = dilated(ax, ay);
    // Opacity is clamped at ALPHA_MAX from above.
    let whole_opacity = 1.0 / (1.0 + exp(-param(OPACITY, i)));
    let free_opacity = select(0.0, 1.0, whole_opacity * compensation(cov, view) < ALPHA_MAX);
    put(OPACITY, i, b.y * (1.0 - whole_opacity) * free_opacity);
    if view.antialias == 1u && determinant_share(cov) > 1e-6 {
        // d log(compensation) / d cov = (inverse before dilation - inverse after it) / 2.
        let before = vec3<f32>(cov.x - DILATION, cov.y, cov.z - DILATION);
        let det = before.x * before.z - before.y * before.y;
        let half = 0.5 * b.y * free_opacity;
        gxx += half * (before.z / det - qa);
        gxy += half * (-before.y / det - qb);
        gyy += half * (before.x / det - qc);
    }
    // cov = A A^T, A = (J W) (R S).
    let d_ax = 2.0 * (gxx * ax + gxy * ay);
    let d_ay = 2.0 * (gxy * ax + gyy * ay);
    // d(R S)[:, k] = jw.x d_ax[k] + jw.y d_ay[k].
    let v0 = jw.x * d_ax.x + jw.y * d_ay.x;
    let v1 = jw.x * d_ax.y + jw.y * d_ay.y;
    let v2 = jw.x * d_ax.z + jw.y * d_ay.z;
    put3(LOG_SCALE, i, s * vec3<f32>(dot(r[0], v0), dot(r[1], v1), dot(r[2], v2)));

    // Rotation: columns of dL/dR, then through the quaternion and its normalisation.
    let r0 = v0 * s.x;
    let r1 = v1 * s.y;
    let r2 = v2 * s.z;
    let w = unit.x;
    let x = unit.y;
    let y = unit.z;
    let z = unit.w;
    let d_unit = 2.0 * vec4<f32>(
        z * (r0.y - r1.x) + y * (r2.x - r0.z) + x * (r1.z - r2.y),
        y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r1.z - r2.y) - 2.0 * x * (r1.y + r2.z),
        x * (r0.y + r1.x) + z * (r1.z + r2.y) + w * (r2.x - r0.z) - 2.0 * y * (r0.x + r2.z),
        x * (r0.z + r2.x) + y * (r1.z + r2.y) + w * (r0.y - r1.x) - 2.0 * z * (r0.x + r1.y),
    );
    let d_rotation = (d_unit - unit * dot(unit, d_unit)) / q_length;
    put(ROTATION, i, d_rotation.x);
    put(ROTATION + 1u, i, d_rotation.y);
    put(ROTATION + 2u, i, d_rotation.z);
    put(ROTATION + 3u, i, d_rotation.w);

    // Mean: through the projected centre and through J.
    let rs0 = r[0] * s.x;
    let rs1 = r[1] * s.y;
    let rs2 = r[2] * s.z;
    let d_jwx = rs0 * d_ax.x + rs1 * d_ax.y + rs2 * d_ax.z;
    let d_jwy = rs0 * d_ay.x + rs1 * d_ay.y + rs2 * d_ay.z;
    let world = mat3x3<f32>(view.world_to_camera[0].xyz, view.world_to_camera[1].xyz, view.world_to_camera[2].xyz);
    // Rows of dL/dJ = (dL/dJW) W^T.
    let d_jx = world * d_jwx;
    let d_jy = world * d_jwy;
    let inv = 1.0 / t.z;
    let slope = clamped_slope(t, view);
    let free = select(vec2<f32>(0.0), vec2<f32>(1.0), slope == t.xy / t.z);
    // J = focal / z (1, 0, -slope.x; 0, 1, -slope.y); slope = xy / z where it is not clamped.
    var d_t = vec3<f32>(view.focal * inv * d_mean, -dot(view.focal * t.xy * inv * inv, d_mean));
    let d_slope = -view.focal * inv * vec2<f32>(d_jx.z, d_jy.z) * free;
    d_t.x += d_slope.x * inv;
    d_t.y += d_slope.y * inv;
    d_t.z -= inv * inv * (dot(view.focal, vec2<f32>(d_jx.x - slope.x * d_jx.z, d_jy.y - slope.y * d_jy.z))) + inv * inv * dot(d_slope, t.xy);
    put3(MEAN, i, transpose(world) * d_t + d_mean_by_color);
#endif
}
