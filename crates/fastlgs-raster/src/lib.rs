//! Rendering and training of Gaussians on wgpu, with a CPU twin of every pass.
//!
//! Each pass is one WGSL file in `shaders/` and has a twin of the same name in [`cpu`]. The passes
//! of a frame run in this order:
//!
//! `project` -> radix sort of depths -> `gather_counts`, scan -> `emit` -> radix sort of tiles ->
//! `tile_ranges` -> `tile_load`, radix sort of loads -> `blend` -> (training) `ssim_rows`,
//! `ssim_columns`, `ssim_backward_rows`, `loss_gradient` -> `blend_backward` -> `fold_slots` ->
//! `project_backward` -> `adam`. `blend_ids`, `blend_votes` and `blend_saliency` use the same
//! lists.
//!
//! [`Engine`] is the common interface of [`GpuEngine`] and of [`CpuEngine`], which runs vectorised
//! Rust.

pub mod align;
pub mod budget;
mod channels;
pub mod checkpoint;
pub mod cpu;
pub mod density;
mod engine;
mod exposure;
mod floaters;
mod gpu;
mod gpu_engine;
pub mod init;
pub mod lift;
mod native;
mod open;
mod pass;
mod profile;
mod schedule;
mod shader;
mod shape;
mod target;
mod trainer;
mod view;

#[cfg(test)]
#[path = "../../../tests/support/skip.rs"]
mod skip;
#[cfg(test)]
mod tests;

pub use channels::Channels;
pub use engine::{
    Engine, ExposedPhoto, Exposure, Frame, Losses, Memory, StepOptions, TargetImage, pack,
};
pub use floaters::{FEW_VIEWS, FreeSpace};
pub use gpu::{Gpu, adapters};
pub use gpu_engine::GpuEngine;
pub use native::CpuEngine;
pub use open::{Choice, choice, open_engine};

pub use schedule::{Alignment, Budget, TrainerConfig};
pub use shape::Shape;
pub use target::{Target, Targets};
pub use trainer::{Progress, Trainer, TrainerReport};
pub use view::{Rates, Step, View};

/// Errors of the rasteriser.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is no adapter, or none with this name.
    #[error("{0}")]
    Adapter(String),
    /// The scene or the image does not fit the adapter.
    #[error("{0}")]
    TooLarge(String),
    /// The device failed during the work.
    #[error("the device '{device}' failed: {reason}")]
    Device {
        /// Adapter name.
        device: String,
        /// Message of wgpu.
        reason: String,
    },
    /// Input that cannot be trained or rendered.
    #[error("{0}")]
    Invalid(String),
    /// A photo or another training image cannot be read.
    #[error(transparent)]
    Picture(Box<dyn std::error::Error + Send + Sync>),
    /// Reading or writing a checkpoint failed.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
}

/// Result of the rasteriser.
pub type Result<T, E = Error> = std::result::Result<T, E>;
