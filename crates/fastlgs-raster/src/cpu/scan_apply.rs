//! CPU twin of `shaders/scan_apply.wgsl`: second step of a prefix sum.

use crate::view::ChunkJob;

/// Replaces items by their exclusive prefix sums. `totals[chunks]` receives the total. Sums
/// saturate.
pub fn scan_apply(job: &ChunkJob, items: &mut [u32], totals: &mut [u32]) {
    let mut sum = 0;
    for item in &mut items[..job.n as usize] {
        let own = std::mem::replace(item, sum);
        sum = u32::saturating_add(sum, own);
    }
    totals[job.chunks as usize] = sum;
}
