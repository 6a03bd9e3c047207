//! Alignment of the training cameras to the scene during training.

use super::{Trainer, view_of};
use crate::Result;
use crate::align;
use crate::engine::Exposure;
use crate::schedule::Alignment;
use crate::target::Target;
use fastlgs_core::Camera;

/// Alignment steps at a quarter, half and full resolution. They are few, because the next alignment
/// continues from the result.
const ALIGNMENT_STEPS: [usize; 3] = [2, 1, 0];
/// Smallest PSNR gain of the validation views, in dB, for which all views are aligned. With exact
/// poses the gain is some hundredths.
const MIN_ALIGNMENT_GAIN: f64 = 0.3;

impl Trainer {
    /// Returns a view's camera at the pose from which the current scene looks most like its photo.
    pub(super) fn aligned(&mut self, target: &Target, exposure: &Exposure) -> Result<Camera> {
        let degree = self.training.config.degree(self.training.iteration);
        let (course, gaussians) = (&self.training, self.engine.len());
        align::align(
            self.engine.as_mut(),
            |camera| view_of(course, gaussians, camera, degree),
            target,
            exposure,
            ALIGNMENT_STEPS,
        )
    }

    /// Aligns the training views to the current scene, and keeps their mean pose.
    ///
    /// With `Alignment::Auto` this happens only if the validation views gain enough, so that
    /// good poses do not change. Under an automatic budget these views are not trained on yet.
    pub(super) fn align(&mut self) -> Result<()> {
        if self.training.alignment_gain.is_none()
            && self.training.config.alignment == Alignment::Auto
        {
            let watched = self.validation_views();
            if watched.is_empty() {
                return Ok(());
            }
            let mut moved = watched.clone();
            for id in 0..watched.len() {
                let target = watched.get(id)?;
                moved.cameras[id] = self.aligned(&target, &self.measured_exposure(&target))?;
            }
            let gain = self
                .quality(&moved, None)?
                .zip(self.quality(&watched, None)?)
                .map_or(0.0, |(after, before)| after - before);
            tracing::info!(
                gain,
                "PSNR gain of the validation views by alignment, in dB"
            );
            self.training.alignment_gain = Some(gain);
        }
        if self.training.config.alignment == Alignment::Auto
            && self
                .training
                .alignment_gain
                .is_some_and(|gain| gain < MIN_ALIGNMENT_GAIN)
        {
            return Ok(());
        }
        let before = self.cameras();
        let mut after = Vec::with_capacity(before.len());
        for id in 0..self.targets.len() {
            let (target, exposure) = (self.targets.get(id)?, self.exposure(id));
            after.push(self.aligned(&target, &exposure)?);
        }
        align::restore_mean_pose(&before, &mut after);
        for (id, camera) in after.into_iter().enumerate() {
            self.training.poses[id] = camera.world_to_camera;
            self.targets.cameras[id] = camera;
        }
        Ok(())
    }

    /// Returns the current cameras of the training views.
    pub fn cameras(&self) -> Vec<Camera> {
        self.targets.cameras.clone()
    }
}
