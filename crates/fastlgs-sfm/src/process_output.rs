//! Reads the output of other programs.

use std::io::{BufRead, BufReader, Read};

/// Returns the lines of a stream. Invalid UTF-8 is replaced.
pub(crate) fn lines(stream: impl Read) -> impl Iterator<Item = String> {
    BufReader::new(stream)
        .split(b'\n')
        .map_while(std::result::Result::ok)
        .map(|line| String::from_utf8_lossy(&line).into_owned())
}
