//! Masks that shape Gaussians: from some step on the feature is trained as well, towards a code for each thing, and moves geometry with colour.

use super::Trainer;
use crate::channels::Channels;
use crate::{Error, Result};
use fastlgs_core::{Camera, Gaussians};
use std::ops::Range;

/// The feature among the channels of a Gaussian.
pub(super) const FEATURE: Range<usize> = 14..17;

impl Trainer {
    /// Whether masks shape the Gaussians by now.
    pub fn is_coupled(&self) -> bool {
        self.course.coupled
    }

    /// What the coming step trains.
    pub(super) fn channels(&self) -> Channels {
        if self.course.coupled { Channels::Coupled } else { self.course.config.channels }
    }

    /// Has the feature trained from now on, from where `features` sets it for the Gaussians as they are now; they are trained with these cameras.
    /// What views are trained towards, [`Trainer::towards`] tells.
    ///
    /// # Errors
    /// When the device fails, and whatever `features` returns; then nothing has changed.
    pub fn couple<E: From<Error>>(&mut self, features: impl FnOnce(&mut Gaussians, &[Camera]) -> Result<(), E>) -> Result<(), E> {
        let mut state = self.engine.state()?;
        state.keep_finite();
        let mut scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        features(&mut scene, &self.targets.cameras)?;
        let count = state.len();
        for (axis, channel) in FEATURE.enumerate() {
            let values = state.params[channel * count..][..count].iter_mut();
            values.zip(&scene.features).for_each(|(value, feature)| *value = feature[axis]);
        }
        self.engine.set_state(&state)?;
        self.course.coupled = true;
        Ok(())
    }

    /// The code of each pixel of a view, as [`TargetImage::feature`](crate::TargetImage::feature) has it, the same whenever it is asked.
    pub fn towards(&mut self, codes: impl Fn(usize) -> Result<Vec<u32>> + Send + Sync + 'static) {
        self.targets = self.targets.clone().with_features(codes);
        self.hide();
    }
}
