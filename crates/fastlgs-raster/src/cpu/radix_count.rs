//! CPU twin of `shaders/radix_count.wgsl`: histograms of a radix sort.

use super::chunks;
use crate::view::ChunkJob;

/// Counts the values of one 8-bit digit in each chunk: `histogram` `[256][chunks]`.
pub fn radix_count(job: &ChunkJob, keys: &[u32], histogram: &mut [u32]) {
    let count = job.chunks as usize;
    histogram[..256 * count].fill(0);
    for (t, chunk) in chunks(job).enumerate() {
        for i in chunk {
            histogram[((keys[i] >> job.shift) & 255) as usize * count + t] += 1;
        }
    }
}
