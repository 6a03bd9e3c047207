// Counts the values of one 8-bit digit in each chunk: histogram [256][chunks].
#import chunks
#import flat

@group(0) @binding(0) var<uniform> job: ChunkJob;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> histogram: array<u32>;

#ifdef WIDE
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let chunk = chunk_of(id.x, job);
    for (var d = 0u; d < 256u; d++) {
        histogram[d * job.chunks + chunk.plane_index] = 0u;
    }
    for (var i = chunk.start; i < chunk.end; i++) {
        histogram[digit_of(keys[i], job) * job.chunks + chunk.plane_index] += 1u;
    }
}
#else
var<workgroup> counts: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let chunk = chunk_of(flat_group(group, groups), job);
    atomicStore(&counts[lane], 0u);
    workgroupBarrier();
    for (var i = chunk.start + lane; i < chunk.end; i += 256u) {
        atomicAdd(&counts[digit_of(keys[i], job)], 1u);
    }
    workgroupBarrier();
    if chunk.plane_index < job.chunks {
        histogram[lane * job.chunks + chunk.plane_index] = atomicLoad(&counts[lane]);
    }
}
#endif
