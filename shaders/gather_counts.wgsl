// Writes tile counts in depth order, so that their prefix sum numbers the (tile, Gaussian) pairs
// front to back.
#import view
#import flat

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> touched: array<u32>;
@group(0) @binding(3) var<storage, read_write> offsets: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rank = flat_group(group, groups) * 64u + lane;
    if rank < view.gaussians {
        offsets[rank] = touched[order[rank]];
    }
}
