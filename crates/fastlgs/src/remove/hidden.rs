//! Pixels that the removed objects may have coloured.

use crate::{Result, Scene};
use fastlgs_core::{Camera, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::Hit;

/// Pixels of the views that the removed objects cover, and those near them.
pub struct HiddenPixels {
    /// All views.
    pub all: Vec<(Camera, Vec<bool>)>,
    /// The training views. A transparent object does not hide the surface behind it.
    pub in_training: Vec<(Camera, Vec<bool>)>,
}

impl HiddenPixels {
    /// Returns the pixels of `targets`, widened by `dilation` pixels in x and y.
    pub fn of(scene: &mut Scene, grid: &Grid, targets: &[Hit], dilation: [u32; 2]) -> Result<Self> {
        let training = scene.manifest().training(scene.cameras());
        let has_transparent = scene.trained().clear > 0;
        let (mut all, mut in_training) = (Vec::new(), Vec::new());
        for camera in scene.cameras().to_vec() {
            let widened = |field: &Field| {
                let mask = field.mask(grid, targets);
                metrics::dilate(&mask, camera.width, camera.height, dilation)
            };
            let hidden = widened(&*scene.field(&camera, None)?);
            if training.iter().any(|view| view.name == camera.name) {
                let opaque = if has_transparent {
                    widened(&scene.field_without_transparent(&camera)?)
                } else {
                    hidden.clone()
                };
                in_training.push((camera.clone(), opaque));
            }
            all.push((camera, hidden));
        }
        Ok(Self { all, in_training })
    }

    /// Adds the pixels of `other`, which has the same views.
    pub fn extend(&mut self, other: Self) {
        let views = self.all.iter_mut().chain(&mut self.in_training);
        let added = other.all.into_iter().chain(other.in_training);
        for ((_, hidden), (_, added)) in views.zip(added) {
            hidden.iter_mut().zip(added).for_each(|(h, a)| *h |= a);
        }
    }
}

/// Returns the number of set pixels.
pub fn count_set(pixels: &[bool]) -> usize {
    pixels.iter().filter(|p| **p).count()
}
