//! Adam on the trained values of a block of Gaussians.

use super::simd::vectorised;
use crate::cpu::{adam_step, opacity_penalty};
use crate::view::Step;
use fastlgs_core::gaussians::channel::{FEATURE, OPACITY};

/// Number of Gaussians updated together, so that their values stay in the cache.
pub const BLOCK: usize = 32;

/// Channels of a Gaussian with SH of degree 3, the highest.
const MAX_CHANNELS: usize = fastlgs_core::gaussians::channels(3);

/// Values, moments and gradients of up to [`BLOCK`] Gaussians, each `[gaussians][channels]`.
pub struct Values<'a> {
    pub params: &'a mut [f32],
    pub moment1: &'a mut [f32],
    pub moment2: &'a mut [f32],
    pub gradients: &'a [f32],
}

/// Updates the trained channels of a block. `rates` holds the learning rates of [`BLOCK`]
/// Gaussians, laid out like the values.
pub fn update_block(step: &Step, width: usize, rates: &[f32], values: Values) {
    let Values {
        params,
        moment1,
        moment2,
        gradients,
    } = values;
    let trained = step.first_channel as usize..(step.end_channel as usize).min(width);
    let mut gradient_buffer = [0.0; BLOCK * MAX_CHANNELS];
    let penalised_gradients = &mut gradient_buffer[..params.len()];
    penalised_gradients.copy_from_slice(gradients);
    for (row, gradients) in params
        .chunks_exact(width)
        .zip(penalised_gradients.chunks_exact_mut(width))
    {
        if trained.contains(&OPACITY) {
            gradients[OPACITY] += opacity_penalty(step, row[OPACITY]);
        }
    }
    if trained == (0..width) {
        adam(
            step,
            &rates[..params.len()],
            penalised_gradients,
            params,
            moment1,
            moment2,
        );
    } else {
        for first in (0..params.len()).step_by(width) {
            let own = first + trained.start..first + trained.end;
            let (params, moment1, moment2) = (
                &mut params[own.clone()],
                &mut moment1[own.clone()],
                &mut moment2[own.clone()],
            );
            adam(
                step,
                &rates[own.clone()],
                &penalised_gradients[own],
                params,
                moment1,
                moment2,
            );
        }
    }
    for row in params.chunks_exact_mut(width) {
        FEATURE
            .filter(|c| trained.contains(c))
            .for_each(|c| row[c] = row[c].clamp(0.0, 1.0));
    }
}

vectorised! {
    /// Applies one Adam step to each value.
    fn adam(step: &Step, rates: &[f32], gradients: &[f32], params: &mut [f32], moment1: &mut [f32], moment2: &mut [f32]) = adam_body
}

#[inline(always)]
fn adam_body<const FMA: bool>(
    step: &Step,
    rates: &[f32],
    gradients: &[f32],
    params: &mut [f32],
    moment1: &mut [f32],
    moment2: &mut [f32],
) {
    let moments = moment1.iter_mut().zip(moment2);
    for (((param, rate), g), (m1, m2)) in params.iter_mut().zip(rates).zip(gradients).zip(moments) {
        *param = adam_step(step, *rate, *g, *param, m1, m2);
    }
}
