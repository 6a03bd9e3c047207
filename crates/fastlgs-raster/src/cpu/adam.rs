//! CPU twin of `shaders/adam.wgsl`: Adam on the trained values of a page.

use crate::Step;
use fastlgs_core::gaussians::channel::{FEATURE, OPACITY};
use fastlgs_core::gaussians::{BASE_CHANNELS, sigmoid};

/// Applies one Adam step to the trained channels of a page.
pub fn adam(
    step: &Step,
    gradients: &[f32],
    params: &mut [f32],
    moment1: &mut [f32],
    moment2: &mut [f32],
) {
    let n = 4 * step.quads as usize;
    for channel in step.first_channel as usize..step.end_channel as usize {
        for k in channel * n + n.min(step.frozen as usize)..(channel + 1) * n {
            adam_one(
                step,
                channel,
                gradients[k],
                &mut params[k],
                &mut moment1[k],
                &mut moment2[k],
            );
        }
    }
}

/// Applies one Adam step to one trained value.
#[inline]
fn adam_one(
    step: &Step,
    channel: usize,
    gradient: f32,
    param: &mut f32,
    moment1: &mut f32,
    moment2: &mut f32,
) {
    let g = if channel == OPACITY {
        gradient + opacity_penalty(step, *param)
    } else {
        gradient
    };
    let next = adam_step(
        step,
        step.rates[channel.min(BASE_CHANNELS)],
        g,
        *param,
        moment1,
        moment2,
    );
    *param = if FEATURE.contains(&channel) {
        next.clamp(0.0, 1.0)
    } else {
        next
    };
}

/// Returns the gradient of the opacity penalty by the opacity logit.
#[inline]
pub(crate) fn opacity_penalty(step: &Step, opacity_logit: f32) -> f32 {
    let opacity = sigmoid(opacity_logit);
    step.opacity_weight * opacity * (1.0 - opacity)
}

/// Returns the value after one Adam step and updates its moments.
#[inline(always)]
pub(crate) fn adam_step(
    step: &Step,
    rate: f32,
    g: f32,
    param: f32,
    moment1: &mut f32,
    moment2: &mut f32,
) -> f32 {
    let m1 = 0.9 * *moment1 + 0.1 * g;
    let m2 = 0.999 * *moment2 + 0.001 * g * g;
    (*moment1, *moment2) = (m1, m2);
    param - rate * (m1 / step.correction1) / ((m2 / step.correction2).sqrt() + step.epsilon)
}
