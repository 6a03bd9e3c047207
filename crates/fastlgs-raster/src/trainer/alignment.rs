//! Cameras of the training views move to where the scene says that they were.

use super::{Trainer, view_of};
use crate::Result;
use crate::align;
use crate::engine::Exposure;
use crate::schedule::Alignment;
use crate::target::Target;
use fastlgs_core::Camera;

/// Steps of an alignment while training, at a quarter, half and all of the resolution: the next alignment goes on.
const ALIGNING: [usize; 3] = [2, 1, 0];
/// What the watched views have to gain by alignment, in dB, before the others are aligned: exact poses gain some hundredths.
const ALIGNMENT_PAYS: f64 = 0.3;

impl Trainer {
    /// A view's camera where the scene as it is now looks most like its photo.
    pub(super) fn aligned(&mut self, target: &Target, exposure: &Exposure) -> Result<Camera> {
        let degree = self.course.config.degree(self.course.iteration);
        let (course, gaussians) = (&self.course, self.engine.len());
        align::align(self.engine.as_mut(), |camera| view_of(course, gaussians, camera, degree), target, exposure, ALIGNING)
    }

    /// Moves the training views to where the scene as it is now says that they were; all together they stay where they are. Unless that was
    /// asked for, only if the watched views, which know nothing of the scene yet, gain by it: good poses are better left alone.
    pub(super) fn align(&mut self) -> Result<()> {
        if self.course.alignment_gain.is_none() && self.course.config.alignment == Alignment::Auto {
            let watched = self.watched();
            if watched.is_empty() {
                return Ok(());
            }
            let mut moved = watched.clone();
            for id in 0..watched.len() {
                let target = watched.get(id)?;
                moved.cameras[id] = self.aligned(&target, &self.known_exposure(&target))?;
            }
            let gain = self.quality(&moved, None)?.zip(self.quality(&watched, None)?).map_or(0.0, |(after, before)| after - before);
            tracing::info!(gain, "watched views gained by aligning their poses");
            self.course.alignment_gain = Some(gain);
        }
        if self.course.config.alignment == Alignment::Auto && self.course.alignment_gain.is_some_and(|gain| gain < ALIGNMENT_PAYS) {
            return Ok(());
        }
        let before = self.cameras();
        let mut after = Vec::with_capacity(before.len());
        for id in 0..self.targets.len() {
            let (target, exposure) = (self.targets.get(id)?, self.exposure(id));
            after.push(self.aligned(&target, &exposure)?);
        }
        align::keep_mean(&before, &mut after);
        for (id, camera) in after.into_iter().enumerate() {
            self.course.poses[id] = camera.world_to_camera;
            self.targets.cameras[id] = camera;
        }
        Ok(())
    }

    /// Cameras of the training views as they are now.
    pub fn cameras(&self) -> Vec<Camera> {
        self.targets.cameras.clone()
    }
}
