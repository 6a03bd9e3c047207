use super::{CHUNKS, chunk};
use crate::view::Job;

/// Twin of `shaders/scan_chunks.wgsl`.
pub fn scan_chunks(job: &Job, items: &[u32], totals: &mut [u32]) {
    for t in 0..CHUNKS {
        totals[t] = items[chunk(job.n as usize, t)].iter().fold(0, |sum: u32, item| sum.saturating_add(*item));
    }
}
