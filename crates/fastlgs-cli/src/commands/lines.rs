//! Queries as lines of standard input, and answers as lines of standard output.

use anyhow::Result;
use serde_json::json;

/// A line of standard input.
pub(super) enum Line {
    /// An empty line.
    None,
    /// A text query.
    Text(String),
    /// A line that is not UTF-8, with the error as its answer.
    Unreadable(serde_json::Value),
}

/// Parses a line.
pub(super) fn parse_line(line: &[u8]) -> Line {
    match std::str::from_utf8(line) {
        Err(_) => {
            let lossy_text = String::from_utf8_lossy(line).trim().to_owned();
            Line::Unreadable(
                json!({ "text": lossy_text, "error": "the line is not UTF-8 text; send it in UTF-8" }),
            )
        }
        Ok(line) => match line.trim().trim_start_matches('\u{feff}') {
            "" => Line::None,
            text => Line::Text(text.to_owned()),
        },
    }
}

/// Returns true if the reader has closed the pipe, which ends the dialogue without an error.
///
/// # Errors
/// Any other I/O error.
pub(super) fn is_closed(written: std::io::Result<()>) -> Result<bool> {
    match written {
        Ok(()) => Ok(false),
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(true),
        Err(error) => Err(error.into()),
    }
}
