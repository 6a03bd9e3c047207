//! CPU twin of `shaders/fold_slots.wgsl`: partial sums of gradient slots.

use crate::View;
use crate::channels::Channels;

/// Adds up the slots of each Gaussian within runs of `view.fold_length` pairs, into its first slot
/// of the run. `slots` holds 12 floats for each pair of the window, or 4 with frozen geometry.
pub fn fold_slots(
    view: &View,
    channels: Channels,
    touched: &[u32],
    first_pair: &[u32],
    pair_gaussians: &[u32],
    slots: &mut [f32],
) {
    let floats = 4 * channels.slot();
    let window = (view.pairs - view.slot_first).min(view.slot_count + view.tile_count()) as usize;
    for start in (0..window).step_by(view.fold_length as usize) {
        let mut sum_slot: Option<(u32, usize)> = None;
        for e in start..window.min(start + view.fold_length as usize) {
            let g = pair_gaussians[view.slot_first as usize + e];
            if view.slot_first + e as u32 >= first_pair[g as usize] + touched[g as usize] {
                continue;
            }
            match sum_slot {
                Some((same, to)) if same == g => {
                    (0..floats).for_each(|k| slots[to * floats + k] += slots[e * floats + k])
                }
                _ => sum_slot = Some((g, e)),
            }
        }
    }
}
