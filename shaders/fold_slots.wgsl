// Adds up the gradient slots of each Gaussian within runs of `fold` pairs, into its first slot of
// the run. Without this pass, one invocation of project_backward would read thousands of slots of a
// large Gaussian in sequence.
#import view
#import flat
#import slot

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> touched: array<u32>;
@group(0) @binding(2) var<storage, read> first_pair: array<u32>;
@group(0) @binding(3) var<storage, read> pair_gaussians: array<u32>;
@group(0) @binding(4) var<storage, read_write> slots: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let run = flat_group(group, groups) * 64u + lane;
    // Number of slots in the window.
    let slots_of_window = min(view.pairs - view.slot_first, view.slot_count + view.tiles.x * view.tiles.y);
    let end = min(slots_of_window, (run + 1u) * view.fold);
    var e = run * view.fold;
    while e < end {
        let g = pair_gaussians[view.slot_first + e];
        let pairs_until = first_pair[g] + touched[g];
        let first_slot = e;
        e++;
        // Surplus pairs of emit have no gradient.
        if view.slot_first + first_slot >= pairs_until {
            continue;
        }
        let stop = min(end, pairs_until - view.slot_first);
        if e >= stop {
            continue;
        }
#each K 3
        var sum$K = vec4<f32>(0.0);
#end
        for (e = first_slot; e < stop; e++) {
#ifdef WITH_COLOR
            sum0 += slots[SLOT * e];
            sum1 += slots[SLOT * e + 1u];
#endif
            sum2 += slots[SLOT * e + SLOT - 1u];
        }
#ifdef WITH_COLOR
        slots[SLOT * first_slot] = sum0;
        slots[SLOT * first_slot + 1u] = sum1;
#endif
        slots[SLOT * first_slot + SLOT - 1u] = sum2;
    }
}
