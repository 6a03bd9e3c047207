//! Outcome of a command that did not fail.

/// Outcome of a command that did not fail; it determines the exit code.
pub enum Outcome {
    /// The command is done: exit code 0.
    Done,
    /// No object matches the query: exit code 3.
    NotFound,
}
