//! What `preprocess` is asked for, and what it reports.

use crate::eyes::Eyes;
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

/// What is preprocessed, and how.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Config {
    /// Folder with images/ and poses: sparse/0 (COLMAP), transforms.json or poses_bounds.npy; without poses COLMAP finds them.
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
            eyes: Eyes::default(),
            neighbours: 10,
            memory: 4_000_000_000,
        }
    }
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
    /// Masks of the highest level on all training photos.
    pub masks: usize,
    /// Mean number of masks a photo, by level.
    pub masks_per_photo: BTreeMap<String, f64>,
    /// Pairs of key points that matched.
    pub key_point_matches: usize,
    /// Points to start Gaussians from.
    pub points: usize,
    /// What found the key points.
    pub sift: String,
    /// Cameras whose poses contradicted the photos and were moved.
    pub moved_cameras: usize,
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

/// The manifest's note of how much the photos' brightness varies, in stops.
pub(super) const BRIGHTNESS_SPREAD: &str = "brightness_spread_stops";

/// How much the brightness of a scene's photos varies, in stops, where that is known.
pub fn brightness_spread(manifest: &Manifest) -> Option<f64> {
    manifest.notes.get(BRIGHTNESS_SPREAD)?.as_f64()
}
