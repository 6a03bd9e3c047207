//! One module a command.

pub mod batch;
pub mod bench;
pub mod eval;
pub mod export;
pub mod info;
pub mod models;
mod objects;
pub mod preprocess;
pub mod query;
pub mod render;
pub mod serve;
pub mod shell;
pub mod synth;
pub mod train;
