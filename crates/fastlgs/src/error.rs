//! Errors of the pipeline: each message names the file and the remedy, and has a chain of causes.

use std::fmt::Display;

/// Reason why a stage fails.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Error of files, data sets or images.
    #[error(transparent)]
    Core(#[from] fastlgs_core::Error),
    /// Error of devices or training.
    #[error(transparent)]
    Raster(#[from] fastlgs_raster::Error),
    /// Error of objects or queries.
    #[error(transparent)]
    Grid(#[from] fastlgs_grid::Error),
    /// Error of structure from motion or a video.
    #[error(transparent)]
    Sfm(#[from] fastlgs_sfm::Error),
    /// Error of segmenters, encoders or inpainting.
    #[error(transparent)]
    Vision(#[from] fastlgs_vision::Error),
    /// Error of the operating system.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Value that cannot be converted from or to JSON.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// Intermediate result that cannot be stored in the cache.
    #[error(transparent)]
    Cache(#[from] postcard::Error),
    /// A view, object or name that does not exist.
    #[error("{0}")]
    NotFound(String),
    /// A field of a configuration with a value that cannot be used.
    #[error("{option}: {reason}")]
    Option {
        /// Name of the field.
        option: &'static str,
        /// Reason, with the names and values of other fields that solve it.
        reason: String,
    },
    /// Invalid input.
    #[error("{0}")]
    Invalid(String),
    /// Step that failed, with its cause.
    #[error("{what}")]
    While {
        /// Description of the step.
        what: String,
        /// The cause.
        source: Box<Error>,
    },
    /// The progress sink cancelled the run.
    #[error("cancelled")]
    Cancelled,
}

/// Result of the pipeline.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Returns an error with its causes in one line. A cause that the text already contains is not
/// repeated.
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

/// Adds a description of the failed step to an error.
pub(crate) trait Context<T> {
    /// Adds `what` to the error.
    fn context(self, what: impl Display) -> Result<T>;
    /// Adds the result of `what` to the error.
    fn with_context<S: Display>(self, what: impl FnOnce() -> S) -> Result<T>;
}

impl<T, E: Into<Error>> Context<T> for Result<T, E> {
    fn context(self, what: impl Display) -> Result<T> {
        self.with_context(|| what)
    }

    fn with_context<S: Display>(self, what: impl FnOnce() -> S) -> Result<T> {
        self.map_err(|source| Error::While {
            what: what().to_string(),
            source: Box::new(source.into()),
        })
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

impl Error {
    /// Creates an [`Error::Option`].
    pub(crate) fn option(option: &'static str, reason: impl Into<String>) -> Self {
        let reason = reason.into();
        Self::Option { option, reason }
    }
}

/// Returns [`Error::Invalid`] with a formatted sentence.
macro_rules! bail {
    ($($words:tt)*) => {
        return Err($crate::Error::Invalid(format!($($words)*)))
    };
}
pub(crate) use bail;
