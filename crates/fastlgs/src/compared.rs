//! Compares a rendered view with its photo.

use fastlgs_core::metrics;
use fastlgs_raster::Target;

/// A render and its photo, both `[3][h][w]`, values 0 to 1. Pixels of the photo that do not count
/// are copied from the render.
pub(crate) struct Compared {
    pub rendered: Vec<f32>,
    pub photo: Vec<f32>,
    /// Whether each pixel counts, `[h][w]`. Ignored pixels do not count.
    pub counts: Vec<bool>,
}

impl Compared {
    /// Pairs `rendered`, `[3][h][w]`, with the photo of `target`; `None` if no pixel of the photo
    /// counts.
    pub fn of(target: &Target, rendered: &[f32]) -> Option<Self> {
        let counts: Vec<bool> = target
            .image
            .color
            .iter()
            .map(|p| p.to_le_bytes()[3] == 255)
            .collect();
        let rendered: Vec<f32> = rendered.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        let channel = |c: usize| {
            target
                .image
                .color
                .iter()
                .map(move |p| f32::from(p.to_le_bytes()[c]) / 255.0)
        };
        let mut photo: Vec<f32> = (0..3).flat_map(channel).collect();
        let outside = photo
            .iter_mut()
            .zip(&rendered)
            .zip(counts.iter().cycle())
            .filter(|(_, counts)| !**counts);
        outside.for_each(|((photo, rendered), _)| *photo = *rendered);
        counts.contains(&true).then_some(Self {
            rendered,
            photo,
            counts,
        })
    }

    /// Returns the PSNR over the pixels that count, in dB.
    pub fn psnr(&self) -> f64 {
        let counting = |plane: &[f32]| {
            plane
                .iter()
                .zip(self.counts.iter().cycle())
                .filter(|(_, c)| **c)
                .map(|(v, _)| *v)
                .collect::<Vec<_>>()
        };
        metrics::psnr(&counting(&self.rendered), &counting(&self.photo))
    }

    /// Fits gain and offset of each channel of the render to the photo, by least squares.
    pub fn fit_exposure(&mut self) {
        let pixels = self.counts.len();
        for (rendered, photo) in self
            .rendered
            .chunks_exact_mut(pixels)
            .zip(self.photo.chunks_exact(pixels))
        {
            let pairs = rendered
                .iter()
                .zip(photo)
                .zip(&self.counts)
                .filter(|(_, c)| **c)
                .map(|((r, p), _)| (f64::from(*r), f64::from(*p)));
            let (n, x, y, xx, xy) = pairs
                .fold((0.0, 0.0, 0.0, 0.0, 0.0), |(n, x, y, xx, xy), (r, p)| {
                    (n + 1.0, x + r, y + p, xx + r * r, xy + r * p)
                });
            let variance = xx - x * x / n;
            let gain = if variance > 1e-6 * n {
                (xy - x * y / n) / variance
            } else {
                1.0
            };
            let offset = (y - gain * x) / f64::max(n, 1.0);
            rendered
                .iter_mut()
                .for_each(|v| *v = (gain as f32 * *v + offset as f32).clamp(0.0, 1.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Camera;
    use fastlgs_raster::{TargetImage, pack};
    use glam::Vec3;

    #[test]
    fn exposure_is_fitted_and_ignored_pixels_are_left_out() {
        let camera = Camera::look_at("a", Vec3::Z, Vec3::ZERO, Vec3::Y, 8, 4, 0.8);
        let rendered: Vec<f32> = (0..96).map(|k| (k % 32) as f32 / 64.0).collect();
        let shown = |k: usize| ((0.5 * rendered[k] + 0.2) * 255.0) as u8;
        let color = (0..32)
            .map(|k| {
                if k == 5 {
                    pack([255; 3], false)
                } else {
                    pack([shown(k); 3], true)
                }
            })
            .collect();
        let target = Target {
            camera,
            image: TargetImage {
                size: [8, 4],
                color,
                feature: Vec::new(),
                depth: Vec::new(),
            },
            gain: [1.0; 3],
        };
        let mut compared = Compared::of(&target, &rendered).unwrap();
        assert!(compared.psnr() < 25.0);
        compared.fit_exposure();
        assert!(compared.psnr() > 50.0, "{}", compared.psnr());
        let nothing = Target {
            image: TargetImage {
                color: vec![pack([255; 3], false); 32],
                ..target.image
            },
            ..target
        };
        assert!(Compared::of(&nothing, &rendered).is_none());
    }
}
