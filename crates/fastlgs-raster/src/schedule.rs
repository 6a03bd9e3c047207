//! The schedule of a training run: learning rates, SH degree, resolution and density control.

use crate::floaters::FEW_VIEWS;
use crate::view::Rates;
use fastlgs_core::gaussians::{BASE_CHANNELS, channel};
use serde::{Deserialize, Serialize};

/// Largest number of Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Budget {
    /// Growth up to this number, then removal of unimportant Gaussians; see `budget.rs`.
    Auto(usize),
    /// Growth up to this number, without later removal.
    Fixed(usize),
}

impl Budget {
    /// Returns the largest number of Gaussians.
    pub fn max_gaussians(self) -> usize {
        match self {
            Self::Auto(n) | Self::Fixed(n) => n,
        }
    }
}

/// Whether training aligns the cameras to the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Alignment {
    /// The cameras stay as they are.
    Off,
    /// The cameras are aligned if the validation views gain from it.
    Auto,
    /// The cameras are aligned.
    On,
}

/// Configuration of a training run; part of every checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainerConfig {
    /// Optimiser steps.
    pub iterations: u32,
    /// Seed of view order, splitting and dropped Gaussians.
    pub seed: u64,
    /// Largest number of Gaussians, and whether unimportant ones are removed.
    pub budget: Budget,
    /// Channels that are trained.
    pub channels: crate::Channels,
    /// Number of first Gaussians that do not change. Density control would change them, so it must
    /// be off.
    #[serde(default)]
    pub frozen: usize,
    /// Highest SH degree of colour; the degree rises during training.
    pub sh_degree: u32,
    /// SH degree at the start: that of the first Gaussians if they were already trained, else 0.
    pub first_degree: u32,
    /// Weight of D-SSIM against L1 in both losses, 0 to 1 (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss.
    pub feature_weight: f32,
    /// Share of the iterations after which density control begins.
    #[serde(default = "default_refine_from")]
    pub refine_from: f32,
    /// Share of the iterations after which growth ends.
    pub refine_until: f32,
    /// Share of the iterations, from the start, that run at half the resolution.
    pub coarse_until: f32,
    /// Weight of the depth loss, or 0 for none.
    #[serde(default)]
    pub depth_weight: f32,
    /// Weight of the mean opacity in the loss, in standard deviations of the photos' brightness.
    #[serde(default = "default_mean_opacity_weight")]
    pub mean_opacity_weight: f32,
    /// Share of the Gaussians that the last step drops if photos are few (DropGaussian).
    #[serde(default = "default_max_dropout")]
    pub max_dropout: f32,
    /// 2-D Mip filter: lowers opacity to compensate for the dilation of small Gaussians.
    pub antialias: bool,
    /// Background colour.
    pub background: [f32; 3],
    /// Whether the background colour is learned.
    pub learn_background: bool,
    /// Whether the learning rates suit the number of iterations. If not, they are those of 3DGS.
    #[serde(default)]
    pub scaled_rates: bool,
    /// Whether an affine exposure is learned for each training view.
    pub exposure: bool,
    /// Whether the cameras of the training views are aligned.
    pub alignment: Alignment,
    /// Step after which the feature loss moves geometry too; `None` for never. The caller of
    /// [`Trainer::run`](crate::Trainer::run) then calls
    /// [`Trainer::couple`](crate::Trainer::couple).
    #[serde(default)]
    pub couples_at: Option<u32>,
}

impl TrainerConfig {
    /// Returns this configuration for Gaussians that are already trained: no density control, full
    /// resolution, no price on opacity, and the learning rates of 3DGS.
    #[must_use]
    pub fn for_refinement(self) -> Self {
        Self {
            refine_from: 1.0,
            refine_until: 0.0,
            coarse_until: 0.0,
            depth_weight: 0.0,
            mean_opacity_weight: 0.0,
            max_dropout: 0.0,
            scaled_rates: false,
            ..self
        }
    }

    /// Returns this configuration with the schedule of 3DGS: full resolution, growth from step 500
    /// to the middle of 30,000 steps, opacity resets instead of a price on opacity, its learning
    /// rates, and nothing for few photos.
    #[must_use]
    pub fn with_schedule_of_3dgs(self) -> Self {
        Self {
            refine_from: 500.0 / 30_000.0,
            refine_until: 0.5,
            coarse_until: 0.0,
            depth_weight: 0.0,
            mean_opacity_weight: 0.0,
            max_dropout: 0.0,
            scaled_rates: false,
            ..self
        }
    }
}

impl Default for TrainerConfig {
    fn default() -> Self {
        Self {
            iterations: 3000,
            seed: 0,
            budget: Budget::Fixed(60_000),
            channels: crate::Channels::Color,
            frozen: 0,
            sh_degree: 0,
            first_degree: 0,
            lambda: 0.2,
            feature_weight: 1.0,
            refine_from: default_refine_from(),
            refine_until: 0.4,
            coarse_until: 0.4,
            depth_weight: 0.0,
            mean_opacity_weight: default_mean_opacity_weight(),
            max_dropout: default_max_dropout(),
            antialias: false,
            background: [0.0; 3],
            learn_background: false,
            scaled_rates: true,
            exposure: false,
            alignment: Alignment::Off,
            couples_at: None,
        }
    }
}

/// Number of iterations for which 3DGS chose its learning rates.
const ITERATIONS_OF_3DGS: f32 = 30_000.0;
/// Largest factor on the learning rates of a short run.
const MAX_RATE_FACTOR: f32 = 5.0;
/// Share of the iterations after which scaled learning rates decay.
const DECAY_FROM: f32 = 0.5;
/// Factor on scaled learning rates at the end of the run.
const FINAL_DECAY: f32 = 0.1;

/// Share of the iterations after which density control begins.
fn default_refine_from() -> f32 {
    0.05
}

/// Target number of rounds of density control in a run, within the limits of `BETWEEN_ROUNDS`.
const DENSITY_ROUNDS: u32 = 16;
/// Smallest and largest number of steps between two rounds. After fewer steps, mean gradients are
/// noisy. With more, a long run has too few rounds.
const BETWEEN_ROUNDS: [u32; 2] = [25, 100];
/// Steps between opacity resets (3DGS).
const RESET_EVERY: u32 = 3000;
/// One of this many steps has a depth loss.
const DEPTH_EVERY: u32 = 4;
/// Shares of the iterations, from the end of growth on, at which an automatic budget removes
/// unimportant Gaussians.
const PRUNE_AFTER: [f32; 2] = [0.05, 0.25];
/// Shares of the iterations at which cameras are aligned: after shapes have formed, and early
/// enough for the scene to adapt.
const ALIGN_AT: [f32; 4] = [0.3, 0.45, 0.6, 0.75];
/// Weight of the mean opacity in the loss.
///
/// The loss is a difference of brightness, so a fixed weight that suits bright photos would remove
/// what dark photos show. The weight replaces opacity resets, from which runs of a few thousand
/// steps would not recover. It applies until the first removal, so that Gaussians that no photo
/// needs fade before.
fn default_mean_opacity_weight() -> f32 {
    0.04
}

/// Share of the Gaussians that the last step drops if photos are few.
fn default_max_dropout() -> f32 {
    0.2
}

impl TrainerConfig {
    /// Returns the share of the run that is done at a step.
    pub(crate) fn progress(&self, iteration: u32) -> f32 {
        iteration as f32 / self.iterations.max(1) as f32
    }

    fn step_at(&self, share: f32) -> u32 {
        (self.iterations as f32 * share) as u32
    }

    /// Returns the learning rates for a scene of size `extent`: those of 3DGS, scaled for short runs.
    ///
    /// The rates of means and features decay exponentially to a hundredth. At a constant 1e-2, two
    /// steps would move a feature farther than the paper's tau_ac. It would also oscillate where
    /// views disagree.
    ///
    /// n steps of length r in random directions go about r sqrt(n) far. So scaled rates are
    /// proportional to 1 / sqrt(iterations), and a short run goes as far as one of 3DGS. The rate of
    /// opacity is not scaled: with a larger one, the price on opacity removes faint walls. Those of
    /// scale and rotation are scaled by the root of the factor: with larger ones, Gaussians grow
    /// across the borders of objects.
    pub(crate) fn rates(&self, iteration: u32, extent: f32) -> Rates {
        let mut rates = [0.0; BASE_CHANNELS + 1];
        let decay = 0.01f32.powf(self.progress(iteration));
        let (factor, late_decay) = if self.scaled_rates {
            (self.rate_factor(), self.late_decay(iteration))
        } else {
            (1.0, 1.0)
        };
        rates[channel::MEAN].fill(1.6e-4 * extent * factor * decay);
        rates[channel::LOG_SCALE].fill(5e-3 * factor.sqrt() * late_decay);
        rates[channel::ROTATION].fill(1e-3 * factor.sqrt() * late_decay);
        rates[channel::OPACITY] = 5e-2 * late_decay;
        rates[channel::COLOR].fill(5e-3 * factor * late_decay);
        rates[channel::FEATURE].fill(1e-2 * decay);
        rates[BASE_CHANNELS] = 5e-3 / 20.0 * factor * late_decay;
        rates
    }

    /// Returns the factor on the learning rates of 3DGS for this number of iterations.
    fn rate_factor(&self) -> f32 {
        let missing = ITERATIONS_OF_3DGS / self.iterations.max(1) as f32;
        missing.sqrt().clamp(1.0, MAX_RATE_FACTOR)
    }

    /// Returns the factor by which scaled learning rates have decayed.
    fn late_decay(&self, iteration: u32) -> f32 {
        let late = (self.progress(iteration) - DECAY_FROM) / (1.0 - DECAY_FROM);
        FINAL_DECAY.powf(late.max(0.0))
    }

    /// Returns the SH degree in use: one more every 1,000 steps as in 3DGS, sooner in short runs.
    pub(crate) fn degree(&self, iteration: u32) -> u32 {
        let every = (self.iterations / 8).clamp(1, 1000);
        (iteration / every)
            .max(self.first_degree)
            .min(self.sh_degree)
    }

    /// Returns whether a step runs at half the resolution.
    pub(crate) fn coarse(&self, iteration: u32) -> bool {
        iteration < self.step_at(self.coarse_until)
    }

    /// Returns the share of the Gaussians that a step drops (DropGaussian, Park et al. 2025). With
    /// few photos it rises linearly. Occluded Gaussians then get gradients too, and the scene
    /// overfits less.
    pub(crate) fn dropout(&self, iteration: u32, views: usize) -> f32 {
        if views < FEW_VIEWS && self.channels.color() {
            self.max_dropout * self.progress(iteration)
        } else {
            0.0
        }
    }

    /// Returns the seed of a step's random choices.
    pub(crate) fn step_seed(&self, iteration: u32) -> u32 {
        iteration ^ (self.seed as u32).wrapping_mul(0x9e37_79b9)
    }

    /// Returns the number of steps between two rounds of density control.
    fn between_rounds(&self) -> u32 {
        let growing = self
            .step_at(self.refine_until)
            .saturating_sub(self.step_at(self.refine_from));
        (growing / DENSITY_ROUNDS).clamp(BETWEEN_ROUNDS[0], BETWEEN_ROUNDS[1])
    }

    /// Returns whether a step has a depth loss.
    pub(crate) fn trains_depth(&self, iteration: u32) -> bool {
        self.depth_weight > 0.0 && self.channels.color() && iteration.is_multiple_of(DEPTH_EVERY)
    }

    /// Returns whether the scene may still grow.
    pub(crate) fn grows(&self, iteration: u32) -> bool {
        iteration <= self.step_at(self.refine_until)
    }

    /// Returns whether a round of density control follows when `iteration` steps are done.
    pub(crate) fn refines(&self, iteration: u32) -> bool {
        let (from, until) = (
            self.step_at(self.refine_from),
            self.step_at(self.refine_until),
        );
        let due = iteration
            .checked_sub(from)
            .is_some_and(|since| since.is_multiple_of(self.between_rounds()));
        self.channels.color() && due && iteration > 0 && iteration <= until
    }

    /// Returns whether opacities are reset when `iteration` steps are done. The last reset leaves
    /// time to recover before growth ends.
    pub(crate) fn resets_opacity(&self, iteration: u32) -> bool {
        iteration.is_multiple_of(RESET_EVERY)
            && iteration + RESET_EVERY / 2 <= self.step_at(self.refine_until)
    }

    /// Returns whether unimportant Gaussians are removed when `iteration` steps are done.
    pub(crate) fn prunes(&self, iteration: u32) -> bool {
        let automatic = matches!(self.budget, Budget::Auto(_)) && self.channels.color();
        automatic
            && PRUNE_AFTER
                .iter()
                .any(|share| iteration == self.step_at(self.refine_until + share).max(1))
    }

    /// Returns whether the cameras are aligned to the scene when `iteration` steps are done.
    pub(crate) fn aligns(&self, iteration: u32) -> bool {
        let asked = self.alignment != Alignment::Off && self.channels.color();
        asked
            && ALIGN_AT
                .iter()
                .any(|share| iteration == self.step_at(*share).max(1))
    }

    /// Returns the weight of each Gaussian's opacity in the loss of a step. `contrast` is the
    /// standard deviation of the photos' brightness.
    pub(crate) fn opacity_weight(&self, iteration: u32, gaussians: usize, contrast: f32) -> f32 {
        let fades =
            self.channels.color() && iteration < self.step_at(self.refine_until + PRUNE_AFTER[0]);
        let each = 1.0 / gaussians as f32;
        if fades {
            self.mean_opacity_weight * contrast * each
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_schedule_of_3dgs() {
        let config = TrainerConfig {
            iterations: 30_000,
            budget: Budget::Fixed(1_000_000),
            sh_degree: 3,
            ..TrainerConfig::default()
        }
        .with_schedule_of_3dgs();
        let steps = |happens: &dyn Fn(u32) -> bool| -> Vec<u32> {
            (1..=30_000).filter(|i| happens(*i)).collect()
        };
        let refines = steps(&|i| config.refines(i));
        assert_eq!((refines[0], refines[1], refines[145]), (500, 600, 15_000));
        assert_eq!(refines.len(), 146);
        let resets = steps(&|i| config.resets_opacity(i));
        assert_eq!(resets, [3000, 6000, 9000, 12_000]);
        assert!(!config.coarse(0) && steps(&|i| config.prunes(i)).is_empty());
        assert_eq!(config.opacity_weight(1, 10, 1.0), 0.0);
        assert_eq!(config.dropout(29_999, 3), 0.0);
        let degrees = [999, 1000, 2000, 3000, 9000].map(|i| config.degree(i));
        assert_eq!(degrees, [0, 1, 2, 3, 3]);
        let rates = [0, 30_000].map(|i| config.rates(i, 1.0)[0]);
        assert!((rates[0] - 1.6e-4).abs() < 1e-9 && (rates[1] - 1.6e-6).abs() < 1e-9);
    }

    #[test]
    fn the_schedule_of_a_run() {
        let config = TrainerConfig {
            iterations: 8000,
            sh_degree: 3,
            budget: Budget::Auto(1000),
            ..TrainerConfig::default()
        };
        assert_eq!(
            [0, 999, 1000, 2500, 7999].map(|i| config.degree(i)),
            [0, 0, 1, 2, 3]
        );
        assert!(config.coarse(3199) && !config.coarse(3200));
        assert!(
            config.refines(400)
                && !config.refines(300)
                && config.refines(3200)
                && !config.refines(3300)
        );
        let rounds = |iterations: u32| {
            let config = TrainerConfig {
                iterations,
                ..config.clone()
            };
            (0..=iterations).filter(|i| config.refines(*i)).count()
        };
        assert_eq!([1000, 2000, 7000, 30_000].map(rounds), [15, 17, 25, 106]);
        let few = |views: usize, iteration: u32| config.dropout(iteration, views);
        assert_eq!(
            [few(24, 0), few(24, 4000), few(24, 8000), few(25, 8000)],
            [0.0, 0.1, 0.2, 0.0]
        );
        let frozen = TrainerConfig {
            channels: crate::Channels::Feature,
            ..config.clone()
        };
        assert_eq!(
            frozen.dropout(8000, 24),
            0.0,
            "cached lists contain all Gaussians"
        );
        assert_ne!(
            config.step_seed(5),
            TrainerConfig {
                seed: 1,
                ..config.clone()
            }
            .step_seed(5)
        );
        assert!(!config.resets_opacity(3000), "too late to recover");
        let long = TrainerConfig {
            iterations: 30_000,
            ..config.clone()
        };
        assert!(
            long.resets_opacity(3000) && long.resets_opacity(9000) && !long.resets_opacity(12_000)
        );
        assert!(config.prunes(3600) && config.prunes(5200) && !config.prunes(5201));
        let [first, middle, last] = [0, 4000, 8000].map(|i| config.rates(i, 2.0));
        // sqrt(30,000 / 8,000) times the rates of 3DGS.
        let factor = 3.75f32.sqrt();
        assert!((first[0] - factor * 3.2e-4).abs() < 1e-8);
        let scale = channel::LOG_SCALE.start;
        assert!((first[scale] - factor.sqrt() * 5e-3).abs() < 1e-8);
        assert!((last[0] - first[0] / 100.0).abs() < 1e-8);
        let colour = channel::COLOR.start;
        assert!((middle[colour] - factor * 5e-3).abs() < 1e-8);
        assert!((last[colour] - 0.1 * middle[colour]).abs() < 1e-8);
        assert!((middle[channel::OPACITY] - 5e-2).abs() < 1e-8);
        let short = TrainerConfig {
            iterations: 100,
            ..config.clone()
        };
        assert!((short.rates(0, 2.0)[0] - MAX_RATE_FACTOR * 3.2e-4).abs() < 1e-8);
        assert_eq!(
            [3599, 3600].map(|i| config.opacity_weight(i, 1, 0.5)),
            [0.5 * config.mean_opacity_weight, 0.0]
        );
        let continued = TrainerConfig {
            first_degree: 2,
            ..config.clone()
        };
        assert_eq!(
            [0, 1000, 3000].map(|i| continued.degree(i)),
            [2, 2, 3],
            "training continues at the degree of the scene"
        );
        let frozen = TrainerConfig {
            channels: crate::Channels::Feature,
            ..config
        };
        assert!(!frozen.refines(400) && !frozen.prunes(3600));
    }
}
