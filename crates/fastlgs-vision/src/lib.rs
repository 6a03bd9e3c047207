//! Eyes of FastLGS: segmenters, image and text encoders (ONNX Runtime), and key points (SIFT).
//!
//! A new segmenter is one file behind [`Segmenter`], a new encoder one file behind [`Encoder`].

pub mod appearance;
pub mod attributes;
pub mod brightness;
pub mod bundle;
pub mod clip;
pub mod clip_tokens;
pub mod conse;
pub mod crops;
pub mod edges;
pub mod encoder;
pub mod exposure;
pub mod frame;
pub mod histogram;
pub mod import;
pub mod inpaint;
pub mod keypoints;
pub mod masks;
pub mod matching;
pub mod models;
pub mod names;
#[cfg(feature = "opencv")]
mod opencv;
pub mod photo_quality;
pub mod places;
pub mod pose_check;
pub mod pose_convention;
mod printed;
pub mod pull;
#[cfg(test)]
mod reference;
pub mod regions;
pub mod resection;
#[cfg(test)]
mod ring;
pub mod runtime;
pub mod sam;
pub mod segmenter;
pub mod similarity;
pub mod structure;
pub mod sweep;
pub mod text;
pub mod tracks;
pub mod triangulate;
pub mod video;

#[cfg(test)]
#[path = "../../../tests/support/onnx.rs"]
mod onnx;
#[cfg(test)]
#[path = "../../../tests/support/toy_models.rs"]
mod toy_models;

pub use clip::{ClipImage, ClipText};
pub use conse::Conse;
pub use encoder::{Encoder, TextEncoder};
pub use import::Import;
pub use sam::Sam;
pub use segmenter::{OfflineSegmenter, Segmenter};
pub use text::{MiniLm, OfflineText};

/// Errors of the vision crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Weights or the ONNX Runtime library are not installed.
    #[error("{0}")]
    Missing(String),
    /// ONNX Runtime refused a model or an input.
    #[error("{model}: {reason}")]
    Inference {
        /// File of the model.
        model: String,
        /// What ONNX Runtime said.
        reason: String,
    },
    /// Data that does not fit.
    #[error("{0}")]
    Invalid(String),
    /// Files.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
}

/// Result of the vision crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
