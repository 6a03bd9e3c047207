// Projects every Gaussian: its splat (input of blending), depth key and number of tiles it touches.
//
// params  [page]            trained values: shared/channels.wgsl
// splats  [n][3] vec4       (mean.xy, q.xy) (q.z, log2 of opacity, r, g) (b, f0, f1, f2);
//                           q: base-2 exponent q.x dx^2 + q.y dx dy + q.z dy^2
// depths  [n]               24-bit key, ascending with depth
// footprints [n][2] vec4    the tiles it may touch: shared/footprint.wgsl
// touched [n]               number of tiles; 0 for Gaussians that are not drawn
#import view
#import channels
#import harmonics
#import covariance
#import flat
#import footprint
#import random

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read_write> splats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> depths: array<u32>;
@group(0) @binding(4) var<storage, read_write> footprints: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> touched: array<u32>;

fn param(channel: u32, i: u32) -> f32 {
    return params[channel * stride(view.page) + i];
}

fn param3(channel: u32, i: u32) -> vec3<f32> {
    return vec3<f32>(param(channel, i), param(channel + 1u, i), param(channel + 2u, i));
}

// Returns the colour before it is clamped at 0.
fn color_of(i: u32, mean: vec3<f32>) -> vec3<f32> {
    var color = vec3<f32>(0.5) + SH_C0 * param3(COLOR, i);
#ifdef WITH_SH
    let b = basis(normalize(mean - view.camera.xyz));
    let rest = rest_of(view.sh_degree);
    // Unrolled, so that the basis stays in registers.
#each K 15
    if $Ku < rest {
        color += b[$K] * param3(SH_REST + 3u * $Ku, i);
    }
#end
#endif
    return color;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = flat_group(group, groups) * 64u + lane;
    if i >= view.page {
        return;
    }
    // Index among all Gaussians.
    let g = view.first + i;
    depths[g] = 0xffffffu;
    touched[g] = 0u;
    if pcg3d(vec3<u32>(g, view.draw, 2u)).x < view.dropped {
        return;
    }
    let mean = param3(MEAN, i);
    let t = (view.world_to_camera * vec4<f32>(mean, 1.0)).xyz;
    let s = exp(param3(LOG_SCALE, i));
    // The negation also rejects a NaN.
    if !(t.z > NEAR * length(s)) {
        return;
    }
    let q = vec4<f32>(param(ROTATION, i), param(ROTATION + 1u, i), param(ROTATION + 2u, i), param(ROTATION + 3u, i));
    let r = rotation_matrix(q / max(length(q), 1e-12));
    let jw = affine(t, view);
    // A = J W R S, so that the covariance is A A^T.
    let ax = (jw.x * r) * s;
    let ay = (jw.y * r) * s;
    let cov = dilated(ax, ay);
    let cxx = cov.x;
    let cxy = cov.y;
    let cyy = cov.z;
    let dets = determinants(ax, ay);
    let det = dets.y;
    let logit = param(OPACITY, i);
    let own = select(1.0 / (1.0 + exp(-logit)), SOLID, view.solid == 1u && logit <= CLEAR);
    let opacity = kept_gain(view) * compensation(dets, view) * own;
    if !(opacity >= ALPHA_MIN) {
        return;
    }
    let center = view.focal * t.xy / t.z + view.centre;
    // Squared Mahalanobis radius of the ellipse on which alpha equals ALPHA_MIN, slightly enlarged
    // so that rounding loses no pixel.
    let reach2 = 2.002 * log(opacity / ALPHA_MIN) + 1e-4;
    let half_height = sqrt(reach2 * cyy);
    let finite = det > 0.0 && det < 1e30 && abs(center.x) < 1e9 && abs(center.y) < 1e9 && half_height < 1e9 && cxx < 1e15;
    if !finite {
        return;
    }
    let f0 = vec4<f32>(center, cxy / cyy, det / (cyy * cyy));
    let rows = f32(view.tiles.y);
    let first_row = clamp(ceil((center.y - half_height + 0.5) / f32(TILE)) - 1.0, 0.0, rows);
    let end_row = clamp(floor((center.y + half_height - 0.5) / f32(TILE)) + 1.0, 0.0, rows);
    let f1 = vec4<f32>(reach2 * cyy, sqrt(reach2 / cxx) * cxy, first_row, end_row);
    var count = 0u;
    for (var row = u32(first_row); row < u32(end_row); row++) {
        let span = footprint_span(f0, f1, row, view.tiles.x);
        count += span.y - span.x;
    }
    if count == 0u {
        return;
    }
    let color = max(color_of(i, mean), vec3<f32>(0.0));
    var feature = param3(FEATURE, i);
    if view.depth_as_feature == 1u {
        feature = vec3<f32>(t.z, 0.0, 0.0);
    } else if view.depth_as_feature == DEPTH_MOMENTS {
        let log_z = log(t.z);
        feature = vec3<f32>(log_z, log_z * log_z, 1.0);
    }
    let log2e = 1.4426950408889634;
    let conic = vec3<f32>(cyy, -cxy, cxx) / det;
    splats[3u * g] = vec4<f32>(center, -0.5 * log2e * conic.x, -log2e * conic.y);
    splats[3u * g + 1u] = vec4<f32>(-0.5 * log2e * conic.z, log2(min(opacity, ALPHA_MAX)), color.r, color.g);
    splats[3u * g + 2u] = vec4<f32>(color.b, feature);
    // The bits of positive floats ascend with their values. The sign and the last 7 bits are
    // dropped.
    depths[g] = min(bitcast<u32>(t.z) >> 7u, 0xfffffeu);
    footprints[2u * g] = f0;
    footprints[2u * g + 1u] = f1;
    touched[g] = count;
}
