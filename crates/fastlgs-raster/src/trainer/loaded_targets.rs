//! Target images on the device. If they do not all fit, some are read again when they are used.

use super::Trainer;
use crate::Result;
use std::collections::BTreeMap;
use std::time::Instant;

/// Default limit of the target images on the device, in bytes.
const ROOM: usize = 1 << 30;

/// The target images that are on the device.
pub(super) struct LoadedTargets {
    /// Whether they have half the resolution.
    coarse: bool,
    /// Bytes of each view's image.
    views: BTreeMap<usize, usize>,
    /// Largest number of bytes.
    pub limit: usize,
    /// Seconds in which images were read. They are not counted as time of steps, which they would
    /// distort in short runs.
    pub read_seconds: f64,
}

impl Default for LoadedTargets {
    fn default() -> Self {
        Self {
            coarse: false,
            views: BTreeMap::new(),
            limit: ROOM,
            read_seconds: 0.0,
        }
    }
}

impl Trainer {
    /// Loads the target image of a view onto the device, at the resolution of the next step.
    pub(super) fn load_target(&mut self, id: usize) -> Result<()> {
        let coarse = self.training.config.coarse(self.training.iteration);
        if self.loaded_targets.coarse != coarse {
            self.unload_targets();
            self.loaded_targets.coarse = coarse;
        }
        if !self.loaded_targets.views.contains_key(&id) {
            let started = Instant::now();
            let mut image = self.targets.get(id)?.image;
            if self.training.config.depth_weight > 0.0 && image.depth.is_empty() {
                image.depth = vec![0.0; image.color.len()];
            }
            let image = if coarse { image.halved() } else { image };
            let bytes = image.bytes();
            self.engine.set_target(id, image)?;
            self.loaded_targets.views.insert(id, bytes);
            self.loaded_targets.read_seconds += started.elapsed().as_secs_f64();
        }
        Ok(())
    }

    /// Removes all target images from the device, because they are outdated.
    pub(super) fn unload_targets(&mut self) {
        std::mem::take(&mut self.loaded_targets.views)
            .into_keys()
            .for_each(|id| self.engine.remove_target(id));
    }

    /// Removes the image of view `id` after its step if the limit is exceeded. Each view is used
    /// once before any is used again, so no other choice causes fewer reads.
    pub(super) fn enforce_limit(&mut self, id: usize) {
        if self.loaded_targets.views.values().sum::<usize>() > self.loaded_targets.limit {
            self.loaded_targets.views.remove(&id);
            self.engine.remove_target(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::tests::{cloud, target};
    use crate::{Budget, CpuEngine, Error, Target, TargetImage, Targets, Trainer, TrainerConfig};
    use fastlgs_core::Camera;
    use glam::Vec3;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    const VIEWS: usize = 12;

    /// Returns views of 64x48 pixels. `reads` counts the reads, which fail after the first
    /// `broken`.
    fn views(reads: Arc<AtomicUsize>, broken: usize) -> Targets {
        let around = |k: usize| {
            let angle = k as f32 * 0.3;
            Camera::look_at(
                &format!("v{k}"),
                4.0 * Vec3::new(angle.sin(), 0.1, -angle.cos()),
                Vec3::ZERO,
                Vec3::Y,
                64,
                48,
                0.9,
            )
        };
        let image = || TargetImage {
            feature: Vec::new(),
            ..target(64, 48)
        };
        let whole: Targets = (0..VIEWS)
            .map(|k| Target {
                camera: around(k),
                image: image(),
                gain: [1.0; 3],
            })
            .collect::<Vec<_>>()
            .into();
        let (cameras, gains) = (whole.cameras.clone(), vec![[1.0; 3]; VIEWS]);
        Targets::new(cameras, gains, move |id| {
            let gone = reads.fetch_add(1, Ordering::Relaxed) >= broken;
            if gone {
                Err(Error::Picture("the photo is gone".into()))
            } else {
                Ok(whole.get(id)?.image)
            }
        })
    }

    /// Runs a training with room for `room` bytes of images. Returns its Gaussians, the number of
    /// reads, and the bytes of images on the device at the end.
    fn run(
        room: Option<usize>,
        broken: usize,
    ) -> crate::Result<(fastlgs_core::Gaussians, usize, u64)> {
        let reads = Arc::new(AtomicUsize::new(0));
        let config = TrainerConfig {
            iterations: 240,
            budget: Budget::Fixed(400),
            ..TrainerConfig::default()
        };
        let mut trainer = Trainer::new(
            Box::new(CpuEngine::new()),
            &cloud(200, 8, 0, false),
            views(reads.clone(), broken),
            config,
        )?;
        trainer.loaded_targets.limit = room.unwrap_or(trainer.loaded_targets.limit);
        trainer.run(None, |_, _| Ok::<_, Error>(()))?;
        Ok((
            trainer.gaussians()?,
            reads.load(Ordering::Relaxed),
            trainer.engine.memory().views,
        ))
    }

    #[test]
    fn the_limit_of_loaded_images_does_not_change_the_result() {
        let picture = 4 * 64 * 48;
        let (all, read, held) = run(None, usize::MAX).unwrap();
        // Once for the contrast, once at half and once at full resolution.
        assert_eq!((read, held), (3 * VIEWS, (VIEWS * picture) as u64));
        let (same, read, held) = run(Some(5 * picture), usize::MAX).unwrap();
        assert!(all == same, "the limit does not change the Gaussians");
        // At half the resolution, an image has a quarter of the bytes, and all fit.
        assert!(held <= 5 * picture as u64, "{held} bytes are held");
        assert!(
            (4 * VIEWS..15 * VIEWS).contains(&read),
            "{read} pictures were read"
        );
    }

    #[test]
    fn a_missing_photo_ends_the_run_with_its_error() {
        let message = run(Some(0), 3 * VIEWS).unwrap_err().to_string();
        assert_eq!(message, "the photo is gone");
        assert!(
            run(None, 0).is_err(),
            "a missing photo ends the run before the first step"
        );
    }
}
