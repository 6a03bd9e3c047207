//! What views that are watched, and not trained on while the scene grows, decide: whether it may grow on, what may be removed, and how
//! many SH degrees it needs.

use super::{Trainer, view_of};
use crate::Result;
use crate::budget::{self, Removal};
use crate::change::Changes;
use crate::schedule::Budget;
use crate::target::Targets;
use fastlgs_core::Gaussians;

impl Trainer {
    /// Looks at the watched views and decides whether the scene may grow on.
    pub(super) fn watch(&mut self) -> Result<()> {
        let degree = self.course.config.degree(self.course.iteration);
        if let Some(db) = self.quality(&self.watched(), Some(degree))? {
            self.course.growth.look(self.engine.len(), db);
            tracing::debug!(iteration = self.course.iteration, db, gaussians = self.engine.len(), growth = ?self.course.growth, "watched views");
        }
        Ok(())
    }

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
        let mut state = self.engine.state()?;
        state.keep_finite();
        let scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        let degree = self.course.config.degree(self.course.iteration);
        let mut changes = Changes::of(&scene);
        for id in 0..self.targets.len() {
            let target = self.targets.get(id)?;
            changes.see(&view_of(&self.course, scene.len(), &target.camera, degree), Some((&target.image, self.exposure(id))));
        }
        let judges = self.judges();
        let psnr_before = self.quality(&judges, None)?;
        let whole = state.clone();
        let mut affordable = budget::AFFORDABLE * changes.error;
        let psnr_after = loop {
            state.keep(&budget::needed(&changes.each, affordable));
            self.replace(&state)?;
            let psnr_after = self.quality(&judges, None)?;
            let lost = psnr_before.zip(psnr_after).map_or(0.0, |(before, after)| before - after);
            if lost <= budget::AT_ONCE || state.len() == whole.len() {
                break psnr_after;
            }
            state = whole.clone();
            // In the end nothing goes.
            affordable = if affordable < 1e-4 * changes.error { -1.0 } else { 0.5 * affordable };
        };
        let removal = Removal { iteration: self.course.iteration, before: scene.len(), after: state.len(), psnr_before, psnr_after };
        tracing::info!(?removal, "Gaussians removed that change little");
        self.course.removals.push(removal);
        Ok(())
    }

    /// The views that tell what a removal costs: the watched ones, else some of all.
    pub(super) fn judges(&self) -> Targets {
        let watched = self.watched();
        if watched.is_empty() { self.targets.some((0..self.targets.len()).step_by(budget::WATCHED).collect()) } else { watched }
    }
}
