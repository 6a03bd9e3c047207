//! Errors of the pipeline: one sentence that names the file and the mend, with the chain of causes behind it.

use std::fmt::Display;

/// Why a stage did not finish.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Files, datasets, images.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
    /// Devices and training.
    #[error(transparent)]
    Raster(#[from] fastlgs_raster::Error),
    /// Objects and queries.
    #[error(transparent)]
    Grid(#[from] fastlgs_grid::Error),
    /// Segmenters, encoders, key points.
    #[error(transparent)]
    Vision(#[from] fastlgs_vision::Error),
    /// The system's refusal.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A value that has no JSON.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// An intermediate result that cannot be kept.
    #[error(transparent)]
    Cache(#[from] postcard::Error),
    /// Input or options that do not fit.
    #[error("{0}")]
    Invalid(String),
    /// What was being done when the cause arose.
    #[error("{what}")]
    While {
        /// The work, in words.
        what: String,
        /// The cause.
        source: Box<Error>,
    },
    /// Whoever watches the run asked for its end.
    #[error("cancelled")]
    Cancelled,
}

/// Result of the pipeline.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The chain of causes in one line; a cause that its parent already quotes is not repeated.
pub fn one_sentence(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(own) = cause {
        let words = own.to_string();
        if !text.contains(&words) {
            text = format!("{text}: {words}");
        }
        cause = own.source();
    }
    text
}

/// Says what was being done where something fails.
pub(crate) trait Context<T> {
    /// Adds `what` to the cause.
    fn context(self, what: impl Display) -> Result<T>;
    /// Adds `what()` to the cause.
    fn with_context<S: Display>(self, what: impl FnOnce() -> S) -> Result<T>;
}

impl<T, E: Into<Error>> Context<T> for Result<T, E> {
    fn context(self, what: impl Display) -> Result<T> {
        self.with_context(|| what)
    }

    fn with_context<S: Display>(self, what: impl FnOnce() -> S) -> Result<T> {
        self.map_err(|source| Error::While { what: what().to_string(), source: Box::new(source.into()) })
    }
}

impl<T> Context<T> for Option<T> {
    fn context(self, what: impl Display) -> Result<T> {
        self.with_context(|| what)
    }

    fn with_context<S: Display>(self, what: impl FnOnce() -> S) -> Result<T> {
        self.ok_or_else(|| Error::Invalid(what().to_string()))
    }
}

/// Returns [`Error::Invalid`] with a formatted sentence.
macro_rules! bail {
    ($($words:tt)*) => {
        return Err($crate::Error::Invalid(format!($($words)*)))
    };
}
pub(crate) use bail;
