use crate::Step;
use fastlgs_core::gaussians::{BASE_CHANNELS, sigmoid};

/// Twin of `shaders/adam.wgsl`.
pub fn adam(step: &Step, gradients: &[f32], params: &mut [f32], moment1: &mut [f32], moment2: &mut [f32]) {
    let n = 4 * step.quads as usize;
    for channel in step.first_channel as usize..step.end_channel as usize {
        for k in channel * n..(channel + 1) * n {
            adam_one(step, channel, gradients[k], &mut params[k], &mut moment1[k], &mut moment2[k]);
        }
    }
}

/// One trained value.
#[inline]
pub(crate) fn adam_one(step: &Step, channel: usize, gradient: f32, param: &mut f32, moment1: &mut f32, moment2: &mut f32) {
    let mut g = gradient;
    if channel == 10 {
        let opacity = sigmoid(*param);
        g += step.opacity_weight * opacity * (1.0 - opacity);
    }
    if (3..6).contains(&channel) {
        g += step.scale_weight * param.exp();
    }
    let m1 = 0.9 * *moment1 + 0.1 * g;
    let m2 = 0.999 * *moment2 + 0.001 * g * g;
    (*moment1, *moment2) = (m1, m2);
    let next = *param - step.rates[channel.min(BASE_CHANNELS)] * (m1 / step.correction1) / ((m2 / step.correction2).sqrt() + step.epsilon);
    *param = if (14..BASE_CHANNELS).contains(&channel) { next.clamp(0.0, 1.0) } else { next };
}
