use super::{CHUNKS, chunk};
use crate::view::Job;

/// Twin of `shaders/radix_count.wgsl`.
pub fn radix_count(job: &Job, keys: &[u32], histogram: &mut [u32]) {
    histogram[..256 * CHUNKS].fill(0);
    for t in 0..CHUNKS {
        for i in chunk(job.n as usize, t) {
            histogram[((keys[i] >> job.shift) & 255) as usize * CHUNKS + t] += 1;
        }
    }
}
