// Noise of MCMC (Kheradmand et al. 2024, eq. 9): moves the means of faint Gaussians along their covariance.
// Works on one page; shared/channels.wgsl.
#import channels
#import random
#import rotation
#import flat

struct Perturb {
    // Gaussians of the page, and the first of them.
    n: u32,
    first: u32,
    // Number of this step in the run's random sequence.
    seed: u32,
    // Noise scale times the means' learning rate.
    amount: f32,
}

@group(0) @binding(0) var<uniform> job: Perturb;
@group(0) @binding(1) var<storage, read_write> params: array<f32>;

// Uniform in (0, 1).
fn uniforms(words: vec3<u32>) -> vec3<f32> {
    return (vec3<f32>(words >> vec3<u32>(9u)) + 0.5) / 8388608.0;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = flat_group(group, groups) * 64u + lane;
    if i >= job.n {
        return;
    }
    let n = stride(job.n);
    // Box and Muller.
    let u = uniforms(pcg3d(vec3<u32>(job.first + i, job.seed, 0u)));
    let v = uniforms(pcg3d(vec3<u32>(job.first + i, job.seed, 1u)));
    let normal = sqrt(-2.0 * log(u)) * cos(6.2831853 * v);
    let opacity = 1.0 / (1.0 + exp(-params[OPACITY * n + i]));
    let faint = 1.0 / (1.0 + exp(100.0 * (opacity - 0.005)));
    let q = vec4<f32>(params[ROTATION * n + i], params[(ROTATION + 1u) * n + i], params[(ROTATION + 2u) * n + i], params[(ROTATION + 3u) * n + i]);
    let r = rotation_matrix(q / max(length(q), 1e-12));
    let s = exp(vec3<f32>(params[LOG_SCALE * n + i], params[(LOG_SCALE + 1u) * n + i], params[(LOG_SCALE + 2u) * n + i]));
    let offset = job.amount * faint * (r * (s * s * (transpose(r) * normal)));
    params[MEAN * n + i] += offset.x;
    params[(MEAN + 1u) * n + i] += offset.y;
    params[(MEAN + 2u) * n + i] += offset.z;
}
