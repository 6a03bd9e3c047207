//! CPU twin of `shaders/scan_chunks.wgsl`: first step of a prefix sum.

use super::chunks;
use crate::view::ChunkJob;

/// Writes the sum of each chunk to `totals`. Sums saturate.
pub fn scan_chunks(job: &ChunkJob, items: &[u32], totals: &mut [u32]) {
    for (total, chunk) in totals.iter_mut().zip(chunks(job)) {
        *total = items[chunk]
            .iter()
            .fold(0, |sum: u32, item| sum.saturating_add(*item));
    }
}
