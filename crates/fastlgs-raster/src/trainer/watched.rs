//! What views that are watched, and not trained on while the scene grows, decide: whether a removal is bearable, and how many SH degrees the
//! scene needs.

use super::{Trainer, view_of};
use crate::Result;
use crate::budget::{self, Removal};
use crate::change::Changes;
use crate::density::State;
use crate::schedule::Budget;
use crate::target::Targets;
use fastlgs_core::Gaussians;

impl Trainer {
    /// The training views that are kept aside while the scene grows.
    pub(super) fn watched(&self) -> Targets {
        let count = self.targets.len();
        self.targets.some((0..count).filter(|&i| budget::is_watched(i, count)).collect())
    }

    /// The lowest SH degree that shows the watched views as well as all degrees do, but for [`budget::DEGREE_LOSS`] dB; the
    /// highest where the budget is fixed or no view is watched.
    ///
    /// # Errors
    /// As [`crate::engine::Engine::render`].
    pub fn needed_degree(&mut self) -> Result<u32> {
        let (highest, watched) = (self.course.config.degree(self.course.iteration), self.watched());
        let automatic = matches!(self.course.config.budget, Budget::Auto(_));
        let Some(best) = self.quality(&watched, Some(highest))?.filter(|_| automatic) else { return Ok(highest) };
        for degree in 0..highest {
            if self.quality(&watched, Some(degree))?.is_some_and(|db| best - db <= budget::DEGREE_LOSS) {
                return Ok(degree);
            }
        }
        Ok(highest)
    }

    /// Removes that without which the training views would hardly change.
    pub(super) fn prune(&mut self) -> Result<()> {
        let mut whole = self.engine.state()?;
        whole.keep_finite();
        let changes = self.changes(&whole)?;
        let judges = self.judges();
        let psnr_before = self.quality(&judges, None)?;
        let mut removal =
            Removal { iteration: self.course.iteration, before: whole.len(), after: whole.len(), psnr_before, psnr_after: None };
        for places in budget::candidates(&changes.each, changes.error) {
            let mut state = whole.clone();
            state.keep(&places);
            self.replace(&state)?;
            (removal.after, removal.psnr_after) = (state.len(), self.quality(&judges, None)?);
            if removal.is_bearable() {
                break;
            }
        }
        tracing::info!(?removal, "Gaussians removed that change little");
        self.course.removals.push(removal);
        Ok(())
    }

    /// What the training views tell of each Gaussian.
    fn changes(&self, state: &State) -> Result<Changes> {
        let scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        let degree = self.course.config.degree(self.course.iteration);
        let mut changes = Changes::of(&scene);
        for id in 0..self.targets.len() {
            let target = self.targets.get(id)?;
            changes.see(&view_of(&self.course, scene.len(), &target.camera, degree), Some((&target.image, self.exposure(id))));
        }
        Ok(changes)
    }

    /// The views that tell what a removal costs: the watched ones, else some of all.
    pub(super) fn judges(&self) -> Targets {
        let watched = self.watched();
        if watched.is_empty() { self.targets.some((0..self.targets.len()).step_by(budget::WATCHED).collect()) } else { watched }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CpuEngine, Target, TargetImage, TrainConfig, pack};
    use fastlgs_core::Camera;
    use glam::Vec3;

    #[test]
    fn of_two_that_hide_each_other_one_stays() {
        let camera = Camera::look_at("a", Vec3::new(0.0, 0.0, -4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let mut scene = Gaussians::default();
        // Alone, neither of the large ones is missed, and both could afford to go; the small one is.
        scene.push_sphere(Vec3::ZERO, 3.0, 0.99, [0.5; 3]);
        scene.push_sphere(Vec3::ZERO, 3.0, 0.99, [0.5; 3]);
        scene.push_sphere(Vec3::NEG_Z, 0.1, 0.99, [0.9; 3]);
        let counts = |p: i32| (p % 64 - 32).pow(2) + (p / 64 - 24).pow(2) < 12 * 12;
        let color = (0..64 * 48).map(|p| pack([180; 3], counts(p))).collect();
        let target = Target { camera, image: TargetImage { size: [64, 48], color, feature: Vec::new() }, gain: [1.0; 3] };
        let config = TrainConfig { budget: Budget::Auto(10), ..TrainConfig::default() };
        let mut trainer = Trainer::new(Box::new(CpuEngine::new()), &scene, vec![target], config).unwrap();
        trainer.prune().unwrap();
        let removal = trainer.course.removals[0];
        assert_eq!((removal.before, removal.after), (3, 2), "{removal:?}");
        assert!((removal.psnr_before.unwrap() - removal.psnr_after.unwrap()).abs() < 1.0, "{removal:?}");
    }
}
