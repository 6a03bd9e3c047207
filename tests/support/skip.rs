//! Reports tests that are skipped.

use std::io::Write;

/// Prints why a test is skipped. The text is shown although the output of passing tests is not.
pub fn skip(reason: impl std::fmt::Display) {
    // Test programs capture only the output of macros such as `eprintln!`.
    let _ = writeln!(std::io::stderr(), "SKIPPED: {reason}");
}
