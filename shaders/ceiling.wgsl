// What the adapter can do at best: chains of fused multiply-adds on registers, nothing else.
//
// out [invocations]  a value that depends on all of them
struct Ceiling {
    invocations: u32,
    // Rounds of CHAINS fused multiply-adds on four values each.
    rounds: u32,
    factor: f32,
    summand: f32,
}

@group(0) @binding(0) var<uniform> job: Ceiling;
@group(0) @binding(1) var<storage, read_write> out: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= job.invocations {
        return;
    }
    let a = vec4<f32>(job.factor);
    let b = vec4<f32>(job.summand);
#each K 8
    var v$K = vec4<f32>(f32(id.x & 63u) + $K.0);
#end
    for (var k = 0u; k < job.rounds; k++) {
#each K 8
        v$K = fma(v$K, a, b);
#end
    }
    let sum = ((v0 + v1) + (v2 + v3)) + ((v4 + v5) + (v6 + v7));
    out[id.x] = (sum.x + sum.y) + (sum.z + sum.w);
}
