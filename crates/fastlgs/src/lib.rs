//! The pipeline of FastLGS: from photos to a scene that answers text queries.
//!
//! Each stage is a function that takes a configuration and a [`Run`], and returns a report.
//! Configurations and reports are plain data (`serde`):
//!
//! * [`preprocess`](preprocess()): photos to masks, poses, key point matches and points;
//! * [`train`](train()): Gaussians with colour, then [`objects`];
//! * [`make`](make()): both, without repeating finished work;
//! * [`Scene`]: an opened scene that renders and answers queries;
//! * [`eval`](eval()), [`export`](export()), [`synth`](synth()): accuracy, other formats, generated
//!   scenes;
//! * [`render`](render()), [`library`]: images of views, and search in many scenes.
//!
//! No function prints or ends the process. The caller receives progress and warnings through
//! [`progress::Sink`], and can cancel there. Stages read and write a scene folder
//! ([`fastlgs_core::SceneFolder`]). A stage that fails keeps earlier results.

mod absent;
mod cache;
pub mod calibrate;
pub mod calibrations;
mod checkpoints;
mod compared;
pub mod detections;
mod embedding_views;
mod error;
pub mod eval;
mod everyday;
pub mod export;
pub mod library;
pub mod listing;
pub mod make;
pub mod masks;
pub mod model_choice;
pub mod names;
pub mod objects;
mod output;
mod paper;
pub mod preprocess;
pub mod progress;
pub mod query;
pub mod remove;
pub mod render;
pub mod scene;
pub mod scene_notes;
mod staged;
mod stop_point;
pub mod synth;
pub mod teach;
pub mod train;
mod transparent;
pub mod visibility;

pub use error::{Error, Result, one_sentence};
pub use eval::{EvalConfig, EvalReport, eval};
pub use export::{ExportConfig, ExportReport, export};
pub use fastlgs_core::{Camera, Gaussians, SceneFolder};
pub use listing::{ListConfig, ListReport, list};
pub use make::{MakeConfig, MakeReport, make};
pub use preprocess::{PreprocessConfig, PreprocessReport, preprocess};
pub use progress::{Run, Silent};
pub use query::{Answer, ObjectQuery, Pixels};
pub use remove::{RemoveConfig, RemoveReport, remove};
pub use render::{RenderConfig, RenderReport, render};
pub use scene::Scene;
pub use scene_notes::SceneNotes;
pub use synth::{SynthConfig, SynthReport, synth};
pub use train::{TrainConfig, TrainReport, train};
