//! Errors of the data layer. Messages name the file and, where possible, how to fix the problem.

use std::path::{Path, PathBuf};

/// An error of reading or writing data.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system reported an error.
    #[error("{}: {source}", path.display())]
    Io {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The content of the file does not match its format.
    #[error("{}: {reason}", path.display())]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// What is wrong and how to fix it.
        reason: String,
    },
    /// A view that does not exist.
    #[error("{0}")]
    NotFound(String),
    /// A request that does not match the data, such as an empty folder.
    #[error("{0}")]
    Invalid(String),
}

/// Result of the data layer.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// Creates an [`Error::Format`] for `path`. Joins the lines of the reason into one and shortens
    /// it to 300 characters.
    pub fn format(path: impl AsRef<Path>, reason: impl AsRef<str>) -> Self {
        const LONGEST: usize = 300;
        let words = reason
            .as_ref()
            .split(|c: char| c.is_whitespace() || c.is_control())
            .filter(|w| !w.is_empty());
        let reason: String = words
            .collect::<Vec<_>>()
            .join(" ")
            .chars()
            .take(LONGEST)
            .collect();
        Self::Format {
            path: path.as_ref().to_owned(),
            reason,
        }
    }

    /// Wraps an I/O error with the path it happened on; for `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::Io { path, source }
    }
}
