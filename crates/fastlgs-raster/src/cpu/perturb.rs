use super::{covariance, pcg3d};
use crate::view::{Perturb, stride};
use fastlgs_core::gaussians::sigmoid;
use glam::{UVec3, Vec3};

/// Twin of `shaders/perturb.wgsl`.
pub fn perturb(job: &Perturb, params: &mut [f32]) {
    let n = stride(job.n as usize);
    for i in 0..job.n as usize {
        let offset = perturb_one(job, i as u32, |c| params[c * n + i]);
        (0..3).for_each(|k| params[k * n + i] += offset[k]);
    }
}

/// What Gaussian `i` of the page moves by.
pub(crate) fn perturb_one(job: &Perturb, i: u32, param: impl Fn(usize) -> f32) -> Vec3 {
    let u = uniforms(pcg3d(UVec3::new(job.first + i, job.seed, 0)));
    let v = uniforms(pcg3d(UVec3::new(job.first + i, job.seed, 1)));
    let normal = (-2.0 * u.map(f32::ln)).map(f32::sqrt) * (std::f32::consts::TAU * v).map(f32::cos);
    let faint = 1.0 / (1.0 + (100.0 * (sigmoid(param(10)) - 0.005)).exp());
    let r = covariance::rotation(&param).1;
    let s = Vec3::new(param(3), param(4), param(5)).map(f32::exp);
    job.amount * faint * (r * (s * s * (r.transpose() * normal)))
}

/// Uniform in (0, 1).
fn uniforms(words: UVec3) -> Vec3 {
    ((words >> 9u32).as_vec3() + 0.5) / 8_388_608.0
}
