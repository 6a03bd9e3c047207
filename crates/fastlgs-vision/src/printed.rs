//! What other programs print.

use std::io::{BufRead, BufReader, Read};

/// Line by line, whatever its letters.
pub(crate) fn lines(stream: impl Read) -> impl Iterator<Item = String> {
    BufReader::new(stream).split(b'\n').map_while(std::result::Result::ok).map(|line| String::from_utf8_lossy(&line).into_owned())
}
