//! CPU twin of `shaders/radix_scatter.wgsl`: one digit of a radix sort.

use super::chunks;
use crate::view::ChunkJob;

/// Moves keys and values to their sorted positions for one digit. Keys with equal digits keep their
/// order.
pub fn radix_scatter(
    job: &ChunkJob,
    keys: &[u32],
    values: &[u32],
    histogram: &[u32],
    keys_out: &mut [u32],
    values_out: &mut [u32],
) {
    for (t, chunk) in chunks(job).enumerate() {
        let mut next: Vec<usize> = histogram[t..]
            .iter()
            .step_by(job.chunks as usize)
            .take(256)
            .map(|to| *to as usize)
            .collect();
        for i in chunk {
            let to = &mut next[((keys[i] >> job.shift) & 255) as usize];
            keys_out[*to] = keys[i];
            values_out[*to] = if job.first == 1 { i as u32 } else { values[i] };
            *to += 1;
        }
    }
}
