use crate::View;

/// Twin of `shaders/gather_counts.wgsl`.
pub fn gather_counts(view: &View, order: &[u32], touched: &[u32], offsets: &mut [u32]) {
    for rank in 0..view.gaussians as usize {
        offsets[rank] = touched[order[rank] as usize];
    }
}
