//! What views that are watched, and not trained on while the scene grows, decide: whether it may grow on, what may be removed, and how
//! many SH degrees it needs.

use super::{Trainer, view_of};
use crate::Result;
use crate::budget::{self, Removal};
use crate::schedule::Budget;
use crate::target::Targets;
use crate::view::View;
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
        let scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        let judges = self.judges();
        // Where no pixel counts, nothing is known to be right.
        let psnr_before = self.quality(&judges, None)?;
        let error = psnr_before.map_or(0.0, |psnr| 10f64.powf(-0.1 * psnr));
        let degree = self.course.config.degree(self.course.iteration);
        let views: Vec<View> = self.targets.cameras.iter().map(|camera| view_of(&self.course, scene.len(), camera, degree)).collect();
        let values: f64 = views.iter().map(|view| 3.0 * f64::from(view.size[0]) * f64::from(view.size[1])).sum();
        state.keep(&budget::needed(&budget::changes(&scene, &views), error * values));
        self.replace(&state)?;
        let psnr_after = self.quality(&judges, None)?;
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
