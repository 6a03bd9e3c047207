//! What the system's OpenCV does for us, each behind one plain C function.

pub mod inpaint;
pub mod sift;

use crate::{Error, Result};
use std::ffi::{CStr, c_char, c_int};

/// A side of a picture as OpenCV counts.
fn side(length: u32) -> Result<c_int> {
    c_int::try_from(length).map_err(|_| Error::Invalid(format!("OpenCV: a side of {length} pixels is too long")))
}

/// What a function returned that gives a number from 0, or -1 with the reason in the buffer (and its size) that it was handed, as a text that
/// ends with a zero.
fn checked(what: &str, call: impl FnOnce(*mut c_char, usize) -> c_int) -> Result<usize> {
    let mut reason = [0 as c_char; 256];
    let returned = call(reason.as_mut_ptr(), reason.len());
    usize::try_from(returned).map_err(|_| {
        // SAFETY: the function ended the text with a zero; the buffer began as zeros.
        let words = unsafe { CStr::from_ptr(reason.as_ptr()) };
        Error::Invalid(format!("{what} failed: {}", words.to_string_lossy()))
    })
}
