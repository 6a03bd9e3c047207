// Histogram of one 8-bit digit for each chunk: histogram [256][CHUNKS].
#import chunks

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> histogram: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let t = id.x;
    for (var d = 0u; d < 256u; d++) {
        histogram[d * CHUNKS + t] = 0u;
    }
    let length = chunk_length(job.n);
    let end = min(job.n, (t + 1u) * length);
    for (var i = t * length; i < end; i++) {
        let d = (keys[i] >> job.shift) & 255u;
        histogram[d * CHUNKS + t] += 1u;
    }
}
