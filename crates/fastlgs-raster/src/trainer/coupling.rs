//! Masks that shape Gaussians: from some step on, the feature loss moves geometry too.
//!
//! The feature of each pixel is trained towards the code of its object, together with colour.

use super::Trainer;
use crate::channels::Channels;
use crate::engine::Engine;
use crate::{Error, Result};
use fastlgs_core::gaussians::channel::FEATURE;
use fastlgs_core::{Camera, Gaussians};

impl Trainer {
    /// Returns whether the feature loss already moves geometry.
    pub fn is_coupled(&self) -> bool {
        self.training.coupled
    }

    /// Returns the channels that the next step trains.
    pub(super) fn channels(&self) -> Channels {
        if self.training.coupled {
            Channels::Coupled
        } else {
            self.training.config.channels
        }
    }

    /// Starts to train the feature, which then moves geometry too.
    ///
    /// `features` gets the engine, whose state it may replace, the current Gaussians and the
    /// training cameras. It sets the initial features. [`Trainer::set_codes`] sets the codes that
    /// views are trained towards.
    ///
    /// # Errors
    /// When the device fails, or `features` returns an error. Then the Gaussians have not changed.
    pub fn couple<E: From<Error>>(
        &mut self,
        features: impl FnOnce(&mut dyn Engine, &mut Gaussians, &[Camera]) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut state = self.engine.state()?;
        state.keep_finite();
        let mut scene = Gaussians::from_channels(&state.params, state.sh_degree, None);
        if let Err(error) = features(&mut *self.engine, &mut scene, &self.targets.cameras) {
            self.engine.set_state(&state)?;
            return Err(error);
        }
        let count = state.len();
        for (axis, channel) in FEATURE.enumerate() {
            let values = state.params[channel * count..][..count].iter_mut();
            values
                .zip(&scene.features)
                .for_each(|(value, feature)| *value = feature[axis]);
        }
        self.engine.set_state(&state)?;
        self.training.coupled = true;
        Ok(())
    }

    /// Sets the code images of the views. `codes` returns the pixels of a view in the format of
    /// [`TargetImage::feature`](crate::TargetImage::feature), the same on every call.
    pub fn set_codes(&mut self, codes: impl Fn(usize) -> Result<Vec<u32>> + Send + Sync + 'static) {
        self.targets = self.targets.clone().with_features(codes);
        self.unload_targets();
    }
}
