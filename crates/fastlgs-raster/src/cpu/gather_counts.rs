//! CPU twin of `shaders/gather_counts.wgsl`: tile counts in depth order.

use crate::View;

/// Writes the tile counts of all Gaussians in depth order to `offsets`.
pub fn gather_counts(view: &View, order: &[u32], touched: &[u32], offsets: &mut [u32]) {
    for rank in 0..view.gaussians as usize {
        offsets[rank] = touched[order[rank] as usize];
    }
}
