use crate::view::Job;

/// Twin of `shaders/scan_apply.wgsl`.
pub fn scan_apply(job: &Job, items: &mut [u32], totals: &mut [u32]) {
    let mut sum = 0;
    for item in &mut items[..job.n as usize] {
        let own = std::mem::replace(item, sum);
        sum = u32::saturating_add(sum, own);
    }
    totals[job.chunks as usize] = sum;
}
