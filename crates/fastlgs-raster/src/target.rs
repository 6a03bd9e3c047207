//! Training views: cameras and the images that they are trained towards.

use crate::engine::{TargetImage, pack};
use crate::{Error, Result, exposure};
use fastlgs_core::Camera;
use rayon::prelude::*;
use std::sync::Arc;

/// A training view.
#[derive(Clone)]
pub struct Target {
    /// Camera at the training resolution.
    pub camera: Camera,
    /// Image that the view is trained towards.
    pub image: TargetImage,
    /// Brightness of its photo relative to the mean of all, by channel, as measured before
    /// training.
    pub gain: [f32; 3],
}

impl Target {
    /// Returns the view at half the resolution.
    pub(crate) fn halved(&self) -> Self {
        Self {
            camera: self.camera.halved(),
            image: self.image.halved(),
            gain: self.gain,
        }
    }
}

impl TargetImage {
    /// Returns the image at half the resolution. In each 2x2 block, only pixels that the loss uses
    /// contribute. Colours are averaged. Of codes, the most frequent one is used, because the mean
    /// of two codes may be near the code of a third object. Of depths, the first one is used.
    pub(crate) fn halved(&self) -> Self {
        let [w, h] = self.size;
        let size = [w.div_ceil(2), h.div_ceil(2)];
        let halve = |plane: &[u32], of: fn(&[[u8; 4]]) -> [u8; 3]| -> Vec<u32> {
            if plane.is_empty() {
                return Vec::new();
            }
            let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (2 * x, 2 * y)));
            pixels
                .map(|(x, y)| {
                    let block = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)]
                        .map(|(x, y)| (x.min(w - 1), y.min(h - 1)));
                    let bytes = block.map(|(x, y)| plane[(y * w + x) as usize].to_le_bytes());
                    let counting: Vec<[u8; 4]> =
                        bytes.into_iter().filter(|b| b[3] == 255).collect();
                    pack(
                        if counting.is_empty() {
                            [0; 3]
                        } else {
                            of(&counting)
                        },
                        !counting.is_empty(),
                    )
                })
                .collect()
        };
        let depth_at = |x: u32, y: u32| self.depth[(y * w + x) as usize];
        let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (2 * x, 2 * y)));
        let depth = if self.depth.is_empty() {
            Vec::new()
        } else {
            pixels.map(|(x, y)| depth_at(x, y)).collect()
        };
        Self {
            size,
            color: halve(&self.color, mean),
            feature: halve(&self.feature, mode),
            depth,
        }
    }

    /// Returns the standard deviation of the brightness (0 to 1) of the pixels that the loss uses,
    /// averaged over the colours.
    fn contrast(&self) -> f64 {
        let deviation = |c: usize| {
            let counting = self
                .color
                .iter()
                .map(|p| p.to_le_bytes())
                .filter(|p| p[3] == 255);
            let (n, sum, squares) = counting.fold((0u64, 0u64, 0u64), |(n, sum, squares), p| {
                let value = u64::from(p[c]);
                (n + 1, sum + value, squares + value * value)
            });
            let (n, sum, squares) = (n.max(1) as f64, sum as f64, squares as f64);
            (squares / n - (sum / n).powi(2)).max(0.0).sqrt() / 255.0
        };
        (0..3).map(deviation).sum::<f64>() / 3.0
    }
}

/// Training views whose images are read on demand: 300 photos of 1600x1066 would take two
/// gigabytes.
#[derive(Clone)]
pub struct Targets {
    /// Cameras at the training resolution.
    pub cameras: Vec<Camera>,
    /// [`Target::gain`] of each.
    gains: Vec<[f32; 3]>,
    read: Arc<dyn Fn(usize) -> Result<TargetImage> + Send + Sync>,
}

impl Targets {
    /// Creates views whose images `read` returns. It must return the same image on every call.
    pub fn new(
        cameras: Vec<Camera>,
        gains: Vec<[f32; 3]>,
        read: impl Fn(usize) -> Result<TargetImage> + Send + Sync + 'static,
    ) -> Self {
        Self {
            cameras,
            gains,
            read: Arc::new(read),
        }
    }

    /// Returns the number of views.
    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Returns whether there are no views.
    pub fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// Returns the number of pixels of all views.
    pub fn pixels(&self) -> usize {
        self.cameras
            .iter()
            .map(|c| (c.width * c.height) as usize)
            .sum()
    }

    /// Returns the brightness of each photo relative to the mean, by channel, as measured before
    /// training.
    pub(crate) fn gains(&self) -> &[[f32; 3]] {
        &self.gains
    }

    /// Reads a view with its image.
    ///
    /// # Errors
    /// When the image cannot be read.
    pub fn get(&self, id: usize) -> Result<Target> {
        Ok(Target {
            camera: self.cameras[id].clone(),
            image: (self.read)(id)?,
            gain: self.gains[id],
        })
    }

    /// Reads all images once, to detect errors before training.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub fn check(&self) -> Result<()> {
        (0..self.len())
            .into_par_iter()
            .try_for_each(|id| (self.read)(id).map(drop))
    }

    /// Returns a subset of the views.
    pub(crate) fn subset(&self, ids: Vec<usize>) -> Self {
        let (cameras, gains) = ids
            .iter()
            .map(|&id| (self.cameras[id].clone(), self.gains[id]))
            .unzip();
        let read = self.read.clone();
        Self::new(cameras, gains, move |k| read(ids[k]))
    }

    /// Returns the views without pixels that may be clipped at white; see `exposure.rs`.
    pub(crate) fn without_clipped(self) -> Self {
        let (read, gains) = (self.read, self.gains.clone());
        let unclipped = move |id: usize| {
            let mut image = read(id)?;
            image
                .color
                .iter_mut()
                .filter(|pixel| exposure::is_clipped(**pixel, gains[id]))
                .for_each(|pixel| *pixel &= 0x00ff_ffff);
            Ok(image)
        };
        Self::new(self.cameras, self.gains, unclipped)
    }

    /// Returns the views with these feature images.
    pub(crate) fn with_features(
        self,
        features: impl Fn(usize) -> Result<Vec<u32>> + Send + Sync + 'static,
    ) -> Self {
        let read = self.read;
        Self::new(self.cameras, self.gains, move |id| {
            Ok(TargetImage {
                feature: features(id)?,
                ..read(id)?
            })
        })
    }

    /// Returns the views with the depths that `depths` returns for a view and its image; see
    /// [`TargetImage::depth`].
    pub fn with_depths(
        self,
        depths: impl Fn(usize, &TargetImage) -> Vec<f32> + Send + Sync + 'static,
    ) -> Self {
        let read = self.read;
        Self::new(self.cameras, self.gains, move |id| {
            let image = read(id)?;
            Ok(TargetImage {
                depth: depths(id, &image),
                ..image
            })
        })
    }

    /// Returns the mean contrast of all images and their fingerprint. The contrast is the standard
    /// deviation of the brightness of the pixels that the loss uses, 0 to 1, averaged over colours.
    ///
    /// # Errors
    /// When an image cannot be read, or the loss ignores all pixels.
    pub(crate) fn contrast_and_fingerprint(&self) -> Result<(f32, u64)> {
        let of_picture = |image: TargetImage| {
            let counts = image
                .color
                .iter()
                .chain(&image.feature)
                .any(|pixel| pixel.to_le_bytes()[3] == 255);
            (
                image.contrast(),
                fingerprint(image.color.iter().chain(&image.feature).copied()),
                counts,
            )
        };
        let each = (0..self.len())
            .into_par_iter()
            .map(|id| Ok(of_picture((self.read)(id)?)))
            .collect::<Result<Vec<(f64, u64, bool)>>>()?;
        if !each.iter().any(|(.., counts)| *counts) {
            return Err(Error::Invalid("the masks leave nothing to train on: they exclude every pixel of all training photos; check whether they are inverted".to_owned()));
        }
        let contrast =
            each.iter().map(|(contrast, ..)| contrast).sum::<f64>() / each.len().max(1) as f64;
        Ok((
            contrast as f32,
            fingerprint(
                each.iter()
                    .flat_map(|(_, print, _)| [*print as u32, (print >> 32) as u32]),
            ),
        ))
    }
}

impl From<Vec<Target>> for Targets {
    fn from(targets: Vec<Target>) -> Self {
        let (cameras, gains) = targets.iter().map(|t| (t.camera.clone(), t.gain)).unzip();
        Self::new(cameras, gains, move |id| Ok(targets[id].image.clone()))
    }
}

/// Returns an FNV-1a hash of words (instead of bytes); it depends on their order.
pub(crate) fn fingerprint(words: impl Iterator<Item = u32>) -> u64 {
    words.fold(0xcbf2_9ce4_8422_2325, |print, word| {
        (print ^ u64::from(word)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

fn mean(pixels: &[[u8; 4]]) -> [u8; 3] {
    let n = pixels.len() as u32;
    std::array::from_fn(|c| {
        ((pixels.iter().map(|p| u32::from(p[c])).sum::<u32>() + n / 2) / n) as u8
    })
}

/// Returns the most frequent pixel; of equally frequent ones, the first.
fn mode(pixels: &[[u8; 4]]) -> [u8; 3] {
    let count = |pixel: &[u8; 4]| pixels.iter().filter(|p| *p == pixel).count();
    let [x, y, z, _] = pixels
        .iter()
        .rev()
        .copied()
        .max_by_key(count)
        .unwrap_or_default();
    [x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contrast_is_that_of_the_pixels_that_count() {
        let camera = Camera::look_at(
            "v",
            glam::Vec3::NEG_Z,
            glam::Vec3::ZERO,
            glam::Vec3::Y,
            2,
            2,
            1.0,
        );
        let color = vec![
            pack([0, 50, 255], true),
            pack([102, 50, 0], true),
            pack([255; 3], false),
            pack([51, 50, 0], true),
        ];
        let target = Target {
            camera,
            image: TargetImage {
                size: [2, 2],
                color,
                feature: Vec::new(),
                depth: Vec::new(),
            },
            gain: [1.0; 3],
        };
        // Values of red: 0, 0.4, 0.2; of green: constant; of blue: 1, 0, 0.
        let expected = ((0.08f32 / 3.0).sqrt() + (2.0f32 / 9.0).sqrt()) / 3.0;
        let mut other = target.clone();
        let (contrast, print) = Targets::from(vec![target.clone()])
            .contrast_and_fingerprint()
            .unwrap();
        assert!((contrast - expected).abs() < 1e-5);
        other.image.feature = vec![0; 4];
        assert_ne!(
            print,
            Targets::from(vec![other])
                .contrast_and_fingerprint()
                .unwrap()
                .1
        );
        assert_eq!(
            print,
            Targets::from(vec![target])
                .contrast_and_fingerprint()
                .unwrap()
                .1
        );
    }

    #[test]
    fn colours_are_averaged_and_codes_are_not() {
        let camera = Camera::look_at(
            "v",
            glam::Vec3::NEG_Z,
            glam::Vec3::ZERO,
            glam::Vec3::Y,
            4,
            2,
            1.0,
        );
        let plane: Vec<u32> = [10, 20, 40, 90, 20, 30, 90, 40]
            .map(|v| pack([v; 3], true))
            .to_vec();
        let feature = plane
            .iter()
            .enumerate()
            .map(|(k, p)| if k == 5 { p & 0x00ff_ffff } else { *p })
            .collect();
        let target = Target {
            camera,
            image: TargetImage {
                size: [4, 2],
                color: plane,
                feature,
                depth: Vec::new(),
            },
            gain: [1.0; 3],
        };
        let half = target.halved().image;
        assert_eq!(half.size, [2, 1]);
        assert_eq!(half.color, [20, 65].map(|v| pack([v; 3], true)));
        assert_eq!(half.feature, [20, 40].map(|v| pack([v; 3], true)));
    }
}
