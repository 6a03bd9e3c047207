// Adam (Kingma & Ba 2015) over all trained values, with one learning rate a channel.
#import channels
#import flat

struct Step {
    n: u32,
    // 1 - beta^t of both moments.
    correction1: f32,
    correction2: f32,
    epsilon: f32,
    // Learning rates of the 17 channels, in fours.
    rates: array<vec4<f32>, 5>,
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read_write> params: array<f32>;
@group(0) @binding(3) var<storage, read_write> moment1: array<f32>;
@group(0) @binding(4) var<storage, read_write> moment2: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let k = flat_group(group, groups) * 64u + lane;
    if k >= CHANNELS * step.n {
        return;
    }
    let channel = k / step.n;
    let rate = step.rates[channel / 4u][channel % 4u];
    let g = gradients[k];
    let m1 = 0.9 * moment1[k] + 0.1 * g;
    let m2 = 0.999 * moment2[k] + 0.001 * g * g;
    moment1[k] = m1;
    moment2[k] = m2;
    params[k] -= rate * (m1 / step.correction1) / (sqrt(m2 / step.correction2) + step.epsilon);
}
