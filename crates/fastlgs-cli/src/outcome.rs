//! How a command ended when it did not fail.

/// What the exit code tells.
pub enum Outcome {
    /// Done.
    Done,
    /// A query that nothing in the scene matches.
    NotFound,
}
