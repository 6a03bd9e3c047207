// Sums each Gaussian's gradient slots and carries them through the projection to the trained values.
//
// gradients [CHANNELS][n]  dL/d(params)
// stats     [2][n]         += norm of the 2-D mean's gradient (in half-image units), += 1 when drawn
#import view
#import channels
#import covariance
#import flat

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> touched: array<u32>;
@group(0) @binding(4) var<storage, read> first_pair: array<u32>;
@group(0) @binding(5) var<storage, read> slots: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(7) var<storage, read_write> stats: array<f32>;

fn param3(channel: u32, i: u32) -> vec3<f32> {
    let n = view.gaussians;
    return vec3<f32>(params[channel * n + i], params[(channel + 1u) * n + i], params[(channel + 2u) * n + i]);
}

fn put3(channel: u32, i: u32, value: vec3<f32>) {
    let n = view.gaussians;
    gradients[channel * n + i] = value.x;
    gradients[(channel + 1u) * n + i] = value.y;
    gradients[(channel + 2u) * n + i] = value.z;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = flat_group(group, groups) * 64u + lane;
    let n = view.gaussians;
    if i >= n {
        return;
    }
    let count = touched[i];
    if count == 0u {
        for (var c = 0u; c < CHANNELS; c++) {
            gradients[c * n + i] = 0.0;
        }
        return;
    }
    var a = vec4<f32>(0.0);
    var b = vec4<f32>(0.0);
    var c = vec4<f32>(0.0);
    for (var e = first_pair[i]; e < first_pair[i] + count; e++) {
        a += slots[3u * e];
        b += slots[3u * e + 1u];
        c += slots[3u * e + 2u];
    }

    // Colour is clamped at 0 from below.
    let raw = vec3<f32>(0.5) + SH_C0 * param3(COLOR, i);
    put3(COLOR, i, select(vec3<f32>(0.0), SH_C0 * vec3<f32>(b.zw, c.x), raw > vec3<f32>(0.0)));
    put3(FEATURE, i, c.yzw);
    let s0 = splats[3u * i];
    let s1 = splats[3u * i + 1u];
    // Opacity is clamped at ALPHA_MAX from above.
    let opacity = s1.y;
    gradients[OPACITY * n + i] = select(0.0, b.y * opacity * (1.0 - opacity), opacity < ALPHA_MAX);

    // Conic (natural exponent) from the base-2 exponent.
    let ln2 = 0.6931471805599453;
    let qa = -2.0 * ln2 * s0.z;
    let qb = -ln2 * s0.w;
    let qc = -2.0 * ln2 * s1.x;
    let d_mean = vec2<f32>(qa * a.x + qb * a.y, qb * a.x + qc * a.y);
    // Half-image units make the threshold of density control independent of the resolution.
    stats[i] += length(d_mean * 0.5 * vec2<f32>(view.size));
    stats[n + i] += 1.0;

    // dL/dQ = -1/2 sum p d d^T; dL/dcov = -Q (dL/dQ) Q.
    let dq_xx = -0.5 * a.z;
    let dq_xy = -0.5 * a.w;
    let dq_yy = -0.5 * b.x;
    let mxx = qa * dq_xx + qb * dq_xy;
    let mxy = qa * dq_xy + qb * dq_yy;
    let myx = qb * dq_xx + qc * dq_xy;
    let myy = qb * dq_xy + qc * dq_yy;
    let gxx = -(mxx * qa + mxy * qb);
    let gxy = -(mxx * qb + mxy * qc);
    let gyy = -(myx * qb + myy * qc);

    let t = (view.world_to_camera * vec4<f32>(param3(MEAN, i), 1.0)).xyz;
    let q = vec4<f32>(params[ROTATION * n + i], params[(ROTATION + 1u) * n + i], params[(ROTATION + 2u) * n + i], params[(ROTATION + 3u) * n + i]);
    let q_length = max(length(q), 1e-12);
    let unit = q / q_length;
    let r = rotation_matrix(unit);
    let s = exp(param3(LOG_SCALE, i));
    let jw = affine(t, view);
    let ax = (jw.x * r) * s;
    let ay = (jw.y * r) * s;
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
    gradients[ROTATION * n + i] = d_rotation.x;
    gradients[(ROTATION + 1u) * n + i] = d_rotation.y;
    gradients[(ROTATION + 2u) * n + i] = d_rotation.z;
    gradients[(ROTATION + 3u) * n + i] = d_rotation.w;

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
    put3(MEAN, i, transpose(world) * d_t);
}
