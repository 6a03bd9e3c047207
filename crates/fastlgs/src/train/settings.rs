//! Translates options into the trainer's configuration.

use super::config::{FeatureMode, Preset, Switch, TrainConfig};
use super::mask_supervision;
use crate::preprocess::Brightness;
use fastlgs_core::Gaussians;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_raster::{Alignment, Channels, Targets, TrainerConfig};

/// Typical brightness difference of two photos, in stops, from which `auto` learns exposures.
const MIN_BRIGHTNESS_SPREAD: f32 = 0.15;

/// Returns the trainer's configuration. The preset supplies the values of options that are not set.
pub fn settings(
    config: &TrainConfig,
    first: &Gaussians,
    views: &Targets,
    manifest: &Manifest,
    brightness: &Brightness,
    seed: u64,
) -> TrainerConfig {
    let trains_features = config.feature_mode == FeatureMode::Train;
    let background = config.background.unwrap_or_default();
    let settings = TrainerConfig {
        iterations: config.iterations(),
        seed,
        budget: config.budget(views.pixels()),
        channels: match (config.freeze, trains_features) {
            (true, _) => Channels::Feature,
            (false, false) => Channels::Color,
            // As in the paper: features move Gaussians, too.
            (false, true) => Channels::Coupled,
        },
        sh_degree: config.sh_degree.unwrap_or(if config.init.is_some() {
            first.sh_degree
        } else {
            config.degree(views.len())
        }),
        first_degree: first.sh_degree,
        feature_weight: config.feature_weight,
        couples_at: config
            .masks_guide_training(&manifest.segmenter)
            .then(|| mask_supervision::begin_at(config.iterations())),
        antialias: config.antialias,
        background: background.color,
        learn_background: background.learn,
        // Large steps would first undo what the given Gaussians have learned.
        scaled_rates: config.init.is_none(),
        exposure: config
            .exposure
            .is_on(brightness.spread_stops >= MIN_BRIGHTNESS_SPREAD),
        alignment: match config.align {
            Switch::Auto => Alignment::Auto,
            Switch::On => Alignment::On,
            Switch::Off => Alignment::Off,
        },
        ..TrainerConfig::default()
    };
    match config.preset {
        Preset::LikePaper => settings.with_schedule_of_3dgs(),
        _ => settings,
    }
}
