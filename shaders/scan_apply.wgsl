// Second step: replaces items by their exclusive prefix sums; the grand total goes to totals[CHUNKS].
// Each invocation adds up the totals before it: cheaper than a third pass.
#import chunks

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read_write> items: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let length = chunk_length(job.n);
    let end = min(job.n, (id.x + 1u) * length);
    var sum = 0u;
    for (var t = 0u; t < id.x; t++) {
        sum = saturating(sum, totals[t]);
    }
    for (var i = id.x * length; i < end; i++) {
        let item = items[i];
        items[i] = sum;
        sum = saturating(sum, item);
    }
    if id.x == CHUNKS - 1u {
        totals[CHUNKS] = sum;
    }
}
