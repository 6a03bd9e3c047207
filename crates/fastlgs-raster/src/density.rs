//! Density control as named operations on the training state: clone, split, prune and opacity reset
//! (3DGS, section 5).

use fastlgs_core::Gaussians;
use fastlgs_core::curve::morton_order;
use fastlgs_core::gaussians::{channel, channels, logit, sigmoid};
use fastlgs_core::rng::Rng;
use glam::{Quat, Vec3};
use rayon::prelude::*;

/// Trained values and both Adam moments, each `[channels(sh_degree)][n]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// SH degree of colour.
    pub sh_degree: u32,
    /// Trained values.
    pub params: Vec<f32>,
    /// First moment.
    pub moment1: Vec<f32>,
    /// Second moment.
    pub moment2: Vec<f32>,
}

/// Thresholds of 3DGS.
#[derive(Clone, Copy, Debug)]
pub struct DensityConfig {
    /// Mean gradient of the projected centre (in half-image units) above which a Gaussian is cloned
    /// or split.
    pub gradient: f32,
    /// Largest scale, as a share of the scene extent, up to which a Gaussian is cloned instead of
    /// split.
    pub split_scale: f32,
    /// Opacity below which a Gaussian is removed.
    pub min_opacity: f32,
    /// Largest number of Gaussians.
    pub budget: usize,
}

impl Default for DensityConfig {
    fn default() -> Self {
        Self {
            gradient: 2e-4,
            split_scale: 0.01,
            min_opacity: 0.005,
            budget: 60_000,
        }
    }
}

/// Numbers of Gaussians that one round changed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Copied in place.
    pub cloned: usize,
    /// Replaced by two smaller ones.
    pub split: usize,
    /// Removed.
    pub pruned: usize,
}

impl State {
    /// Returns the initial state of a scene, with zero moments.
    pub fn of(scene: &Gaussians) -> Self {
        let params = scene.to_channels();
        let zeros = vec![0.0; params.len()];
        Self {
            sh_degree: scene.sh_degree,
            params,
            moment1: zeros.clone(),
            moment2: zeros,
        }
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.params.len() / channels(self.sh_degree)
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.params.is_empty()
    }

    fn vec3(&self, channel: usize, i: usize) -> Vec3 {
        let n = self.len();
        Vec3::new(
            self.params[channel * n + i],
            self.params[(channel + 1) * n + i],
            self.params[(channel + 2) * n + i],
        )
    }

    fn opacity(&self, i: usize) -> f32 {
        sigmoid(self.params[channel::OPACITY * self.len() + i])
    }

    fn largest_scale(&self, i: usize) -> f32 {
        self.vec3(channel::LOG_SCALE.start, i).max_element().exp()
    }

    /// Returns the state whose Gaussian k is a copy of `sources[k].0`, with zero moments if
    /// `sources[k].1`.
    fn gathered(&self, sources: &[(usize, bool)]) -> Self {
        let n = self.len();
        let pick = |values: &[f32], keep_fresh: bool| {
            let mut picked = vec![0.0; channels(self.sh_degree) * sources.len()];
            picked
                .par_chunks_mut(sources.len().max(1))
                .zip(values.par_chunks(n.max(1)))
                .for_each(|(out, values)| {
                    for (value, &(i, fresh)) in out.iter_mut().zip(sources) {
                        *value = if fresh && !keep_fresh { 0.0 } else { values[i] };
                    }
                });
            picked
        };
        let (params, moment1, moment2) = (
            pick(&self.params, true),
            pick(&self.moment1, false),
            pick(&self.moment2, false),
        );
        Self {
            sh_degree: self.sh_degree,
            params,
            moment1,
            moment2,
        }
    }

    /// Keeps only the Gaussians with these indices, in this order.
    pub fn keep(&mut self, indices: &[usize]) {
        let sources: Vec<(usize, bool)> = indices.iter().map(|&i| (i, false)).collect();
        *self = self.gathered(&sources);
    }

    /// Raises the SH degree. The new coefficients and their moments are 0.
    pub(crate) fn raise_degree(&mut self, degree: u32) {
        let values = channels(degree) * self.len();
        for column in [&mut self.params, &mut self.moment1, &mut self.moment2] {
            column.resize(values, 0.0);
        }
        self.sh_degree = degree;
    }

    /// Sorts the Gaussians along a Morton curve. Neighbours in memory are then mostly neighbours in
    /// images, so a step reads contiguous memory.
    pub(crate) fn sort_along_curve(&mut self) {
        let means: Vec<Vec3> = (0..self.len())
            .map(|i| self.vec3(channel::MEAN.start, i))
            .collect();
        self.keep(&morton_order(&means));
    }

    /// Removes the Gaussians for whose mean `free` returns true. Returns their number.
    pub(crate) fn remove_where(&mut self, free: impl Fn(Vec3) -> bool + Sync) -> usize {
        let n = self.len();
        let places: Vec<usize> = (0..n)
            .into_par_iter()
            .filter(|&i| !free(self.vec3(channel::MEAN.start, i)))
            .collect();
        if places.len() < n {
            self.keep(&places);
        }
        n - places.len()
    }

    fn is_finite(&self, i: usize) -> bool {
        (0..channels(self.sh_degree)).all(|c| self.params[c * self.len() + i].is_finite())
    }

    /// Removes Gaussians with a value that is not finite. Returns how many.
    pub fn keep_finite(&mut self) -> usize {
        let n = self.len();
        let places: Vec<usize> = (0..n).filter(|&i| self.is_finite(i)).collect();
        if places.len() < n {
            self.keep(&places);
        }
        n - places.len()
    }

    /// Moves Gaussian `i` to a sample of its own distribution and divides its scales by 1.6 (3DGS).
    fn resample(&mut self, i: usize, rng: &mut Rng) {
        let n = self.len();
        let scale = self.vec3(channel::LOG_SCALE.start, i).map(f32::exp);
        let q = [6, 7, 8, 9].map(|c| self.params[c * n + i]);
        let rotation = Quat::from_xyzw(q[1], q[2], q[3], q[0]).normalize();
        let offset = rotation * (scale * Vec3::new(rng.normal(), rng.normal(), rng.normal()));
        for k in 0..3 {
            self.params[k * n + i] += offset[k];
            self.params[(3 + k) * n + i] -= 1.6f32.ln();
        }
    }
}

/// Returns the Gaussians whose mean gradient exceeds the threshold, in descending order, at most
/// `room`. `stats` is `[2][n]`: sums of gradients, then how often each Gaussian was drawn.
fn too_coarse(stats: &[f32], threshold: f32, room: usize) -> Vec<usize> {
    let n = stats.len() / 2;
    let mean = |i: usize| stats[i] / stats[n + i].max(1.0);
    let mut found: Vec<usize> = (0..n).filter(|&i| mean(i) > threshold).collect();
    found.sort_by(|&a, &b| mean(b).total_cmp(&mean(a)).then(a.cmp(&b)));
    found.truncate(room);
    found
}

/// Runs one round: prunes faint, too large and non-finite Gaussians, clones small coarse ones and
/// splits large coarse ones, within the budget.
pub fn refine(
    state: &mut State,
    stats: &[f32],
    extent: f32,
    config: &DensityConfig,
    rng: &mut Rng,
) -> Counts {
    let n = state.len();
    let keeps = |i: usize| state.is_finite(i) && state.opacity(i) >= config.min_opacity;
    let keep: Vec<bool> = (0..n).map(keeps).collect();
    let kept = keep.iter().filter(|k| **k).count();
    let mut counts = Counts {
        pruned: n - kept,
        ..Counts::default()
    };
    let mut coarse = vec![false; n];
    for i in too_coarse(stats, config.gradient, config.budget.saturating_sub(kept)) {
        coarse[i] = keep[i];
    }
    let (mut sources, mut moved) = (Vec::with_capacity(n), Vec::new());
    for i in (0..n).filter(|&i| keep[i]) {
        if !coarse[i] {
            sources.push((i, false));
        } else if state.largest_scale(i) <= config.split_scale * extent {
            sources.extend([(i, false), (i, true)]);
            counts.cloned += 1;
        } else {
            moved.extend([sources.len(), sources.len() + 1]);
            sources.extend([(i, true), (i, true)]);
            counts.split += 1;
        }
    }
    *state = state.gathered(&sources);
    for i in moved {
        state.resample(i, rng);
    }
    counts
}

/// Lowers every opacity to at most `ceiling` and clears its moments (3DGS). Floaters then stay
/// faint, because no photo needs them.
pub fn reset_opacity(state: &mut State, ceiling: f32) {
    let n = state.len();
    for k in channel::OPACITY * n..(channel::OPACITY + 1) * n {
        state.params[k] = state.params[k].min(logit(ceiling));
        state.moment1[k] = 0.0;
        state.moment2[k] = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(scene: &Gaussians) -> State {
        let state = State::of(scene);
        let ones = vec![1.0; state.params.len()];
        State {
            moment1: ones.clone(),
            moment2: ones,
            ..state
        }
    }

    #[test]
    fn faint_gaussians_are_pruned_small_cloned_and_large_split() {
        let mut scene = Gaussians::default();
        scene.push_sphere(Vec3::ZERO, 0.001, 0.5, [0.5; 3]);
        scene.push_sphere(Vec3::X, 0.5, 0.5, [0.5; 3]);
        scene.push_sphere(Vec3::Y, 0.1, 0.001, [0.5; 3]);
        scene.push_sphere(Vec3::Z, 0.1, 0.5, [0.5; 3]);
        let mut s = state(&scene);
        // Gradient sums, then how often each Gaussian was drawn.
        let stats = [1.0, 1.0, 1.0, 0.0, 10.0, 10.0, 10.0, 10.0];
        let counts = refine(
            &mut s,
            &stats,
            1.0,
            &DensityConfig::default(),
            &mut Rng::new(1, "test"),
        );
        assert_eq!(
            counts,
            Counts {
                cloned: 1,
                split: 1,
                pruned: 1
            }
        );
        let after = Gaussians::from_channels(&s.params, 0, None);
        assert_eq!(after.len(), 5);
        assert_eq!(after.means[0], after.means[1]);
        assert!((after.log_scales[2].x - (0.5f32 / 1.6).ln()).abs() < 1e-5);
        assert_ne!(after.means[2], after.means[3]);
        assert_eq!(
            (s.moment1[0], s.moment1[1]),
            (1.0, 0.0),
            "a clone starts without momentum"
        );
        reset_opacity(&mut s, 0.01);
        assert!((s.opacity(0) - 0.01).abs() < 1e-4);
    }

    #[test]
    fn refine_never_exceeds_the_budget() {
        let mut scene = Gaussians::default();
        (0..10).for_each(|i| scene.push_sphere(Vec3::splat(i as f32), 0.5, 0.5, [0.5; 3]));
        let mut s = state(&scene);
        let config = DensityConfig {
            budget: 13,
            ..DensityConfig::default()
        };
        refine(&mut s, &[1.0; 20], 1.0, &config, &mut Rng::new(1, "test"));
        assert_eq!(s.len(), 13);
    }

    #[test]
    fn gaussians_with_values_that_are_not_finite_are_removed() {
        let mut scene = Gaussians::default();
        (0..4).for_each(|i| scene.push_sphere(Vec3::splat(i as f32), 0.5, 0.5, [0.5; 3]));
        scene.means[1].x = f32::NAN;
        scene.log_scales[2].y = f32::INFINITY;
        let mut s = state(&scene);
        assert_eq!(s.keep_finite(), 2);
        let mut s = state(&scene);
        assert_eq!(
            refine(
                &mut s,
                &[0.0; 8],
                1.0,
                &DensityConfig::default(),
                &mut Rng::new(1, "test")
            )
            .pruned,
            2
        );
        assert_eq!(s.len(), 2);
    }
}
