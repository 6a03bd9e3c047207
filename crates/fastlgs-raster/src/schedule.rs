//! What changes in the course of a training run: learning rates, colour degree, resolution, density control.

use crate::view::Rates;
use fastlgs_core::gaussians::BASE_CHANNELS;
use serde::{Deserialize, Serialize};

/// How the number of Gaussians is controlled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Strategy {
    /// Clone, split and prune with opacity resets (3DGS).
    Classic,
    /// Relocation, growth and noise (3DGS-MCMC).
    Mcmc,
}

/// How many Gaussians there may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Budget {
    /// As many as held-out quality gains from, and no more than this; see `budget.rs`.
    Auto(usize),
    /// Growth up to this number; nothing is removed for being unimportant.
    Fixed(usize),
}

impl Budget {
    /// The most Gaussians there may be.
    pub fn most(self) -> usize {
        match self {
            Self::Auto(n) | Self::Fixed(n) => n,
        }
    }
}

/// What a training run needs to know; part of every checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainConfig {
    /// Optimiser steps.
    pub iterations: u32,
    /// Seed of view order, splitting, relocation and noise.
    pub seed: u64,
    /// How many Gaussians there may be.
    pub budget: Budget,
    /// How their number is controlled.
    pub strategy: Strategy,
    /// What is trained.
    pub channels: crate::Channels,
    /// Highest SH degree of colour; it grows step by step.
    pub sh_degree: u32,
    /// SH degree at the start: that of a scene that was trained before, else 0.
    pub first_degree: u32,
    /// Share of D-SSIM in both losses (the paper's lambda).
    pub lambda: f32,
    /// Weight of the feature loss.
    pub feature_weight: f32,
    /// Steps between rounds of density control.
    pub refine_every: u32,
    /// Share of the iterations after which the scene no longer grows.
    pub refine_until: f32,
    /// Share of the iterations done at half the resolution.
    pub coarse_until: f32,
    /// 2-D Mip filter: opacity is lowered by what the dilation of small Gaussians adds.
    pub antialias: bool,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Learn that colour.
    pub learn_background: bool,
    /// Learn an affine exposure for each training view.
    pub exposure: bool,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            iterations: 3000,
            seed: 0,
            budget: Budget::Fixed(60_000),
            strategy: Strategy::Classic,
            channels: crate::Channels::Color,
            sh_degree: 0,
            first_degree: 0,
            lambda: 0.2,
            feature_weight: 1.0,
            refine_every: 100,
            refine_until: 0.5,
            coarse_until: 0.2,
            antialias: false,
            background: [0.0; 3],
            learn_background: false,
            exposure: false,
        }
    }
}

/// First step of density control.
const FIRST_REFINEMENT: u32 = 300;
/// Steps between opacity resets (3DGS).
const RESET_EVERY: u32 = 3000;
/// Shares of the iterations after which unimportant Gaussians are removed under an automatic budget.
const PRUNE_AT: [f32; 2] = [0.55, 0.75];
/// Noise scale of MCMC against the means' learning rate.
const NOISE: f32 = 5e5;

impl TrainConfig {
    /// Share of the run that is done at a step.
    fn progress(&self, iteration: u32) -> f32 {
        iteration as f32 / self.iterations.max(1) as f32
    }

    fn step_at(&self, share: f32) -> u32 {
        (self.iterations as f32 * share) as u32
    }

    /// Learning rates of 3DGS; those of means decay exponentially to a hundredth. `extent`: size of the scene.
    pub(crate) fn rates(&self, iteration: u32, extent: f32) -> Rates {
        let mut rates = [0.0; BASE_CHANNELS + 1];
        rates[0..3].fill(1.6e-4 * extent * 0.01f32.powf(self.progress(iteration)));
        rates[3..6].fill(5e-3);
        rates[6..10].fill(1e-3);
        rates[10] = 5e-2;
        rates[11..14].fill(5e-3);
        rates[14..17].fill(1e-2);
        rates[17] = 5e-3 / 20.0;
        rates
    }

    /// SH degree in use: one more every 1,000 steps as in 3DGS, sooner in short runs.
    pub(crate) fn degree(&self, iteration: u32) -> u32 {
        let every = (self.iterations / 8).clamp(1, 1000);
        (iteration / every).max(self.first_degree).min(self.sh_degree)
    }

    /// Whether a step is done at half the resolution.
    pub(crate) fn coarse(&self, iteration: u32) -> bool {
        iteration < self.step_at(self.coarse_until)
    }

    /// Whether a round of density control follows the step that made it `iteration` steps.
    pub(crate) fn refines(&self, iteration: u32) -> bool {
        let until = self.step_at(self.refine_until);
        let geometry = self.channels.color();
        geometry && iteration.is_multiple_of(self.refine_every) && iteration >= FIRST_REFINEMENT.min(until) && iteration <= until
    }

    /// Whether opacities are reset then: not in the last round, after which they could not recover.
    pub(crate) fn resets_opacity(&self, iteration: u32) -> bool {
        self.strategy == Strategy::Classic
            && iteration.is_multiple_of(RESET_EVERY)
            && iteration + RESET_EVERY / 2 <= self.step_at(self.refine_until)
    }

    /// Whether unimportant Gaussians are removed then.
    pub(crate) fn prunes(&self, iteration: u32) -> bool {
        let automatic = matches!(self.budget, Budget::Auto(_)) && self.channels.color();
        automatic && PRUNE_AT.iter().any(|share| iteration == self.step_at(*share).max(1))
    }

    /// Amount of the MCMC noise, where there is any.
    pub(crate) fn noise(&self, mean_rate: f32) -> Option<f32> {
        (self.strategy == Strategy::Mcmc).then_some(NOISE * mean_rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_schedule_of_a_run() {
        let config = TrainConfig { iterations: 8000, sh_degree: 3, budget: Budget::Auto(1000), ..TrainConfig::default() };
        assert_eq!([0, 999, 1000, 2500, 7999].map(|i| config.degree(i)), [0, 0, 1, 2, 3]);
        assert!(config.coarse(1599) && !config.coarse(1600));
        assert!(config.refines(300) && !config.refines(200) && config.refines(4000) && !config.refines(4100));
        assert!(!config.resets_opacity(3000), "too late to recover");
        let long = TrainConfig { iterations: 30_000, ..config.clone() };
        assert!(long.resets_opacity(3000) && long.resets_opacity(12_000) && !long.resets_opacity(15_000));
        assert!(config.prunes(4400) && config.prunes(6000) && !config.prunes(6001));
        let (first, last) = (config.rates(0, 2.0)[0], config.rates(8000, 2.0)[0]);
        assert!((first - 3.2e-4).abs() < 1e-8 && (last - first / 100.0).abs() < 1e-8);
        let continued = TrainConfig { first_degree: 2, ..config.clone() };
        assert_eq!([0, 1000, 3000].map(|i| continued.degree(i)), [2, 2, 3], "colour that is there already stays");
        let frozen = TrainConfig { channels: crate::Channels::Feature, ..config };
        assert!(!frozen.refines(300) && !frozen.prunes(4400));
    }
}
