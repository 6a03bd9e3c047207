//! How well colour is shown where the scene was not trained: as given, with each view's pose aligned to the scene, and with each photo's
//! exposure fitted as well.

use crate::{Result, Session, train};
use fastlgs_core::{Camera, metrics};
use fastlgs_raster::{Target, align};

/// Means over the held-out views.
#[derive(Clone, Copy, Debug, Default)]
pub struct Quality {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM.
    pub ssim: f64,
    /// PSNR where each view's pose is aligned to the scene first: what wrong poses of the held-out photos do not spoil.
    pub psnr_aligned: f64,
    /// PSNR where, beyond that, a gain and an offset a channel is fitted to each photo: what their exposures do not spoil.
    pub psnr_affine: f64,
}

/// Quality of the held-out views; none where there are none.
pub fn quality(scene: &mut Session) -> Result<Option<Quality>> {
    let cameras = scene.manifest.held_out(&scene.cameras);
    let background = train::Background { color: scene.trained.background, learn: false };
    let mut sum = Quality::default();
    for camera in &cameras {
        let target = train::target(&scene.folder, camera, None, &background)?;
        let given = scene.render(camera)?;
        let compared = Compared::of(&target, given.channels(0, 3));
        sum.psnr += compared.psnr();
        let [w, h] = [camera.width, camera.height].map(|side| side as usize);
        sum.ssim += metrics::ssim(&compared.rendered, &compared.photo, w, h, &compared.counts);
        let camera = aligned(scene, &target)?;
        let aligned = scene.render(&camera)?;
        let mut compared = Compared::of(&target, aligned.channels(0, 3));
        sum.psnr_aligned += compared.psnr();
        compared.fit_exposure();
        sum.psnr_affine += compared.psnr();
    }
    let mean = |v: f64| v / cameras.len() as f64;
    let Quality { psnr, ssim, psnr_aligned, psnr_affine } = sum;
    let all = Quality { psnr: mean(psnr), ssim: mean(ssim), psnr_aligned: mean(psnr_aligned), psnr_affine: mean(psnr_affine) };
    Ok((!cameras.is_empty()).then_some(all))
}

fn aligned(scene: &mut Session, target: &Target) -> Result<Camera> {
    let Session { engine, gaussians, trained, .. } = scene;
    let frame = |camera: &Camera| trained.view(camera, gaussians);
    Ok(align::align(engine.as_mut(), frame, target, &Default::default(), align::STEPS)?)
}

/// Planar pictures; where the photo does not count, it shows what was rendered.
struct Compared {
    rendered: Vec<f32>,
    photo: Vec<f32>,
    counts: Vec<bool>,
}

impl Compared {
    fn of(target: &Target, rendered: &[f32]) -> Self {
        let counts: Vec<bool> = target.image.color.iter().map(|p| p.to_le_bytes()[3] == 255).collect();
        let rendered: Vec<f32> = rendered.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        let channel = |c: usize| target.image.color.iter().map(move |p| f32::from(p.to_le_bytes()[c]) / 255.0);
        let mut photo: Vec<f32> = (0..3).flat_map(channel).collect();
        let outside = photo.iter_mut().zip(&rendered).zip(counts.iter().cycle()).filter(|(_, counts)| !**counts);
        outside.for_each(|((photo, rendered), _)| *photo = *rendered);
        Self { rendered, photo, counts }
    }

    fn psnr(&self) -> f64 {
        let counting =
            |plane: &[f32]| plane.iter().zip(self.counts.iter().cycle()).filter(|(_, c)| **c).map(|(v, _)| *v).collect::<Vec<_>>();
        metrics::psnr(&counting(&self.rendered), &counting(&self.photo))
    }

    /// Scales and shifts each channel of the render to where it is nearest to the photo.
    fn fit_exposure(&mut self) {
        let pixels = self.counts.len();
        for (rendered, photo) in self.rendered.chunks_exact_mut(pixels).zip(self.photo.chunks_exact(pixels)) {
            let pairs = rendered.iter().zip(photo).zip(&self.counts).filter(|(_, c)| **c).map(|((r, p), _)| (f64::from(*r), f64::from(*p)));
            let (n, x, y, xx, xy) =
                pairs.fold((0.0, 0.0, 0.0, 0.0, 0.0), |(n, x, y, xx, xy), (r, p)| (n + 1.0, x + r, y + p, xx + r * r, xy + r * p));
            let variance = xx - x * x / n;
            let gain = if variance > 1e-6 * n { (xy - x * y / n) / variance } else { 1.0 };
            let offset = (y - gain * x) / f64::max(n, 1.0);
            rendered.iter_mut().for_each(|v| *v = (gain as f32 * *v + offset as f32).clamp(0.0, 1.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_raster::{TargetImage, pack};
    use glam::Vec3;

    #[test]
    fn exposure_is_fitted_and_what_does_not_count_is_left_out() {
        let camera = Camera::look_at("a", Vec3::Z, Vec3::ZERO, Vec3::Y, 8, 4, 0.8);
        let rendered: Vec<f32> = (0..96).map(|k| (k % 32) as f32 / 64.0).collect();
        let shown = |k: usize| ((0.5 * rendered[k] + 0.2) * 255.0) as u8;
        let color = (0..32).map(|k| if k == 5 { pack([255; 3], false) } else { pack([shown(k); 3], true) }).collect();
        let target = Target { camera, image: TargetImage { size: [8, 4], color, feature: Vec::new() }, gain: [1.0; 3] };
        let mut compared = Compared::of(&target, &rendered);
        assert!(compared.psnr() < 25.0);
        compared.fit_exposure();
        assert!(compared.psnr() > 50.0, "{}", compared.psnr());
    }
}
