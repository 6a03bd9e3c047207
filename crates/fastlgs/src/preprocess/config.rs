//! What `preprocess` is asked for, and what it reports.

use crate::eyes::Eyes;
use fastlgs_core::dataset::PoseConvention;
use fastlgs_core::scene_folder::Manifest;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What finds poses where there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Sfm {
    /// pycolmap on key points that are found and matched here; without it, the program `colmap`.
    #[default]
    Auto,
    /// The program `colmap` from photos to poses.
    Colmap,
}

/// What is done about given poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Poses {
    /// Nothing.
    Keep,
    /// Groups of cameras that contradict the photos are moved; all are adjusted to the key points where that mends them.
    #[default]
    Check,
    /// The same, and all are adjusted in any case.
    Refine,
}

/// What is preprocessed, and how.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Config {
    /// Folder of photos, in images/ or as they are, with poses: sparse/0 (COLMAP), transforms.json or poses_bounds.npy; without poses pycolmap finds them. Or a video.
    pub photos: PathBuf,
    /// Scene folder to write.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
    /// Longer side of the working photos in pixels.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = Config::default().max_side))]
    pub max_side: u32,
    /// Every N-th photo (by sorted name) is kept out of training and mapping; 0 for none.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = Config::default().holdout))]
    pub holdout: usize,
    /// Keep out the photos that these labels name instead (of LERF-OVS, 3D-OVS or SPIn-NeRF).
    #[cfg_attr(feature = "clap", arg(long, value_name = "DIR", conflicts_with = "holdout"))]
    pub holdout_labels: Option<PathBuf>,
    /// What finds poses where there are none.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub sfm: Sfm,
    /// What is done about the poses.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub poses: Poses,
    /// How the poses are written. By default the usual convention of their file, unless the photos' key points fit another one plainly.
    #[cfg_attr(feature = "clap", arg(long, value_name = "CONVENTION", value_parser = convention_parser()))]
    pub pose_convention: Option<PoseConvention>,
    /// Segmenter and encoder.
    #[serde(flatten)]
    #[cfg_attr(feature = "clap", command(flatten))]
    pub eyes: Eyes,
    /// Photos that each photo's key points are matched with.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = Config::default().neighbours))]
    pub neighbours: usize,
    /// How much memory photos may take while they are read, such as 500M or 4G.
    #[cfg_attr(feature = "clap", arg(long, default_value = "4G", value_name = "BYTES", value_parser = parse_bytes))]
    pub memory: u64,
}

impl Default for Config {
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
            eyes: Eyes::default(),
            neighbours: 10,
            memory: 4_000_000_000,
        }
    }
}

/// The conventions by name.
#[cfg(feature = "clap")]
fn convention_parser() -> impl clap::builder::TypedValueParser<Value = PoseConvention> {
    use clap::builder::{PossibleValuesParser, TypedValueParser};
    let all = PoseConvention::ALL;
    PossibleValuesParser::new(all.map(PoseConvention::name))
        .map(move |name| all.into_iter().find(|convention| convention.name() == name).expect("one of them"))
}

/// Parses `500M`.
#[cfg(feature = "clap")]
fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = text.split_at(text.trim_end_matches(char::is_alphabetic).len());
    let factor = match unit.to_uppercase().as_str() {
        "" => 1.0,
        "K" | "KB" => 1e3,
        "M" | "MB" => 1e6,
        "G" | "GB" => 1e9,
        _ => return Err(format!("'{unit}' is none of K, M and G")),
    };
    let bytes = number.parse::<f64>().ok().filter(|n| *n > 0.0).ok_or_else(|| format!("'{text}' is not a size like 4G"))?;
    Ok((bytes * factor) as u64)
}

/// What preprocessing found.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Report {
    /// The scene folder.
    pub scene: PathBuf,
    /// Photos that were read.
    pub photos: usize,
    /// Those that are trained on.
    pub training_photos: usize,
    /// Those that are not.
    pub held_out: usize,
    /// Size of the first working photo.
    pub size: String,
    /// Masks of all levels on all training photos.
    pub masks: usize,
    /// Mean number of masks a photo, by level.
    pub masks_per_photo: BTreeMap<String, f64>,
    /// Pairs of key points that matched, once poses were right.
    pub key_point_matches: usize,
    /// Points to start Gaussians from.
    pub points: usize,
    /// What found the key points.
    pub sift: String,
    /// Cameras whose poses contradicted the photos and were moved.
    pub moved_cameras: usize,
    /// How all cameras were adjusted to the key points, if they were.
    pub adjusted: Option<Adjusted>,
    /// What was survivable but wrong.
    pub warnings: Vec<String>,
    /// How much the photos' brightness varies, in stops.
    pub brightness_spread_stops: f32,
    /// By stage, results that were there already, and all.
    pub cached: BTreeMap<String, [usize; 2]>,
    /// By stage.
    pub seconds: BTreeMap<String, f64>,
    /// Of all stages together.
    pub seconds_total: f64,
}

/// How far bundle adjustment moved the cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Adjusted {
    /// Root mean square reprojection error of the key points before, in pixels of the working photos.
    pub error_before: f32,
    /// And after.
    pub error_after: f32,
    /// By how much more key points the poses explain: a factor.
    pub explained: f32,
    /// Median over the cameras of how far their pictures moved, in pixels.
    pub moved_median: f32,
    /// The largest of these.
    pub moved_most: f32,
    /// Mean factor on the focal lengths.
    pub focal: f32,
    /// Largest radial term that was left in the pictures.
    pub k1: f32,
    /// Whether the adjusted poses are used.
    pub used: bool,
}

/// The manifest's note of how bright photos are.
const BRIGHTNESS: &str = "brightness";

/// How bright a scene's training photos are against each other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Brightness {
    /// The typical difference of two photos in stops.
    pub spread_stops: f32,
    /// By the photo's name, how many times brighter than the mean it shows things, by channel.
    pub gains: BTreeMap<String, [f32; 3]>,
}

impl Brightness {
    /// What preprocessing noted; as if all were alike where it noted nothing.
    ///
    /// # Errors
    /// A note that cannot be read.
    pub fn of(manifest: &Manifest) -> crate::Result<Self> {
        let Some(note) = manifest.notes.get(BRIGHTNESS) else { return Ok(Self::default()) };
        serde_json::from_value(note.clone()).map_err(|error| {
            let mend = "run 'fastlgs preprocess' again";
            crate::Error::Invalid(format!("scene.json: the note of the photos' brightness cannot be read ({error}); {mend}"))
        })
    }

    pub(super) fn note(&self, manifest: &mut Manifest) -> Result<(), serde_json::Error> {
        manifest.notes.insert(BRIGHTNESS.to_owned(), serde_json::to_value(self)?);
        Ok(())
    }

    /// Of a photo.
    pub fn gain(&self, name: &str) -> [f32; 3] {
        self.gains.get(name).copied().unwrap_or([1.0; 3])
    }
}
