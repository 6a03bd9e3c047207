//! Options and report of `preprocess`.

use crate::model_choice::ModelChoice;
use fastlgs_core::dataset::PoseConvention;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Method that computes poses for photos without them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Sfm {
    /// pycolmap, on key points that FastLGS detects and matches. If pycolmap is missing, the
    /// program `colmap`.
    #[default]
    Auto,
    /// The program `colmap` for all steps.
    Colmap,
}

/// Verification and correction of poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Poses {
    /// Use the poses as they are.
    Keep,
    /// Move groups of cameras that contradict the photos. Adjust all cameras if that clearly lowers
    /// the reprojection error.
    #[default]
    Check,
    /// As check, but adjust all cameras in any case.
    Refine,
}

/// Options of `preprocess`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct PreprocessConfig {
    /// Folder of photos (in images/ or directly in it), or a video. Poses are read from sparse/0
    /// (COLMAP), transforms.json or poses_bounds.npy in the folder. Without them, structure from
    /// motion computes the poses.
    pub photos: PathBuf,
    /// Scene folder to write.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
    /// Limit on the longer side of prepared photos, in pixels.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PreprocessConfig::default().max_side))]
    pub max_side: u32,
    /// Hold out every N-th photo (sorted by name) from training and mapping; 0 holds out none. If
    /// the data set marks photos for testing, those are held out instead.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PreprocessConfig::default().holdout))]
    pub holdout: usize,
    /// Hold out the photos that these labels name (LERF-OVS, 3D-OVS or SPIn-NeRF), instead of every
    /// N-th.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "DIR", conflicts_with = "holdout")
    )]
    pub holdout_labels: Option<PathBuf>,
    /// How to compute poses for photos without them.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub sfm: Sfm,
    /// How to verify and correct poses.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub poses: Poses,
    /// Convention in which the poses are written. Default: the usual one of their file, unless the
    /// key points clearly fit another.
    #[cfg_attr(feature = "clap", arg(long, value_name = "CONVENTION", value_parser = convention_parser()))]
    pub pose_convention: Option<PoseConvention>,
    /// Segmenter and encoder.
    #[serde(flatten)]
    #[cfg_attr(feature = "clap", command(flatten))]
    pub eyes: ModelChoice,
    /// Number of neighbouring photos with which each photo is matched.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = PreprocessConfig::default().neighbours))]
    pub neighbours: usize,
    /// Memory limit for reading photos, such as 500M or 4G.
    #[cfg_attr(feature = "clap", arg(long, default_value = "4G", value_name = "BYTES", value_parser = parse_bytes))]
    pub memory: u64,
}

impl Default for PreprocessConfig {
    fn default() -> Self {
        Self {
            photos: PathBuf::new(),
            output: PathBuf::new(),
            max_side: 960,
            holdout: 8,
            holdout_labels: None,
            sfm: Sfm::default(),
            poses: Poses::default(),
            pose_convention: None,
            eyes: ModelChoice::default(),
            neighbours: 10,
            memory: 4_000_000_000,
        }
    }
}

/// Parses the name of a pose convention.
#[cfg(feature = "clap")]
fn convention_parser() -> impl clap::builder::TypedValueParser<Value = PoseConvention> {
    use clap::builder::{PossibleValuesParser, TypedValueParser};
    let all = PoseConvention::ALL;
    PossibleValuesParser::new(all.map(PoseConvention::name)).map(move |name| {
        all.into_iter()
            .find(|convention| convention.name() == name)
            .expect("one of them")
    })
}

/// Parses a size such as `500M` into bytes. K, M and G are powers of 1,000.
#[cfg(feature = "clap")]
fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = text.split_at(text.trim_end_matches(char::is_alphabetic).len());
    let factor = match unit.to_uppercase().as_str() {
        "" => 1.0,
        "K" | "KB" => 1e3,
        "M" | "MB" => 1e6,
        "G" | "GB" => 1e9,
        _ => return Err(format!("'{unit}' is not a unit of size; use K, M or G")),
    };
    let bytes = number
        .parse::<f64>()
        .ok()
        .filter(|n| *n > 0.0)
        .ok_or_else(|| format!("'{text}' is not a positive size; write one such as 4G"))?;
    Ok((bytes * factor) as u64)
}

/// Report of `preprocess`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct PreprocessReport {
    /// The scene folder.
    pub scene: PathBuf,
    /// Number of photos that were read.
    pub photos: usize,
    /// Number of training photos.
    pub training_photos: usize,
    /// Number of photos that are not trained on: held-out photos, and photos with wrong poses.
    pub held_out: usize,
    /// Size of the first prepared photo, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Number of masks of all levels in all training photos.
    pub masks: usize,
    /// Mean number of masks per training photo, by level.
    pub masks_per_photo: BTreeMap<String, f64>,
    /// Number of key point matches between training photos that agree with the final poses.
    pub key_point_matches: usize,
    /// Number of points from which Gaussians can start.
    pub points: usize,
    /// SIFT implementation that detected the key points.
    pub sift: String,
    /// Hardware that ran the models, as in `--onnx`. None if no model was needed.
    pub onnx: Option<String>,
    /// Number of cameras that were moved because their poses contradicted the photos.
    pub moved_cameras: usize,
    /// Result of bundle adjustment, if it ran.
    pub adjusted: Option<Adjusted>,
    /// Warnings, one sentence each.
    pub warnings: Vec<String>,
    /// Typical brightness difference of two photos, in stops.
    pub brightness_spread_stops: f32,
    /// By stage: number of results found in the cache, and number of all results.
    pub cached: BTreeMap<String, [usize; 2]>,
    /// Seconds by stage.
    pub seconds: BTreeMap<String, f64>,
    /// Seconds of all stages together.
    pub seconds_total: f64,
}

/// Result of bundle adjustment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Adjusted {
    /// Root mean square reprojection error before, in pixels of the prepared photos.
    pub error_before: f32,
    /// Root mean square reprojection error after, in pixels of the prepared photos.
    pub error_after: f32,
    /// Number of key points in consistent tracks after, divided by the number before.
    pub explained: f32,
    /// Median over the cameras of the distance that a camera moves its points in the image, in
    /// pixels.
    pub moved_median: f32,
    /// Largest of these distances, in pixels.
    pub moved_most: f32,
    /// Mean factor on the focal lengths.
    pub focal: f32,
    /// Radial term with the largest magnitude that the adjustment found in a photo. It maps p to p
    /// (1 + k1 |p|^2), where p is in multiples of the focal length.
    pub k1: f32,
    /// Whether the adjusted poses are used.
    pub used: bool,
}

/// Brightness of the training photos of a scene, relative to each other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Brightness {
    /// Typical difference of two photos, in stops.
    pub spread_stops: f32,
    /// By photo name: brightness relative to the mean of all photos, as a factor for each colour
    /// channel.
    pub gains: BTreeMap<String, [f32; 3]>,
}

impl Brightness {
    /// Returns the gain of each colour channel of a photo; 1 for an unknown photo.
    pub fn gain(&self, name: &str) -> [f32; 3] {
        self.gains.get(name).copied().unwrap_or([1.0; 3])
    }
}
