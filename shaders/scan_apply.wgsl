// Second step of an exclusive prefix sum: replaces items by their prefix sums and writes the total
// to totals[chunks]. Each chunk sums the totals before it, which is cheaper than a third pass.
#import prefix
#import flat

@group(0) @binding(0) var<uniform> job: ChunkJob;
@group(0) @binding(1) var<storage, read_write> items: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

// Replaces the items of [start, end) by prefix sums that start at `sum`. Returns the sum after the
// last item.
fn replace(start: u32, end: u32, sum: u32) -> u32 {
    var before = sum;
    for (var i = start; i < end; i++) {
        let item = items[i];
        items[i] = before;
        before = saturating(before, item);
    }
    return before;
}

#ifdef WIDE
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let chunk = chunk_of(id.x, job);
    var sum = 0u;
    for (var t = 0u; t < chunk.plane_index; t++) {
        sum = saturating(sum, totals[t]);
    }
    sum = replace(chunk.start, chunk.end, sum);
    if chunk.plane_index == job.chunks - 1u {
        totals[job.chunks] = sum;
    }
}
#else
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let chunk = chunk_of(flat_group(group, groups), job);
    if chunk.plane_index >= job.chunks {
        return;
    }
    var sum = 0u;
    for (var t = lane; t < chunk.plane_index; t += 256u) {
        sum = saturating(sum, totals[t]);
    }
    let before = group_sum(sum, lane);
    // Each invocation has a contiguous part of the chunk.
    let length = (chunk.end - chunk.start + 255u) / 256u;
    let start = min(chunk.end, chunk.start + lane * length);
    let end = min(chunk.end, start + length);
    var own = 0u;
    for (var i = start; i < end; i++) {
        own = saturating(own, items[i]);
    }
    inclusive_scan(own, lane);
    // The sum before a part is the inclusive prefix sum of the previous invocation.
    var earlier = 0u;
    if lane > 0u {
        earlier = prefix_sums[lane - 1u];
    }
    let after = replace(start, end, saturating(before, earlier));
    if lane == 255u && chunk.plane_index == job.chunks - 1u {
        totals[job.chunks] = after;
    }
}
#endif
