use super::chunks;
use crate::view::Job;

/// Twin of `shaders/radix_count.wgsl`.
pub fn radix_count(job: &Job, keys: &[u32], histogram: &mut [u32]) {
    let count = job.chunks as usize;
    histogram[..256 * count].fill(0);
    for (t, chunk) in chunks(job).enumerate() {
        for i in chunk {
            histogram[((keys[i] >> job.shift) & 255) as usize * count + t] += 1;
        }
    }
}
