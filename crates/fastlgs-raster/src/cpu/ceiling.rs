use crate::view::Ceiling;

/// Chains of fused multiply-adds on four values each.
pub(crate) const CHAINS: usize = 8;

/// Twin of `shaders/ceiling.wgsl`.
pub fn ceiling(job: &Ceiling, out: &mut [f32]) {
    for id in 0..job.invocations {
        let chain = |k: usize| {
            let mut v = (id & 63) as f32 + k as f32;
            (0..job.rounds).for_each(|_| v = v.mul_add(job.factor, job.summand));
            v
        };
        out[id as usize] = 4.0 * (0..CHAINS).map(chain).sum::<f32>();
    }
}
