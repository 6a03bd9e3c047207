use super::{CHUNKS, chunk};
use crate::view::Job;

/// Twin of `shaders/scan_apply.wgsl`.
pub fn scan_apply(job: &Job, items: &mut [u32], totals: &mut [u32]) {
    let mut sum = 0;
    for t in 0..CHUNKS {
        for i in chunk(job.n as usize, t) {
            let item = std::mem::replace(&mut items[i], sum);
            sum = u32::saturating_add(sum, item);
        }
    }
    totals[CHUNKS] = sum;
}
