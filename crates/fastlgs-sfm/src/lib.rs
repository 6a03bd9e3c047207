//! Structure from motion of FastLGS: from photos or a video to poses, tracks and depth.
//!
//! [`keypoints`] and [`matching`] find correspondences; [`tracks`] and [`triangulate`] compute
//! points from them. [`structure`] computes missing poses. [`bundle`], [`resection`],
//! [`pose_check`] and [`pose_convention`] refine and check given poses. [`sweep`] estimates depth,
//! and [`brightness`] the brightness of each photo. [`video`] selects frames.

pub mod brightness;
pub mod bundle;
mod conjugate_gradients;
pub mod depth_map;
pub mod frame;
pub mod keypoints;
pub mod matching;
mod neighbours;
pub mod photo_quality;
mod plane;
pub mod pose_check;
pub mod pose_convention;
mod process_output;
pub mod resection;
#[cfg(test)]
mod ring;
pub mod similarity;
#[cfg(all(test, feature = "opencv", feature = "rust-sift"))]
#[path = "../../../tests/support/skip.rs"]
mod skip;
pub mod structure;
pub mod surfaces;
pub mod sweep;
pub mod tracks;
pub mod triangulate;
pub mod video;

use std::path::PathBuf;

/// Errors of structure from motion.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The photos have no poses, and neither pycolmap nor COLMAP is installed.
    #[error(
        "the photos have no poses, and no program that computes poses is installed: run 'fastlgs models install-offline', which installs pycolmap, or install COLMAP ('apt-get install colmap'), or provide poses with the photos"
    )]
    NoPoseProgram,
    /// Only the program COLMAP is installed. Poses for given lenses, one for each photo, need
    /// pycolmap.
    #[error(
        "this needs pycolmap, but only the program 'colmap' is installed; run 'fastlgs models install-offline' to install pycolmap"
    )]
    NoPycolmap,
    /// The program that computes poses failed.
    #[error("{program} failed while finding poses ({stage}): {reason}")]
    PoseProgram {
        /// Path or name of the program.
        program: String,
        /// Stage that failed.
        stage: String,
        /// Its last line of output, or the error of the operating system.
        reason: String,
    },
    /// Too few photos to compute poses.
    #[error("{}: {found} photos found; computing poses needs at least 3{notes}", folder.display())]
    TooFewPhotos {
        /// Folder of the photos.
        folder: PathBuf,
        /// Number of photos in it.
        found: usize,
        /// Files that were not read, each after "; ".
        notes: String,
    },
    /// COLMAP computed no pose for any photo of the folder.
    #[error("{}: COLMAP could place no photo; check that the photos are sharp and that neighbouring photos overlap", .0.display())]
    NoPoses(PathBuf),
    /// The callback cancelled the search for poses.
    #[error("the search for poses was cancelled")]
    Cancelled,
    /// The program ffmpeg cannot be started.
    #[error("{}: reading videos needs ffmpeg, which cannot be started; install it ('apt-get install ffmpeg'), or give a folder of photos", .0.display())]
    NoFfmpeg(PathBuf),
    /// A video that ffmpeg cannot read.
    #[error("{}: ffmpeg cannot read this video: {reason}", video.display())]
    UnreadableVideo {
        /// File of the video.
        video: PathBuf,
        /// Last line of ffmpeg's error output.
        reason: String,
    },
    /// A video in which the camera hardly moves.
    #[error("{}: only {views} different views found, at least 3 are needed; move the camera around the scene for several seconds", video.display())]
    StillVideo {
        /// File of the video.
        video: PathBuf,
        /// Number of different views.
        views: usize,
    },
    /// SIFT failed.
    #[error("SIFT failed: {0}")]
    KeyPoints(String),
    /// An error of `fastlgs-core`, such as a file that cannot be read.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
}

/// Result of structure from motion.
pub type Result<T, E = Error> = std::result::Result<T, E>;
