//! What changes in the course of a training run: learning rates, colour degree, resolution, density control.

use crate::floaters::FEW_VIEWS;
use crate::view::Rates;
use fastlgs_core::gaussians::BASE_CHANNELS;
use serde::{Deserialize, Serialize};

/// How many Gaussians there may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Budget {
    /// Growth up to this number, and then as many as the training views would miss; see `budget.rs`.
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

/// Whether cameras are moved to where the scene says that they were.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Alignment {
    /// No.
    Off,
    /// Where views that are not trained on show that it pays.
    Auto,
    /// Yes.
    On,
}

/// What a training run needs to know; part of every checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainConfig {
    /// Optimiser steps.
    pub iterations: u32,
    /// Seed of view order, splitting and left-out Gaussians.
    pub seed: u64,
    /// How many Gaussians there may be.
    pub budget: Budget,
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
    /// Move the cameras of the training views.
    pub alignment: Alignment,
    /// Steps after which the caller has masks shape the Gaussians ([`Trainer::couple`](crate::Trainer::couple)).
    #[serde(default)]
    pub couples_at: Option<u32>,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            iterations: 3000,
            seed: 0,
            budget: Budget::Fixed(60_000),
            channels: crate::Channels::Color,
            sh_degree: 0,
            first_degree: 0,
            lambda: 0.2,
            feature_weight: 1.0,
            refine_until: 0.4,
            coarse_until: 0.4,
            antialias: false,
            background: [0.0; 3],
            learn_background: false,
            exposure: false,
            alignment: Alignment::Off,
            couples_at: None,
        }
    }
}

/// Share of the iterations after which density control begins.
const REFINE_FROM: f32 = 0.05;
/// Rounds of density control that a run has room for, as far as the steps between two of them allow.
const ROUNDS: u32 = 16;
/// Fewest and most steps between two rounds: fewer tell little about gradients, more waste a long run.
const BETWEEN_ROUNDS: [u32; 2] = [25, 100];
/// Steps between opacity resets (3DGS).
const RESET_EVERY: u32 = 3000;
/// Shares of the iterations after the end of growth at which unimportant Gaussians are removed under an automatic budget.
const PRUNE_AFTER: [f32; 2] = [0.05, 0.25];
/// Shares of the iterations after which cameras are aligned: once shapes stand, and so that what is left can follow.
const ALIGN_AT: [f32; 4] = [0.3, 0.45, 0.6, 0.75];
/// What a mean opacity of 1 costs in standard deviations of the photos' brightness: the loss is a difference of brightness, and
/// a fixed price that suits bright photos takes from dark ones what they show. It stands for opacity resets, from which runs of a few thousand steps
/// would not recover, and ends with the first removal: what no photo asks for fades, and goes.
const OPACITY_PRICE: f32 = 0.04;
/// Share of the Gaussians that the last step leaves out where photos are few (DropGaussian).
const LEFT_OUT: f32 = 0.2;

impl TrainConfig {
    /// Share of the run that is done at a step.
    pub(crate) fn progress(&self, iteration: u32) -> f32 {
        iteration as f32 / self.iterations.max(1) as f32
    }

    fn step_at(&self, share: f32) -> u32 {
        (self.iterations as f32 * share) as u32
    }

    /// Learning rates of 3DGS; those of means decay exponentially to a hundredth, and so do those of features: at a constant 1e-2, two steps
    /// lead out of what the paper's tau_ac accepts, and where views disagree a feature never comes to rest. `extent`: size of the scene.
    pub(crate) fn rates(&self, iteration: u32, extent: f32) -> Rates {
        let mut rates = [0.0; BASE_CHANNELS + 1];
        let decay = 0.01f32.powf(self.progress(iteration));
        rates[0..3].fill(1.6e-4 * extent * decay);
        rates[3..6].fill(5e-3);
        rates[6..10].fill(1e-3);
        rates[10] = 5e-2;
        rates[11..14].fill(5e-3);
        rates[14..17].fill(1e-2 * decay);
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

    /// Share of the Gaussians that a step leaves out: with few photos, more and more of them, so that what only hides behind others for a photo
    /// gets its light as well, and none learns its photos by heart (DropGaussian, Park et al. 2025).
    pub(crate) fn left_out(&self, iteration: u32, views: usize) -> f32 {
        if views < FEW_VIEWS && self.channels.color() { LEFT_OUT * self.progress(iteration) } else { 0.0 }
    }

    /// Number of a step's draw.
    pub(crate) fn draw(&self, iteration: u32) -> u32 {
        iteration ^ (self.seed as u32).wrapping_mul(0x9e37_79b9)
    }

    /// Steps between two rounds of density control.
    fn between_rounds(&self) -> u32 {
        let growing = self.step_at(self.refine_until).saturating_sub(self.step_at(REFINE_FROM));
        (growing / ROUNDS).clamp(BETWEEN_ROUNDS[0], BETWEEN_ROUNDS[1])
    }

    /// Whether the scene may still grow.
    pub(crate) fn grows(&self, iteration: u32) -> bool {
        iteration <= self.step_at(self.refine_until)
    }

    /// Whether a round of density control follows the step that made it `iteration` steps.
    pub(crate) fn refines(&self, iteration: u32) -> bool {
        let (from, until) = (self.step_at(REFINE_FROM), self.step_at(self.refine_until));
        let due = iteration.checked_sub(from).is_some_and(|since| since.is_multiple_of(self.between_rounds()));
        self.channels.color() && due && iteration > 0 && iteration <= until
    }

    /// Whether opacities are reset then: not so late that they could not recover before growth ends.
    pub(crate) fn resets_opacity(&self, iteration: u32) -> bool {
        iteration.is_multiple_of(RESET_EVERY) && iteration + RESET_EVERY / 2 <= self.step_at(self.refine_until)
    }

    /// Whether unimportant Gaussians are removed then.
    pub(crate) fn prunes(&self, iteration: u32) -> bool {
        let automatic = matches!(self.budget, Budget::Auto(_)) && self.channels.color();
        automatic && PRUNE_AFTER.iter().any(|share| iteration == self.step_at(self.refine_until + share).max(1))
    }

    /// Whether the cameras of the training views are aligned to the scene then.
    pub(crate) fn aligns(&self, iteration: u32) -> bool {
        let asked = self.alignment != Alignment::Off && self.channels.color();
        asked && ALIGN_AT.iter().any(|share| iteration == self.step_at(*share).max(1))
    }

    /// Weight of each Gaussian's opacity in the loss of a step. `contrast`: standard deviation of the photos' brightness.
    pub(crate) fn opacity_weight(&self, iteration: u32, gaussians: usize, contrast: f32) -> f32 {
        let fades = self.channels.color() && iteration < self.step_at(self.refine_until + PRUNE_AFTER[0]);
        let each = 1.0 / gaussians as f32;
        if fades { OPACITY_PRICE * contrast * each } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_schedule_of_a_run() {
        let config = TrainConfig { iterations: 8000, sh_degree: 3, budget: Budget::Auto(1000), ..TrainConfig::default() };
        assert_eq!([0, 999, 1000, 2500, 7999].map(|i| config.degree(i)), [0, 0, 1, 2, 3]);
        assert!(config.coarse(3199) && !config.coarse(3200));
        assert!(config.refines(400) && !config.refines(300) && config.refines(3200) && !config.refines(3300));
        let rounds = |iterations: u32| {
            let config = TrainConfig { iterations, ..config.clone() };
            (0..=iterations).filter(|i| config.refines(*i)).count()
        };
        assert_eq!([1000, 2000, 7000, 30_000].map(rounds), [15, 17, 25, 106]);
        let few = |views: usize, iteration: u32| config.left_out(iteration, views);
        assert_eq!([few(24, 0), few(24, 4000), few(24, 8000), few(25, 8000)], [0.0, 0.1, 0.2, 0.0]);
        let frozen = TrainConfig { channels: crate::Channels::Feature, ..config.clone() };
        assert_eq!(frozen.left_out(8000, 24), 0.0, "lists that are kept hold all");
        assert_ne!(config.draw(5), TrainConfig { seed: 1, ..config.clone() }.draw(5));
        assert!(!config.resets_opacity(3000), "too late to recover");
        let long = TrainConfig { iterations: 30_000, ..config.clone() };
        assert!(long.resets_opacity(3000) && long.resets_opacity(9000) && !long.resets_opacity(12_000));
        assert!(config.prunes(3600) && config.prunes(5200) && !config.prunes(5201));
        let (first, last) = (config.rates(0, 2.0)[0], config.rates(8000, 2.0)[0]);
        assert!((first - 3.2e-4).abs() < 1e-8 && (last - first / 100.0).abs() < 1e-8);
        assert_eq!([3599, 3600].map(|i| config.opacity_weight(i, 1, 0.5)), [0.5 * OPACITY_PRICE, 0.0]);
        let continued = TrainConfig { first_degree: 2, ..config.clone() };
        assert_eq!([0, 1000, 3000].map(|i| continued.degree(i)), [2, 2, 3], "colour that is there already stays");
        let frozen = TrainConfig { channels: crate::Channels::Feature, ..config };
        assert!(!frozen.refines(400) && !frozen.prunes(3600));
    }
}
