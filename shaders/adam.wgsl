// Adam (Kingma & Ba 2015) on the trained values, with a learning rate for each channel, and a
// penalty on opacity. Works on one page (shared/channels.wgsl); an invocation updates four
// Gaussians.
#import channels
#import flat

struct Step {
    // Stride of the page's channels, in vec4s.
    quads: u32,
    // 1 - beta^t of the first and of the second moment.
    correction1: f32,
    correction2: f32,
    epsilon: f32,
    // First trained channel, and the end (excluded).
    first_channel: u32,
    end_channel: u32,
    // Weight of the sum of opacities in the loss.
    opacity_weight: f32,
    // Number of first Gaussians of the page that do not change.
    frozen: u32,
    // Learning rates of the channels below SH_REST, then one for all SH coefficients above degree
    // 0.
    rates: array<vec4<f32>, 5>,
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> gradients: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> params: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> moment1: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> moment2: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = flat_group(group, groups) * 64u + lane;
    if i >= step.quads {
        return;
    }
    let moves = vec4<u32>(4u * i) + vec4<u32>(0u, 1u, 2u, 3u) >= vec4<u32>(step.frozen);
    for (var channel = step.first_channel; channel < step.end_channel; channel++) {
        let k = channel * step.quads + i;
        let slot = min(channel, SH_REST);
        let rate = step.rates[slot / 4u][slot % 4u];
        let value = params[k];
        var g = gradients[k];
        if channel == OPACITY {
            let opacity = 1.0 / (1.0 + exp(-value));
            g += step.opacity_weight * opacity * (1.0 - opacity);
        }
        let m1 = 0.9 * moment1[k] + 0.1 * g;
        let m2 = 0.999 * moment2[k] + 0.001 * g * g;
        moment1[k] = select(moment1[k], m1, moves);
        moment2[k] = select(moment2[k], m2, moves);
        let next = value - rate * (m1 / step.correction1) / (sqrt(m2 / step.correction2) + step.epsilon);
        // Codes lie in (0, 1)^3 (paper). Without the clamp, a nearly invisible Gaussian would leave
        // this range to compensate others.
        let is_feature = channel >= FEATURE && channel < SH_REST;
        let in_range = select(next, clamp(next, vec4(0.0), vec4(1.0)), is_feature);
        params[k] = select(value, in_range, moves);
    }
}
