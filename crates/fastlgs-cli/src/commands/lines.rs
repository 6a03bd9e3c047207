//! Questions as lines of standard input, and answers as lines of standard output.

use anyhow::Result;
use serde_json::json;

/// What a line of standard input asks.
pub(super) enum Line {
    /// Nothing: the line is empty.
    None,
    /// A text.
    Text(String),
    /// The line is not text; this is the answer to it.
    Unreadable(serde_json::Value),
}

/// Reads a line.
pub(super) fn line_of(line: &[u8]) -> Line {
    match std::str::from_utf8(line) {
        Err(_) => {
            let shown = String::from_utf8_lossy(line).trim().to_owned();
            Line::Unreadable(json!({ "text": shown, "error": "the line is not UTF-8 text; send it in UTF-8" }))
        }
        Ok(line) => match line.trim().trim_start_matches('\u{feff}') {
            "" => Line::None,
            text => Line::Text(text.to_owned()),
        },
    }
}

/// Whether nobody reads the answers any more, which ends the dialogue quietly.
///
/// # Errors
/// Every other refusal.
pub(super) fn ends(written: std::io::Result<()>) -> Result<bool> {
    match written {
        Ok(()) => Ok(false),
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(true),
        Err(error) => Err(error.into()),
    }
}
