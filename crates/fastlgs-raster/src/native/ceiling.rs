//! What the processor can do at best: chains of multiply-adds in vector registers, on all threads.

use super::simd::{madd, vectorised};
use rayon::prelude::*;
use std::time::Instant;

/// Independent vectors of sixteen values that are multiplied and added to.
type Chains = [[f32; 16]; 8];

vectorised! {
    /// Some thousand rounds on `chains`.
    fn rounds(chains: &mut Chains) = rounds_body
}

const ROUNDS: usize = 100_000;

#[inline(always)]
fn rounds_body<const FMA: bool>(chains: &mut Chains) {
    let (a, b): (f32, f32) = (std::hint::black_box(0.999), std::hint::black_box(0.001));
    // Element by element over all chains: one long loop that becomes whole vectors.
    let flat = chains.as_flattened_mut();
    for part in flat.chunks_exact_mut(64) {
        let mut local: [f32; 64] = std::array::from_fn(|i| part[i]);
        for _ in 0..ROUNDS {
            for i in 0..64 {
                local[i] = madd::<FMA>(local[i], a, b);
            }
        }
        part.copy_from_slice(&local);
    }
}

/// Floating-point operations a second, a multiply-add being two.
pub fn flops() -> f64 {
    let threads = rayon::current_num_threads();
    let mut best = 0.0f64;
    for _ in 0..5 {
        let started = Instant::now();
        (0..threads).into_par_iter().for_each(|k| {
            let mut chains = [[k as f32; 16]; 8];
            rounds(&mut chains);
            std::hint::black_box(chains);
        });
        best = best.max((threads * ROUNDS * 8 * 16 * 2) as f64 / started.elapsed().as_secs_f64());
    }
    best
}
