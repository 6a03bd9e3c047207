use super::{CHUNKS, chunk};
use crate::view::Job;

/// Twin of `shaders/radix_scatter.wgsl`.
pub fn radix_scatter(job: &Job, keys: &[u32], values: &[u32], histogram: &mut [u32], keys_out: &mut [u32], values_out: &mut [u32]) {
    for t in 0..CHUNKS {
        for i in chunk(job.n as usize, t) {
            let slot = &mut histogram[((keys[i] >> job.shift) & 255) as usize * CHUNKS + t];
            let to = *slot as usize;
            *slot += 1;
            keys_out[to] = keys[i];
            values_out[to] = if job.first == 1 { i as u32 } else { values[i] };
        }
    }
}
