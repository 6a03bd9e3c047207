//! Automatic budget: removes Gaussians that the training views hardly need (`--budget auto`).
//!
//! The scene first grows up to the limit. Then each Gaussian is scored by how much the training
//! views would change without it alone, as in Optimal Brain Damage (LeCun et al. 1990); see
//! [`Engine::saliency`](crate::Engine::saliency). Gaussians are removed in ascending order of their
//! scores, while the sum stays below `MAX_REMOVED_SHARE` times the squared error of the views.
//! Fewer are removed if the removal costs more than `MAX_REMOVAL_COST` dB.
//!
//! The limit is a share of the error. So an accurate scene keeps faint Gaussians, and an inaccurate
//! one loses those that could only fit noise. Together, the removed Gaussians cost more than the
//! sum of their scores. The rest of the run refines the remaining ones, and the final cost is close
//! to zero.

use serde::{Deserialize, Serialize};

/// Largest sum of the scores removed at once, as a share of the squared error of the training
/// views.
const MAX_REMOVED_SHARE: f64 = 0.05;
/// Largest loss of PSNR right after a removal, in dB; 3.01 dB is twice the squared error. In a
/// scene that fits its photos badly, the sum of scores alone would permit the removal of nearly all
/// Gaussians.
const MAX_REMOVAL_COST: f64 = 3.01;
/// Number of times that the share is halved before nothing is removed.
const HALVINGS: usize = 9;
/// Largest loss of PSNR on the validation views when the SH degree is lowered, in dB.
pub const DEGREE_LOSS: f64 = 0.02;
/// One of this many training views is a validation view.
pub(crate) const VALIDATION_INTERVAL: usize = 10;
/// Smallest number of views that must remain besides the validation views. With fewer, there are no
/// validation views: of 28 views, holding out three cost 1.7 dB.
const MIN_TRAINED_VIEWS: usize = 40;

/// Returns whether training view `index` of `count` is a validation view while the scene grows.
pub(crate) fn is_validation_view(index: usize, count: usize) -> bool {
    count >= MIN_TRAINED_VIEWS + count / VALIDATION_INTERVAL
        && index % VALIDATION_INTERVAL == VALIDATION_INTERVAL / 2
}

/// A removal of Gaussians and its cost, for reports.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Removal {
    /// Optimiser steps before it.
    pub iteration: u32,
    /// Gaussians before it.
    pub before: usize,
    /// Gaussians after it.
    pub after: usize,
    /// PSNR in dB before it, on the validation views or, if there are none, on every tenth view;
    /// `None` if the photos have no pixels to compare.
    pub psnr_before: Option<f64>,
    /// The same right after it, before the remaining Gaussians are refined.
    pub psnr_after: Option<f64>,
}

impl Removal {
    /// Returns whether it costs at most `MAX_REMOVAL_COST` dB, or the cost is unknown.
    pub(crate) fn is_acceptable(&self) -> bool {
        self.psnr_before
            .zip(self.psnr_after)
            .is_none_or(|(before, after)| before - after <= MAX_REMOVAL_COST)
    }
}

/// Returns candidate sets of Gaussians to keep, by index, in ascending size; the last one is all.
/// `changes` are the scores.
pub(crate) fn candidates(changes: &[f32], squared_error: f64) -> impl Iterator<Item = Vec<usize>> {
    let shares = std::iter::successors(Some(MAX_REMOVED_SHARE), |share| Some(0.5 * share))
        .take(1 + HALVINGS);
    shares
        .map(move |share| remaining(changes, share * squared_error))
        .chain(std::iter::once_with(|| (0..changes.len()).collect()))
}

/// Returns the indices that remain when the smallest changes are removed, up to the sum
/// `affordable`. Returns all indices if none would remain.
fn remaining(changes: &[f32], affordable: f64) -> Vec<usize> {
    let mut indices: Vec<usize> = (0..changes.len()).collect();
    indices.sort_by(|&a, &b| changes[a].total_cmp(&changes[b]).then(a.cmp(&b)));
    let mut sum = 0.0;
    let removed = indices.iter().take_while(|&&i| {
        sum += f64::from(changes[i]);
        sum <= affordable
    });
    let removed = removed.count();
    let mut kept = indices.split_off(if removed < changes.len() { removed } else { 0 });
    kept.sort_unstable();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::State;
    use crate::view::View;
    use crate::{CpuEngine, Engine};
    use fastlgs_core::{Camera, Gaussians};
    use glam::Vec3;

    #[test]
    fn gaussians_that_views_hardly_show_are_removed() {
        let camera = Camera::look_at(
            "a",
            Vec3::new(0.0, 0.0, -4.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let other = Camera::look_at(
            "b",
            Vec3::new(0.0, 0.0, 4.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let mut scene = Gaussians::default();
        for depth in [0.0, 0.1, 0.2] {
            scene.push_sphere(Vec3::Z * depth, 0.2, 0.99, [0.5; 3]);
        }
        scene.push_sphere(Vec3::Z * 0.3, 0.05, 0.99, [0.9; 3]);
        scene.push_sphere(Vec3::new(0.5, 0.5, 0.0), 0.05, 0.01, [0.5; 3]);
        let [camera, other] = [camera, other].map(|c| View::new(&c, scene.len(), 0));
        let mut engine = CpuEngine::new();
        engine.set_state(&State::of(&scene)).unwrap();
        let mut scores = vec![0.0; scene.len()];
        engine.saliency(camera, None, &mut scores).unwrap();
        let one = scores.clone();
        engine.saliency(other, None, &mut scores).unwrap();
        let both = scores;
        // The first view does not see the small Gaussian. Both views see the faint one, but hardly.
        assert!(
            one[3] < 1e-4 * one[0] && both[3] > 100.0 * one[3],
            "{one:?} {both:?}"
        );
        let error = f64::from(both[4]);
        assert_eq!(remaining(&one, 2.0 * error), [0, 1, 2]);
        assert_eq!(remaining(&both, 2.0 * error), [0, 1, 2, 3]);
        assert_eq!(remaining(&both, 0.5 * error), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn candidates_keep_more_and_more_and_costly_removals_are_rejected() {
        let changes: Vec<f32> = (0..100).map(|i| 0.01 * i as f32).collect();
        let stay: Vec<usize> = candidates(&changes, 100.0)
            .map(|places| places.len())
            .collect();
        assert_eq!(stay.len(), 2 + HALVINGS);
        assert!(stay.is_sorted() && stay[0] < stay[1], "{stay:?}");
        assert_eq!(stay[1 + HALVINGS], 100, "the last candidate keeps all");
        let removal = |psnr_after| Removal {
            iteration: 1,
            before: 2,
            after: 1,
            psnr_before: Some(20.0),
            psnr_after,
        };
        let bearable = [Some(17.5), Some(16.5), None].map(|after| removal(after).is_acceptable());
        assert_eq!(bearable, [true, false, true]);
    }

    #[test]
    fn removed_changes_sum_to_at_most_the_limit() {
        assert_eq!(remaining(&[0.5, 0.0, 0.4, 0.3, 9.0], 1.0), [0, 4]);
        assert_eq!(
            remaining(&[0.5, 0.0, 0.4, 0.3, 9.0], 0.0),
            [0, 2, 3, 4],
            "a Gaussian without effect is always removed"
        );
        assert_eq!(
            remaining(&[0.3; 5], 1.0),
            [3, 4],
            "of equal changes, the first are removed"
        );
        assert_eq!(
            remaining(&[0.3; 3], 1.0),
            [0, 1, 2],
            "if all could be removed, all are kept"
        );
    }
}
