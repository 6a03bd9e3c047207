use crate::Step;
use fastlgs_core::gaussians::CHANNELS;

/// Twin of `shaders/adam.wgsl`.
pub fn adam(step: &Step, gradients: &[f32], params: &mut [f32], moment1: &mut [f32], moment2: &mut [f32]) {
    let n = step.n as usize;
    for k in 0..CHANNELS * n {
        let g = gradients[k];
        let m1 = 0.9 * moment1[k] + 0.1 * g;
        let m2 = 0.999 * moment2[k] + 0.001 * g * g;
        moment1[k] = m1;
        moment2[k] = m2;
        params[k] -= step.rates[k / n] * (m1 / step.correction1) / ((m2 / step.correction2).sqrt() + step.epsilon);
    }
}
