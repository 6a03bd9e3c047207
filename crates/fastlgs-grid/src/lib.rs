//! The object table of FastLGS, which the paper calls semantic feature grid.
//!
//! Masks become objects by the paper's Algorithm 1 ([`mapping`]) or by global mapping
//! ([`consensus`], [`election`], [`support`], [`objects`]).
//! Each object has a low-dimensional code ([`codes`]) and the embeddings of its masks ([`grid`]).
//! A text query finds its objects by [`relevancy`], [`evidence`] and [`query`].

pub mod calibration;
pub mod codebook;
pub mod codes;
pub mod consensus;
pub mod decision;
pub mod election;
pub mod evidence;
pub mod field;
pub mod grid;
pub mod hull;
pub mod mapping;
pub mod mask_pairs;
pub mod objects;
pub mod observations;
pub mod overlaps;
pub mod query;
pub mod relevancy;
pub mod support;

pub use grid::{Grid, Object};

/// Errors of the object table.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file cannot be read or written.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
    /// Object ids have 16 bits.
    #[error("the masks make more than 65,535 objects; lower theta or tau, or use global mapping")]
    TooManyObjects,
}

/// Result of the grid crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
