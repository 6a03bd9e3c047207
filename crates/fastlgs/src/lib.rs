//! The pipeline of FastLGS: from photos to a scene that answers text.
//!
//! Each stage is a function of a configuration and a [`Run`], and returns a report; both are plain data (`serde`):
//!
//! * [`preprocess`](preprocess()): photos (with poses) to masks, embeddings, key points and points;
//! * [`train`](train()): Gaussians with colour, then [`objects`] on them;
//! * [`make`](make()): both, where they were not done before;
//! * [`Session`]: an opened scene that renders and answers;
//! * [`eval`](eval()), [`export`](export()), [`synth`](synth()): accuracy, other formats, generated scenes;
//! * [`render`](render()), [`library`]: pictures of views, and which of many scenes hold a thing.
//!
//! Nothing here prints or ends the process. Who calls hears of progress and warnings through [`progress::Sink`], which also cancels.
//! Files are read and written in a scene folder ([`fastlgs_core::SceneFolder`]); a stage that fails leaves earlier results whole.

mod absent;
mod cache;
pub mod calibrate;
pub mod calibrations;
mod checkpoints;
mod clear;
mod compared;
mod error;
pub mod eval;
pub mod export;
pub mod eyes;
pub mod library;
pub mod make;
pub mod masks;
pub mod names;
pub mod objects;
mod output;
pub mod preprocess;
pub mod progress;
pub mod remove;
pub mod render;
pub mod session;
mod staged;
pub mod synth;
pub mod teach;
pub mod train;

pub use error::{Error, Result, one_sentence};
pub use eval::eval;
pub use export::export;
pub use make::make;
pub use preprocess::preprocess;
pub use progress::{Run, Silent};
pub use remove::remove;
pub use render::render;
pub use session::Session;
pub use synth::synth;
pub use train::train;
