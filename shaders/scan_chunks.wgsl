// First step of an exclusive prefix sum: the total of each chunk.
#import prefix
#import flat

@group(0) @binding(0) var<uniform> job: ChunkJob;
@group(0) @binding(1) var<storage, read> items: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

#ifdef WIDE
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let chunk = chunk_of(id.x, job);
    var sum = 0u;
    for (var i = chunk.start; i < chunk.end; i++) {
        sum = saturating(sum, items[i]);
    }
    totals[chunk.plane_index] = sum;
}
#else
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let chunk = chunk_of(flat_group(group, groups), job);
    var sum = 0u;
    for (var i = chunk.start + lane; i < chunk.end; i += 256u) {
        sum = saturating(sum, items[i]);
    }
    let all = group_sum(sum, lane);
    if lane == 0u && chunk.plane_index < job.chunks {
        totals[chunk.plane_index] = all;
    }
}
#endif
