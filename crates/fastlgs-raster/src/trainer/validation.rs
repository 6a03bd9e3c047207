//! Decisions by validation views: whether a removal is acceptable, and which SH degree the scene
//! needs.
//!
//! Validation views are not trained on while the scene grows.

use super::Trainer;
use crate::Result;
use crate::budget::{self, Removal};
use crate::engine::ExposedPhoto;
use crate::schedule::Budget;
use crate::target::Targets;

impl Trainer {
    /// Returns the validation views: training views that are held out while the scene grows.
    pub(super) fn validation_views(&self) -> Targets {
        let count = self.targets.len();
        self.targets.subset(
            (0..count)
                .filter(|&i| budget::is_validation_view(i, count))
                .collect(),
        )
    }

    /// Returns the lowest SH degree that loses at most [`budget::DEGREE_LOSS`] dB on the validation
    /// views. Returns the current degree if the budget is fixed or there are no validation views.
    ///
    /// # Errors
    /// As [`crate::engine::Engine::render`].
    pub fn needed_degree(&mut self) -> Result<u32> {
        let (highest, watched) = (
            self.training.config.degree(self.training.iteration),
            self.validation_views(),
        );
        let automatic = matches!(self.training.config.budget, Budget::Auto(_));
        let Some(best) = self.quality(&watched, Some(highest))?.filter(|_| automatic) else {
            return Ok(highest);
        };
        for degree in 0..highest {
            if self
                .quality(&watched, Some(degree))?
                .is_some_and(|db| best - db <= budget::DEGREE_LOSS)
            {
                return Ok(degree);
            }
        }
        Ok(highest)
    }

    /// Removes Gaussians that the training views hardly need.
    pub(super) fn prune(&mut self) -> Result<()> {
        let mut whole = self.engine.state()?;
        whole.keep_finite();
        whole.remove_where(|mean| self.free_space.contains(mean));
        self.replace(&whole)?;
        let (scores, squared_error) = self.saliency()?;
        let cost_views = self.cost_views();
        let psnr_before = self.quality(&cost_views, None)?;
        let mut removal = Removal {
            iteration: self.training.iteration,
            before: whole.len(),
            after: whole.len(),
            psnr_before,
            psnr_after: None,
        };
        for places in budget::candidates(&scores, squared_error) {
            let mut state = whole.clone();
            state.keep(&places);
            self.replace(&state)?;
            (removal.after, removal.psnr_after) = (state.len(), self.quality(&cost_views, None)?);
            if removal.is_acceptable() {
                break;
            }
        }
        tracing::info!(?removal, "removed unimportant Gaussians");
        self.training.removals.push(removal);
        Ok(())
    }

    /// Returns how much the training views change without each Gaussian, and their squared error.
    fn saliency(&mut self) -> Result<(Vec<f32>, f64)> {
        let degree = self.training.config.degree(self.training.iteration);
        let mut scores = vec![0.0; self.engine.len()];
        let mut squared_error = 0.0;
        for id in 0..self.targets.len() {
            let target = self.targets.get(id)?;
            let photo = ExposedPhoto {
                image: &target.image,
                exposure: self.exposure(id),
            };
            let view = self.view(&target.camera, degree);
            squared_error += self.engine.saliency(view, Some(&photo), &mut scores)?;
        }
        Ok((scores, squared_error))
    }

    /// Returns the views that measure the cost of a removal: the validation views, else every tenth
    /// view.
    pub(super) fn cost_views(&self) -> Targets {
        let watched = self.validation_views();
        if watched.is_empty() {
            self.targets.subset(
                (0..self.targets.len())
                    .step_by(budget::VALIDATION_INTERVAL)
                    .collect(),
            )
        } else {
            watched
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CpuEngine, Target, TargetImage, TrainerConfig, pack};
    use fastlgs_core::{Camera, Gaussians};
    use glam::Vec3;

    #[test]
    fn prune_keeps_one_of_two_redundant_gaussians() {
        let camera = Camera::look_at(
            "a",
            Vec3::new(0.0, 0.0, -4.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let mut scene = Gaussians::default();
        // Each large Gaussian hides the other, so each alone could be removed. The small one is
        // needed.
        scene.push_sphere(Vec3::ZERO, 3.0, 0.99, [0.5; 3]);
        scene.push_sphere(Vec3::ZERO, 3.0, 0.99, [0.5; 3]);
        scene.push_sphere(Vec3::NEG_Z, 0.1, 0.99, [0.9; 3]);
        let counts = |p: i32| (p % 64 - 32).pow(2) + (p / 64 - 24).pow(2) < 12 * 12;
        let color = (0..64 * 48).map(|p| pack([180; 3], counts(p))).collect();
        let target = Target {
            camera,
            image: TargetImage {
                size: [64, 48],
                color,
                feature: Vec::new(),
                depth: Vec::new(),
            },
            gain: [1.0; 3],
        };
        let config = TrainerConfig {
            budget: Budget::Auto(10),
            ..TrainerConfig::default()
        };
        let mut trainer =
            Trainer::new(Box::new(CpuEngine::new()), &scene, vec![target], config).unwrap();
        trainer.prune().unwrap();
        let removal = trainer.training.removals[0];
        assert_eq!((removal.before, removal.after), (3, 2), "{removal:?}");
        assert!(
            (removal.psnr_before.unwrap() - removal.psnr_after.unwrap()).abs() < 1.0,
            "{removal:?}"
        );
    }
}
