//! Models of FastLGS: segmenters, encoders (ONNX Runtime), inpainting, and their downloads.
//!
//! To add a segmenter, implement [`Segmenter`] in a new file; to add an encoder, implement
//! [`Encoder`].

pub mod appearance;
pub mod attributes;
pub mod brighten;
pub mod clip;
pub mod clip_tokens;
pub mod conse;
pub mod crops;
pub mod detector;
pub mod edges;
pub mod encoder;
mod environment;
pub mod histogram;
pub mod import;
pub mod inpaint;
pub mod masks;
pub mod model_paths;
pub mod models;
pub mod names;
pub mod nouns;
pub mod provider;
pub mod pull;
#[cfg(test)]
mod reference;
pub mod regions;
pub mod runtime;
pub mod sam;
pub mod segmenter;
pub mod text;

#[cfg(test)]
#[path = "../../../tests/support/onnx.rs"]
mod onnx;
#[cfg(test)]
#[path = "../../../tests/support/skip.rs"]
mod skip;
#[cfg(test)]
#[path = "../../../tests/support/toy_models.rs"]
mod toy_models;

pub use clip::{ClipImage, ClipText};
pub use conse::Conse;
pub use detector::Detector;
pub use encoder::{Encoder, TextEncoder};
pub use import::Import;
pub use nouns::Nouns;
pub use provider::Provider;
pub use sam::Sam;
pub use segmenter::{OfflineSegmenter, Segmenter};
pub use text::{MiniLm, OfflineText};

/// Errors of the vision crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file, model, library or program is missing.
    #[error("{0}")]
    Missing(String),
    /// A model or its input is not valid, or inference failed.
    #[error("{model}: {reason}")]
    Inference {
        /// File of the model.
        model: String,
        /// Reason of the failure.
        reason: String,
    },
    /// Data with a wrong size, shape or content.
    #[error("{0}")]
    Invalid(String),
    /// An error of `fastlgs-core`, such as a file that cannot be read.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
}

/// Result of the vision crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
