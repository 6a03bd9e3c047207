//! One module per command that does more than call the pipeline.

mod bind;
pub mod export;
pub mod info;
mod library;
mod lines;
pub mod make;
pub mod models;
pub mod names;
pub mod query;
pub mod serve;
pub mod shell;
pub mod train;
