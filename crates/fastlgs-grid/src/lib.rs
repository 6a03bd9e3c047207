//! The semantic feature grid of FastLGS: masks become objects (by the paper's [`mapping`], or by [`consensus`], [`election`],
//! [`support`] and [`objects`]), objects get low-dimensional codes ([`codes`]) and keep all their embeddings ([`grid`]), and a text
//! finds its object ([`relevancy`], [`query`]).

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
pub mod objects;
pub mod overlaps;
pub mod query;
pub mod relevancy;
pub mod sightings;
pub mod support;

pub use grid::{Grid, Object};

/// Errors of the grid.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Files.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
    /// Ids have 16 bits.
    #[error("there would be more than 65,535 objects: lower --theta or --tau, or use --mapping global")]
    TooManyObjects,
}

/// Result of the grid crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
