// Moves each (key, value) to its place for one digit; stable. `histogram` holds exclusive prefix sums on entry.
#import chunks

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let t = id.x;
    let length = chunk_length(job.n);
    let end = min(job.n, (t + 1u) * length);
    for (var i = t * length; i < end; i++) {
        let key = keys[i];
        let slot = ((key >> job.shift) & 255u) * CHUNKS + t;
        let to = histogram[slot];
        histogram[slot] = to + 1u;
        keys_out[to] = key;
        values_out[to] = select(values[i], i, job.first == 1u);
    }
}
