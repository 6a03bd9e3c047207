//! What `train` is asked for.

use crate::eyes::{EncoderKind, SegmenterKind};
use crate::objects;
use fastlgs_grid::mapping::PaperConfig;
use fastlgs_grid::objects as chosen;
use fastlgs_raster::{Budget, FEW_VIEWS};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How long is trained, and towards how large a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Preset {
    /// 3,000 iterations.
    Quick,
    /// 7,000 iterations.
    #[default]
    Standard,
    /// 30,000 iterations.
    Paper,
    /// The same, and all else as the paper has it: Algorithm 1 finds the objects, and codes are trained together with the scene.
    LikePaper,
}

impl Preset {
    /// Iterations, highest SH degree, and most Gaussians with an automatic budget.
    pub(super) fn values(self) -> (u32, u32, usize) {
        match self {
            Self::Quick => (3_000, 2, 200_000),
            Self::Standard => (7_000, 2, 300_000),
            Self::Paper | Self::LikePaper => (30_000, 3, 1_000_000),
        }
    }
}

/// Whether each training photo has an affine exposure of its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Exposures {
    /// Where the photos' brightness varies.
    #[default]
    Auto,
    /// Learned.
    On,
    /// None.
    Off,
}

/// Whether cameras move while training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Align {
    /// Where photos that are kept aside gain by it.
    #[default]
    Auto,
    /// They do.
    On,
    /// They do not.
    Off,
}

/// How masks become objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Mapping {
    /// The views vote over the trained Gaussians.
    #[default]
    Global,
    /// Algorithm 1 of the paper.
    Paper,
    /// Those that the scene has; with --init of the trained scene, either feature mode refines what the other made.
    Keep,
}

/// Whether masks tell Gaussians where things end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Borders {
    /// Where masks know more than the photos' edges: those of SAM and imported ones, not those of the offline segmenter.
    #[default]
    Auto,
    /// Yes.
    On,
    /// No.
    Off,
}

/// How Gaussians get their codes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum FeatureMode {
    /// One pass of votes.
    #[default]
    Lift,
    /// Gradient descent, as in the paper.
    Train,
}

/// What Algorithm 1 compares beside the embeddings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Cue {
    /// Pairs of key points.
    Keypoints,
    /// Colour distributions.
    Color,
    /// Nothing.
    None,
}

/// What lies behind everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Background {
    /// Its colour, 0 to 1; where training starts if it is learned.
    pub color: [f32; 3],
    /// Whether it is learned.
    pub learn: bool,
}

impl Background {
    /// Parses `0,0.5,1` or `learn`.
    ///
    /// # Errors
    /// Anything else.
    pub fn parse(text: &str) -> Result<Self, String> {
        if text == "learn" {
            return Ok(Self { color: [0.5; 3], learn: true });
        }
        let values: Vec<f32> = text.split(',').filter_map(|v| v.trim().parse().ok()).filter(|v| (0.0..=1.0).contains(v)).collect();
        let color = <[f32; 3]>::try_from(values).map_err(|_| format!("'{text}' is neither 'learn' nor three numbers from 0 to 1"))?;
        Ok(Self { color, learn: false })
    }
}

/// The offline encoder's cosines of two photos of one thing go down to 0.6 (median 0.87), where CLIP's hardly leave 0.9: on exact masks of the generated
/// table, twins and mirror Algorithm 1 finds 116, 30 and 68 objects with the paper's theta, and 13, 8 and 9 with this one, where there are 13, 7 and 9.
const OFFLINE_THETA: f32 = 0.7;

/// The paper names no weight of the feature loss. Where masks are wrong it moves Gaussians wrongly: with 1, fox (offline masks, preset quick) falls
/// from 31.9 to 29.6 dB, with this one to 31.8, at the same oracle mIoU; the table with exact masks rises from 36.9 dB to 37.6 with either.
const FEATURE_WEIGHT: f32 = 0.2;

/// Pixels of the training views that stand against each Gaussian of an automatic budget. A Gaussian has 14 numbers to learn, a pixel tells three;
/// where there are few pixels a Gaussian, as with 170,000 of them on 28 photos of 240x180, they learn the photos by heart.
const PIXELS_A_GAUSSIAN: usize = 20;

/// SH degree of [`FEW_VIEWS`]: each Gaussian is seen by some of them only, and nine numbers a channel learn what each sees by heart. Oracle mIoU at
/// degrees 0, 1, 2: generated table of 20 views 0.966, 0.959, 0.883 (30.3, 29.5, 28.2 dB), fox of 18 views 0.77, 0.83, 0.81 at the same PSNR.
const DEGREE_OF_FEW: u32 = 1;

/// So many Gaussians; nothing for `auto`.
type BudgetChoice = Option<usize>;

/// Parses `auto` or a number.
#[cfg(feature = "clap")]
fn parse_budget(text: &str) -> Result<BudgetChoice, String> {
    if text == "auto" {
        return Ok(None);
    }
    text.parse().ok().filter(|n| *n > 0).map(Some).ok_or_else(|| format!("'{text}' is neither 'auto' nor a number of Gaussians"))
}

/// What is trained, and how.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Config {
    /// Scene folder that `preprocess` made.
    pub scene: PathBuf,
    /// How long is trained.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub preset: Preset,
    /// Iterations, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub iterations: Option<u32>,
    /// Gaussians: `auto` (as many as held-out quality gains from; at most one for 20 pixels of the training photos, and 200,000 with the preset
    /// quick, 300,000 with standard, a million with paper), or exactly how many there may be.
    #[cfg_attr(feature = "clap", arg(long, default_value = "auto", value_parser = parse_budget))]
    pub budget: BudgetChoice,
    /// Highest spherical-harmonic degree of colour, 0 to 3; by default that of --init, else the preset's, but 1 where fewer than 25 photos are
    /// trained on.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(0..=3)))]
    pub sh_degree: Option<u32>,
    /// Anti-aliasing by the 2-D Mip filter; also where --init names the scene's own Gaussians, which were trained with it.
    #[cfg_attr(feature = "clap", arg(long))]
    pub antialias: bool,
    /// Colour behind everything: three numbers from 0 to 1 separated by commas, or `learn`; by default black, but that which they were trained with
    /// where --init names the scene's own Gaussians.
    #[cfg_attr(feature = "clap", arg(long, value_parser = Background::parse))]
    pub background: Option<Background>,
    /// Learn an affine exposure for each training photo.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t, num_args = 0..=1, default_missing_value = "on", require_equals = true))]
    pub exposure: Exposures,
    /// Move the cameras of the training photos to where the scene says that they were; `auto` where photos that are kept aside gain by it.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub align: Align,
    /// Whether Gaussians learn from the masks where things end, with --mapping global and --feature-mode lift.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub borders: Borders,
    /// Keep geometry and colour as --init gives them; train features only.
    #[cfg_attr(feature = "clap", arg(long, requires = "init"))]
    pub freeze: bool,
    /// Start from the Gaussians of a file instead of points: .ply (also SuperSplat's compressed), .spz, .sog, .glb or .splat.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", visible_alias = "init-ply"))]
    #[serde(alias = "init_ply")]
    pub init: Option<PathBuf>,
    /// How masks become objects.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub mapping: Mapping,
    /// How Gaussians get their codes.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub feature_mode: FeatureMode,
    /// Paper mapping: fewest key-point pairs that make two masks one object.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PaperConfig::default().tau))]
    pub tau: u32,
    /// Paper mapping: least similarity that makes two masks one object; by default the paper's 0.95 for CLIP, and 0.7 for the offline encoder.
    #[cfg_attr(feature = "clap", arg(long))]
    pub theta: Option<f32>,
    /// Paper mapping: weight of colour in the similarity.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PaperConfig::default().alpha))]
    pub alpha: f32,
    /// Paper mapping: what is compared beside the embeddings, separated by commas (the paper's ablation).
    #[cfg_attr(feature = "clap", arg(long, value_enum, value_delimiter = ',', default_value = "keypoints,color"))]
    pub cues: Vec<Cue>,
    /// Global mapping: how well the views' masks must fit an object, as their mean IoU.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = chosen::Config::default().min_support))]
    pub support: f32,
    /// Measure the held-out PSNR every N iterations and report it over the seconds of training.
    #[cfg_attr(feature = "clap", arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..)))]
    pub curve: Option<u32>,
    /// Weight of the feature loss against colour's, with --feature-mode train and where masks shape the Gaussians (--borders): both move these, unless
    /// --freeze keeps them.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = FEATURE_WEIGHT))]
    pub feature_weight: f32,
    /// Continue from the last checkpoint.
    #[cfg_attr(feature = "clap", arg(long))]
    pub resume: bool,
}

impl Default for Config {
    fn default() -> Self {
        let (paper, objects) = (PaperConfig::default(), chosen::Config::default());
        Self {
            scene: PathBuf::new(),
            preset: Preset::default(),
            iterations: None,
            budget: None,
            sh_degree: None,
            antialias: false,
            background: None,
            exposure: Exposures::default(),
            align: Align::default(),
            borders: Borders::default(),
            freeze: false,
            init: None,
            mapping: Mapping::default(),
            feature_mode: FeatureMode::default(),
            tau: paper.tau,
            theta: None,
            alpha: paper.alpha,
            cues: vec![Cue::Keypoints, Cue::Color],
            support: objects.min_support,
            curve: None,
            feature_weight: FEATURE_WEIGHT,
            resume: false,
        }
    }
}

impl Config {
    /// With all that the preset says.
    pub(super) fn resolved(&self) -> Self {
        match self.preset {
            Preset::LikePaper => Self { mapping: Mapping::Paper, feature_mode: FeatureMode::Train, ..self.clone() },
            _ => self.clone(),
        }
    }

    /// Iterations of the run.
    pub fn iterations(&self) -> u32 {
        self.iterations.unwrap_or(self.preset.values().0)
    }

    /// Highest SH degree of a run on so many views, unless it is asked for.
    pub(super) fn degree(&self, views: usize) -> u32 {
        let (_, degree, _) = self.preset.values();
        if views < FEW_VIEWS && self.preset != Preset::LikePaper { degree.min(DEGREE_OF_FEW) } else { degree }
    }

    /// How many Gaussians there may be, for views of so many pixels in all.
    pub(super) fn budget(&self, pixels: usize) -> Budget {
        let most = self.preset.values().2.min(pixels / PIXELS_A_GAUSSIAN);
        self.budget.map_or(Budget::Auto(most.max(1)), Budget::Fixed)
    }

    /// Constants of Algorithm 1 on embeddings of an encoder.
    pub(super) fn paper(&self, encoder: &str) -> PaperConfig {
        let theta = if encoder == EncoderKind::Offline.name() { OFFLINE_THETA } else { PaperConfig::default().theta };
        let theta = self.theta.unwrap_or(theta);
        let alpha = if self.cues.contains(&Cue::Color) { self.alpha } else { 0.0 };
        PaperConfig { tau: self.tau, theta, alpha, key_points: self.cues.contains(&Cue::Keypoints) }
    }

    /// Whether masks of this segmenter shape the Gaussians from some step on.
    pub(super) fn masks_shape(&self, segmenter: &str) -> bool {
        let asked = match self.borders {
            Borders::Auto => segmenter != SegmenterKind::Offline.name(),
            Borders::On => true,
            Borders::Off => false,
        };
        asked && self.mapping == Mapping::Global && self.feature_mode == FeatureMode::Lift && !self.freeze
    }

    /// Constants of global mapping.
    pub(super) fn global(&self) -> objects::Config {
        objects::Config { antialias: self.antialias, objects: chosen::Config { min_support: self.support, ..chosen::Config::default() } }
    }
}
