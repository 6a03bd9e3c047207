//! The pictures on the device: all of them where there is room, and read again where there is not.

use super::Trainer;
use crate::Result;
use std::collections::BTreeMap;
use std::time::Instant;

/// Bytes of pictures that stay on the device.
const ROOM: usize = 1 << 30;

/// Which views' pictures are on the device.
pub(super) struct Shown {
    /// Whether they are there at half the resolution.
    coarse: bool,
    /// Bytes of each.
    views: BTreeMap<usize, usize>,
    /// Bytes that may stay.
    pub room: usize,
    /// Seconds in which pictures were read: what steps cost, a short run does not tell by them.
    pub reading: f64,
}

impl Default for Shown {
    fn default() -> Self {
        Self { coarse: false, views: BTreeMap::new(), room: ROOM, reading: 0.0 }
    }
}

impl Trainer {
    /// Puts what a view shows on the device, at the resolution of the coming step.
    pub(super) fn show(&mut self, id: usize) -> Result<()> {
        let coarse = self.course.config.coarse(self.course.iteration);
        if self.shown.coarse != coarse {
            self.hide();
            self.shown.coarse = coarse;
        }
        if !self.shown.views.contains_key(&id) {
            let started = Instant::now();
            let image = self.targets.get(id)?.image;
            let image = if coarse { image.halved() } else { image };
            let bytes = image.bytes();
            self.engine.set_target(id, image)?;
            self.shown.views.insert(id, bytes);
            self.shown.reading += started.elapsed().as_secs_f64();
        }
        Ok(())
    }

    /// Takes all pictures from the device, as they are no longer what shall be seen.
    pub(super) fn hide(&mut self) {
        std::mem::take(&mut self.shown.views).into_keys().for_each(|id| self.engine.forget_target(id));
    }

    /// After its step, what came when there was no room left goes again. Views come once each before any comes again: no other choice of those that
    /// stay would be read less often.
    pub(super) fn make_room(&mut self, id: usize) {
        if self.shown.views.values().sum::<usize>() > self.shown.room {
            self.shown.views.remove(&id);
            self.engine.forget_target(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::tests::{cloud, target};
    use crate::{Budget, CpuEngine, Error, Target, TargetImage, Targets, TrainConfig, Trainer};
    use fastlgs_core::Camera;
    use glam::Vec3;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    const VIEWS: usize = 12;

    /// Views of 64x48 pixels; `reads` counts how often one is read, and `broken` cannot be after so many times.
    fn views(reads: Arc<AtomicUsize>, broken: usize) -> Targets {
        let around = |k: usize| {
            let angle = k as f32 * 0.3;
            Camera::look_at(&format!("v{k}"), 4.0 * Vec3::new(angle.sin(), 0.1, -angle.cos()), Vec3::ZERO, Vec3::Y, 64, 48, 0.9)
        };
        let image = || TargetImage { feature: Vec::new(), ..target(64, 48) };
        let whole: Targets = (0..VIEWS).map(|k| Target { camera: around(k), image: image(), gain: [1.0; 3] }).collect::<Vec<_>>().into();
        let (cameras, gains) = (whole.cameras.clone(), vec![[1.0; 3]; VIEWS]);
        Targets::new(cameras, gains, move |id| {
            let gone = reads.fetch_add(1, Ordering::Relaxed) >= broken;
            if gone { Err(Error::Picture("the photo is gone".into())) } else { Ok(whole.get(id)?.image) }
        })
    }

    /// A run with room for so many bytes: its Gaussians, how many pictures were read, and the bytes of pictures on the device at its end.
    fn run(room: Option<usize>, broken: usize) -> crate::Result<(fastlgs_core::Gaussians, usize, u64)> {
        let reads = Arc::new(AtomicUsize::new(0));
        let config = TrainConfig { iterations: 240, budget: Budget::Fixed(400), ..TrainConfig::default() };
        let mut trainer = Trainer::new(Box::new(CpuEngine::new()), &cloud(200, 8, 0, false), views(reads.clone(), broken), config)?;
        trainer.shown.room = room.unwrap_or(trainer.shown.room);
        trainer.run(None, |_, _| Ok::<_, Error>(()))?;
        Ok((trainer.gaussians()?, reads.load(Ordering::Relaxed), trainer.engine.memory().views))
    }

    #[test]
    fn room_changes_memory_and_nothing_else() {
        let picture = 4 * 64 * 48;
        let (all, read, held) = run(None, usize::MAX).unwrap();
        // Once for their contrast, once at half the resolution, once at all of it.
        assert_eq!((read, held), (3 * VIEWS, (VIEWS * picture) as u64));
        let (same, read, held) = run(Some(5 * picture), usize::MAX).unwrap();
        assert!(all == same, "the same Gaussians, wherever the pictures were");
        // Half of the run is at a quarter of the bytes, for which there is room.
        assert!(held <= 5 * picture as u64, "{held} bytes are held");
        assert!((4 * VIEWS..15 * VIEWS).contains(&read), "{read} pictures were read");
    }

    #[test]
    fn a_picture_that_went_missing_ends_the_run_in_words() {
        let message = run(Some(0), 3 * VIEWS).unwrap_err().to_string();
        assert_eq!(message, "the photo is gone");
        assert!(run(None, 0).is_err(), "and one that never was, before the first step");
    }
}
