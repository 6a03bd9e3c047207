//! Errors of the data layer. Every message names the file and, where one is known, the mend.

use std::path::{Path, PathBuf};

/// What can go wrong while reading or writing data.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder concerned.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file was read but its content is not what its format promises.
    #[error("{}: {reason}", path.display())]
    Format {
        /// The file concerned.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// A request that does not fit the data (unknown view, empty folder, ...).
    #[error("{0}")]
    Invalid(String),
}

/// Result of the data layer.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An [`Error::Format`] for `path`. What parsers say in several lines, or repeat from the file, becomes one line.
    pub fn format(path: impl AsRef<Path>, reason: impl AsRef<str>) -> Self {
        const LONGEST: usize = 300;
        let words = reason.as_ref().split(|c: char| c.is_whitespace() || c.is_control()).filter(|w| !w.is_empty());
        let reason: String = words.collect::<Vec<_>>().join(" ").chars().take(LONGEST).collect();
        Self::Format { path: path.as_ref().to_owned(), reason }
    }

    /// Wraps an I/O error with the path it happened on; for `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::Io { path, source }
    }
}
