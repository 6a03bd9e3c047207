//! Options of `train`.

use crate::model_choice::{EncoderKind, SegmenterKind};
use crate::objects;
use fastlgs_grid::mapping::PaperConfig;
use fastlgs_grid::objects as chosen;
use fastlgs_raster::{Budget, FEW_VIEWS};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Length of training and size of the scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Preset {
    /// 1,800 iterations.
    Quick,
    /// 7,000 iterations.
    #[default]
    Standard,
    /// 30,000 iterations.
    Paper,
    /// 30,000 iterations, and everything else as in the paper: the schedule of 3DGS, Algorithm 1
    /// finds the objects, codes are trained together with the scene, and the largest relevancy
    /// answers a text.
    LikePaper,
}

impl Preset {
    /// Returns the number of iterations, the highest SH degree, and the limit of an automatic
    /// budget.
    pub(super) fn values(self) -> (u32, u32, usize) {
        match self {
            Self::Quick => (1_800, 2, 200_000),
            Self::Standard => (7_000, 2, 300_000),
            Self::Paper | Self::LikePaper => (30_000, 3, 1_000_000),
        }
    }
}

/// Whether a step runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Switch {
    /// It runs if it helps; the option describes how this is decided.
    #[default]
    Auto,
    /// It runs.
    On,
    /// It does not run.
    Off,
}

impl Switch {
    /// Returns whether the step runs, if `Auto` means `automatic`.
    pub(crate) fn is_on(self, automatic: bool) -> bool {
        match self {
            Self::Auto => automatic,
            Self::On => true,
            Self::Off => false,
        }
    }
}

/// How masks become objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Mapping {
    /// Consensus of all views on the trained Gaussians.
    #[default]
    Global,
    /// Algorithm 1 of the paper.
    Paper,
    /// Keep the objects of a trained scene. With --init of its scene.ply, either feature mode
    /// refines the result of the other.
    Keep,
}

/// How Gaussians get their codes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum FeatureMode {
    /// Lifting: one pass of votes over all views.
    #[default]
    Lift,
    /// Gradient descent, as in the paper.
    Train,
}

/// Cue that Algorithm 1 compares in addition to embeddings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Cue {
    /// Key point matches.
    Keypoints,
    /// Colour histograms.
    Color,
    /// No other cue.
    None,
}

/// Background of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Background {
    /// RGB colour, 0 to 1; the initial value if it is learned.
    pub color: [f32; 3],
    /// Whether training learns the colour.
    pub learn: bool,
}

impl Background {
    /// Parses `0,0.5,1` or `learn`.
    ///
    /// # Errors
    /// Any other text.
    pub fn parse(text: &str) -> Result<Self, String> {
        if text == "learn" {
            return Ok(Self {
                color: [0.5; 3],
                learn: true,
            });
        }
        let values: Vec<f32> = text
            .split(',')
            .filter_map(|v| v.trim().parse().ok())
            .filter(|v| (0.0..=1.0).contains(v))
            .collect();
        let color = <[f32; 3]>::try_from(values).map_err(|_| {
            format!(
                "'{text}' is neither 'learn' nor three numbers from 0 to 1, separated by commas"
            )
        })?;
        Ok(Self {
            color,
            learn: false,
        })
    }
}

/// Default theta of Algorithm 1 for the offline encoder, a cosine. The cosine of two photos of one
/// object can be as low as 0.6 (median 0.87). With CLIP, it is rarely below 0.9.
const OFFLINE_THETA: f32 = 0.7;

/// Default least support of objects if their masks are imported. Such masks are mostly exact, and what
/// lowers the support of an object is thin parts and Gaussians beside it (docs/research/rooms.md).
const IMPORTED_SUPPORT: f32 = 0.3;

/// Default weight of the feature loss relative to the colour loss. The paper gives no value. Wrong
/// masks displace Gaussians: on the scene "fox", a weight of 1 lowers PSNR by 2.3 dB, and this
/// weight lowers it by 0.1 dB.
const FEATURE_WEIGHT: f32 = 0.2;

/// Default weight of the depth loss, an error of ln depth, relative to the colour loss
/// (docs/research/rooms.md).
const DEPTH_WEIGHT: f32 = 0.4;

/// Least number of training pixels per Gaussian of an automatic budget. A Gaussian has 14
/// parameters and a pixel has three values. With fewer pixels, Gaussians overfit the photos.
const MIN_PIXELS_PER_GAUSSIAN: usize = 20;

/// Highest default SH degree for fewer than [`FEW_VIEWS`] training views. Each Gaussian is then
/// visible in so few views that higher degrees overfit.
const FEW_VIEWS_SH_DEGREE: u32 = 1;

/// Number of Gaussians; `None` for `auto`.
type BudgetChoice = Option<usize>;

/// Parses `auto` or a number.
#[cfg(feature = "clap")]
fn parse_budget(text: &str) -> Result<BudgetChoice, String> {
    if text == "auto" {
        return Ok(None);
    }
    text.parse()
        .ok()
        .filter(|n| *n > 0)
        .map(Some)
        .ok_or_else(|| format!("'{text}' is neither 'auto' nor a number of Gaussians"))
}

/// Options of `train`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct TrainConfig {
    /// Scene folder that `preprocess` made.
    pub scene: PathBuf,
    /// Length of training.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub preset: Preset,
    /// Number of iterations, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub iterations: Option<u32>,
    /// Limit of Gaussians: a number, or `auto`. `auto` removes Gaussians that hardly change the
    /// training photos. It allows at most one per 20 pixels of the training photos, and at most
    /// 200,000 (quick), 300,000 (standard) or 1,000,000 (paper).
    #[cfg_attr(feature = "clap", arg(long, default_value = "auto", value_parser = parse_budget))]
    pub budget: BudgetChoice,
    /// Highest spherical harmonics degree of colour, 0 to 3. Default: that of the --init file, else
    /// that of the preset. With fewer than 25 training photos, it is at most 1, except with
    /// like-paper.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(0..=3)))]
    pub sh_degree: Option<u32>,
    /// Anti-alias with the 2-D Mip filter. It is always on if --init names the Gaussians of this
    /// scene and they were trained with it.
    #[cfg_attr(feature = "clap", arg(long))]
    pub antialias: bool,
    /// Background colour: three numbers from 0 to 1 separated by commas, or `learn`. Default:
    /// black; if --init names the Gaussians of this scene, the background of their training.
    #[cfg_attr(feature = "clap", arg(long, value_parser = Background::parse))]
    pub background: Option<Background>,
    /// Learn an affine exposure for each training photo. `auto` does so if the photos' brightness
    /// varies.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t, num_args = 0..=1, default_missing_value = "on", require_equals = true))]
    pub exposure: Switch,
    /// Refine the cameras of the training photos. `auto` does so if validation views improve by it.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub align: Switch,
    /// Use masks to train Gaussians to end at the borders of objects. `auto` uses masks of SAM and
    /// imported ones; those of the offline segmenter only follow edges of the photos. Needs
    /// --mapping global and --feature-mode lift.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub borders: Switch,
    /// Keep geometry and colour of the --init file, and train features only.
    #[cfg_attr(feature = "clap", arg(long, requires = "init"))]
    pub freeze: bool,
    /// Start from the Gaussians of a file instead of points: .ply (including compressed files of
    /// SuperSplat), .spz, .sog, .glb or .splat.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub init: Option<PathBuf>,
    /// How masks become objects.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub mapping: Mapping,
    /// How Gaussians get their codes.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub feature_mode: FeatureMode,
    /// Paper mapping: least number of key point matches that makes two masks one object.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PaperConfig::default().tau))]
    pub tau: u32,
    /// Paper mapping: least similarity that makes two masks one object. Default: 0.95 as in the
    /// paper, but 0.7 for the offline encoder.
    #[cfg_attr(feature = "clap", arg(long))]
    pub theta: Option<f32>,
    /// Paper mapping: weight of colour in the similarity.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PaperConfig::default().alpha))]
    pub alpha: f32,
    /// Paper mapping: cues to compare in addition to embeddings, separated by commas (the ablation
    /// of the paper).
    #[cfg_attr(
        feature = "clap",
        arg(
            long,
            value_enum,
            value_delimiter = ',',
            default_value = "keypoints,color"
        )
    )]
    pub cues: Vec<Cue>,
    /// Global mapping: least support of an object, its mean IoU with the best mask of each view, by
    /// default 0.3 for imported masks and 0.5 for others.
    #[cfg_attr(feature = "clap", arg(long))]
    pub support: Option<f32>,
    /// Measure the PSNR of held-out views every N iterations, and report it over time. N is rounded
    /// up to a multiple of 20.
    #[cfg_attr(feature = "clap", arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..)))]
    pub curve: Option<u32>,
    /// Weight of the feature loss relative to the colour loss, for --feature-mode train and
    /// --borders. Both losses move Gaussians, unless --freeze is set.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = FEATURE_WEIGHT))]
    pub feature_weight: f32,
    /// Weight of the depth loss, which keeps Gaussians on the planes that masks show; 0 for none.
    /// It is used if at least 40 % of the photos have no texture, as in rooms with bare walls.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = DEPTH_WEIGHT))]
    pub depth_weight: f32,
    /// Continue from the last checkpoint.
    #[cfg_attr(feature = "clap", arg(long))]
    pub resume: bool,
}

impl Default for TrainConfig {
    fn default() -> Self {
        let paper = PaperConfig::default();
        Self {
            scene: PathBuf::new(),
            preset: Preset::default(),
            iterations: None,
            budget: None,
            sh_degree: None,
            antialias: false,
            background: None,
            exposure: Switch::default(),
            align: Switch::default(),
            borders: Switch::default(),
            freeze: false,
            init: None,
            mapping: Mapping::default(),
            feature_mode: FeatureMode::default(),
            tau: paper.tau,
            theta: None,
            alpha: paper.alpha,
            cues: vec![Cue::Keypoints, Cue::Color],
            support: None,
            curve: None,
            feature_weight: FEATURE_WEIGHT,
            depth_weight: DEPTH_WEIGHT,
            resume: false,
        }
    }
}

/// Returns `Off` for `Auto`.
fn off_if_auto(switch: Switch) -> Switch {
    match switch {
        Switch::Auto => Switch::Off,
        chosen => chosen,
    }
}

impl TrainConfig {
    /// Returns whether photos that determine little get a treatment of their own, which the paper
    /// does not have: few photos a backdrop, and bare ones surfaces; floaters are removed from empty
    /// space.
    pub(super) fn treats_weak_photos(&self) -> bool {
        self.preset != Preset::LikePaper
    }

    /// Returns the options with those that the preset implies.
    pub(super) fn resolved(&self) -> Self {
        match self.preset {
            Preset::LikePaper => Self {
                mapping: Mapping::Paper,
                feature_mode: FeatureMode::Train,
                exposure: off_if_auto(self.exposure),
                align: off_if_auto(self.align),
                budget: Some(self.budget.unwrap_or(self.preset.values().2)),
                ..self.clone()
            },
            _ => self.clone(),
        }
    }

    /// Returns the number of iterations.
    pub fn iterations(&self) -> u32 {
        self.iterations.unwrap_or(self.preset.values().0)
    }

    /// Returns the default of the highest SH degree for a number of training views.
    pub(super) fn degree(&self, views: usize) -> u32 {
        let (_, degree, _) = self.preset.values();
        if views < FEW_VIEWS && self.treats_weak_photos() {
            degree.min(FEW_VIEWS_SH_DEGREE)
        } else {
            degree
        }
    }

    /// Returns the budget of Gaussians. `pixels` is the number of pixels of all training views.
    pub(super) fn budget(&self, pixels: usize) -> Budget {
        let most = self.preset.values().2.min(pixels / MIN_PIXELS_PER_GAUSSIAN);
        self.budget.map_or(Budget::Auto(most.max(1)), Budget::Fixed)
    }

    /// Returns the constants of Algorithm 1. `encoder` is its name in the manifest.
    pub(super) fn paper(&self, encoder: &str) -> PaperConfig {
        let theta = if encoder == EncoderKind::Offline.name() {
            OFFLINE_THETA
        } else {
            PaperConfig::default().theta
        };
        let theta = self.theta.unwrap_or(theta);
        let alpha = if self.cues.contains(&Cue::Color) {
            self.alpha
        } else {
            0.0
        };
        PaperConfig {
            tau: self.tau,
            theta,
            alpha,
            key_points: self.cues.contains(&Cue::Keypoints),
        }
    }

    /// Returns whether masks guide training. `segmenter` is its name in the manifest.
    pub(super) fn masks_guide_training(&self, segmenter: &str) -> bool {
        self.borders
            .is_on(segmenter != SegmenterKind::Offline.name())
            && self.mapping == Mapping::Global
            && self.feature_mode == FeatureMode::Lift
            && !self.freeze
    }

    /// Returns the constants of global mapping of masks by this segmenter.
    pub(super) fn global(&self, segmenter: &str) -> objects::MappingConfig {
        let is_imported = segmenter == SegmenterKind::Import.name();
        let default = if is_imported {
            IMPORTED_SUPPORT
        } else {
            chosen::SelectionConfig::default().min_support
        };
        objects::MappingConfig {
            antialias: self.antialias,
            objects: chosen::SelectionConfig {
                min_support: self.support.unwrap_or(default),
                ..chosen::SelectionConfig::default()
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn like_paper_implies_the_papers_mapping_and_features() {
        let config = TrainConfig {
            preset: Preset::LikePaper,
            ..TrainConfig::default()
        };
        let resolved = config.resolved();
        assert_eq!(resolved.mapping, Mapping::Paper);
        assert_eq!(resolved.feature_mode, FeatureMode::Train);
        // The list of what like-paper sets is in docs/like-paper.md.
        assert_eq!(
            (resolved.exposure, resolved.align),
            (Switch::Off, Switch::Off)
        );
        assert_eq!(resolved.budget(usize::MAX), Budget::Fixed(1_000_000));
        assert_eq!(resolved.iterations(), 30_000);
        assert_eq!(resolved.degree(3), 3);
        assert!(!resolved.treats_weak_photos() && !resolved.masks_guide_training("sam"));
        let algorithm = resolved.paper("clip");
        assert_eq!(
            (algorithm.tau, algorithm.theta, algorithm.alpha),
            (4, 0.95, 0.3)
        );
        assert_eq!(TrainConfig::default().resolved().mapping, Mapping::Global);
    }

    #[test]
    fn automatic_budget_is_limited_by_the_pixels_and_a_given_one_is_kept() {
        let config = TrainConfig::default();
        assert_eq!(config.budget(20 * 1000), Budget::Auto(1000));
        assert_eq!(config.budget(0), Budget::Auto(1));
        let fixed = TrainConfig {
            budget: Some(7),
            ..config
        };
        assert_eq!(fixed.budget(20 * 1000), Budget::Fixed(7));
    }

    #[test]
    fn few_views_get_a_low_sh_degree_except_like_the_paper() {
        let standard = TrainConfig::default();
        assert!(standard.degree(FEW_VIEWS - 1) <= FEW_VIEWS_SH_DEGREE);
        let paper = TrainConfig {
            preset: Preset::LikePaper,
            ..standard
        };
        assert_eq!(paper.degree(FEW_VIEWS - 1), paper.degree(1000));
    }

    #[test]
    fn masks_guide_training_unless_they_are_offline_or_features_are_trained() {
        let config = TrainConfig::default();
        assert!(config.masks_guide_training("sam"));
        assert!(!config.masks_guide_training("offline"));
        let on = TrainConfig {
            borders: Switch::On,
            ..config.clone()
        };
        assert!(on.masks_guide_training("offline"));
        let trained = TrainConfig {
            feature_mode: FeatureMode::Train,
            ..on
        };
        assert!(!trained.masks_guide_training("sam"));
    }

    #[test]
    fn cues_switch_the_terms_of_algorithm_1() {
        let colors = TrainConfig {
            cues: vec![Cue::Color],
            ..TrainConfig::default()
        };
        let paper = colors.paper("clip");
        assert!(paper.alpha > 0.0 && !paper.key_points);
        assert_eq!(paper.theta, PaperConfig::default().theta);
        let key_points = TrainConfig {
            cues: vec![Cue::Keypoints],
            ..TrainConfig::default()
        };
        let paper = key_points.paper("offline");
        assert!(paper.alpha == 0.0 && paper.key_points && paper.theta == OFFLINE_THETA);
    }
}
