// First step of an exclusive prefix sum: total of each chunk.
#import chunks

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> items: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let length = chunk_length(job.n);
    let end = min(job.n, (id.x + 1u) * length);
    var sum = 0u;
    for (var i = id.x * length; i < end; i++) {
        sum = saturating(sum, items[i]);
    }
    totals[id.x] = sum;
}
