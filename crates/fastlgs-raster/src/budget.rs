//! No more Gaussians than the scene needs (`--budget auto`).
//!
//! *Growth* stops when it no longer pays: some training views are kept aside and watched; now and then, if
//! the scene has grown by at least `GROWTH` since the last look and the watched views gained less than `GAIN` dB a
//! doubling, it may grow no further, and the watched views join the training.
//!
//! *Pruning* then removes Gaussians that nobody sees: those whose largest blending weight over all training views stays under [`MIN_WEIGHT`]
//! (as in RadSplat, Niemeyer et al. 2024). What is left is refined by the rest of the run. What that costs at once (fox: 9 dB of views that
//! are trained on) says little about what it costs in the end: asking for an affordable price there left 99,546 Gaussians instead of 41,154, for 0.03 dB.

use crate::lift;
use crate::view::View;
use fastlgs_core::Gaussians;
use serde::{Deserialize, Serialize};

/// Relative growth that has to show an effect.
const GROWTH: f64 = 0.1;
/// Least gain on the watched views, in dB, for twice as many Gaussians.
const GAIN: f64 = 0.5;
/// Largest blending weight below which a Gaussian is removed.
pub const MIN_WEIGHT: f32 = 0.1;
/// Colour keeps the lowest SH degree that loses no more than this on the watched views, in dB.
pub const DEGREE_LOSS: f64 = 0.02;
/// Every so many training views one is watched.
pub(crate) const WATCHED: usize = 10;
/// Where fewer would be left to train on, none is: of 28 views, the three that wait cost the held-out ones 1.7 dB.
const FEW: usize = 40;

/// Whether training view `index` of `count` is watched and not trained on while the scene grows.
pub(crate) fn is_watched(index: usize, count: usize) -> bool {
    count >= FEW + count / WATCHED && index % WATCHED == WATCHED / 2
}

/// The rule that ends growth.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Growth {
    /// The scene may grow no further.
    pub stopped: bool,
    /// Gaussians and PSNR of the watched views at the last look.
    last: Option<(usize, f64)>,
}

impl Growth {
    /// Takes a look: so many Gaussians give so many dB.
    pub fn look(&mut self, gaussians: usize, psnr: f64) {
        if let Some((before, then)) = self.last {
            let grown = gaussians as f64 / before as f64;
            if grown < 1.0 + GROWTH {
                return;
            }
            self.stopped |= psnr - then < GAIN * grown.log2();
        }
        self.last = Some((gaussians, psnr));
    }

    /// Forgets the last look, with which the next would say nothing.
    pub fn forget(&mut self) {
        self.last = None;
    }
}

/// What a removal cost, for reports.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Removal {
    /// Steps done before it.
    pub iteration: u32,
    /// Gaussians before it.
    pub before: usize,
    /// Gaussians after it.
    pub after: usize,
    /// PSNR in dB of the watched views before it; none where no view is watched.
    pub psnr_before: Option<f64>,
    /// The same right after it, before what is left was refined.
    pub psnr_after: Option<f64>,
}

/// Largest blending weight of each Gaussian over all pixels of all views; those below `least` need not be told.
pub fn largest_weights(scene: &Gaussians, views: &[View], least: f32) -> Vec<f32> {
    let mut largest = vec![0.0f32; scene.len()];
    for view in views {
        largest.iter_mut().zip(lift::largest_weights(scene, view, least)).for_each(|(l, w)| *l = l.max(w));
    }
    largest
}

/// Places of those that reach a threshold.
pub(crate) fn reaching(largest: &[f32], threshold: f32) -> Vec<usize> {
    (0..largest.len()).filter(|&i| largest[i] >= threshold).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Camera;
    use glam::Vec3;

    #[test]
    fn growth_stops_when_it_does_not_pay() {
        let mut growth = Growth::default();
        growth.look(1000, 20.0);
        growth.look(2000, 22.0);
        growth.look(2050, 22.01); // hardly grown: no verdict
        assert!(!growth.stopped);
        growth.look(3000, 22.05);
        assert!(growth.stopped);
    }

    #[test]
    fn what_is_hidden_everywhere_is_not_seen() {
        let camera = Camera::look_at("a", Vec3::new(0.0, 0.0, -4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let other = Camera::look_at("b", Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let mut scene = Gaussians::default();
        for depth in [0.0, 0.1, 0.2] {
            scene.push_sphere(Vec3::Z * depth, 0.2, 0.99, [0.5; 3]);
        }
        scene.push_sphere(Vec3::Z * 0.3, 0.05, 0.99, [0.5; 3]);
        let [camera, other] = [camera, other].map(|c| View::new(&c, scene.len(), 0));
        assert_eq!(reaching(&largest_weights(&scene, &[camera], MIN_WEIGHT), MIN_WEIGHT), [0, 1, 2]);
        assert_eq!(reaching(&largest_weights(&scene, &[camera, other], MIN_WEIGHT), MIN_WEIGHT), [0, 1, 2, 3]);
    }
}
