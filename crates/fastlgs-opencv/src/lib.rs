//! Bindings to the system's OpenCV. Each function has a C wrapper in a `.cpp` file.

pub mod inpaint;
pub mod sift;

use std::ffi::{CStr, c_char, c_int};

/// Errors of OpenCV.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A picture with a longer side, in pixels, than OpenCV's integers can hold.
    #[error("OpenCV cannot process a picture with a side of {0} pixels; use a smaller picture")]
    Side(u32),
    /// A function of OpenCV failed: its name and the reason.
    #[error("{0} failed: {1}")]
    Failed(&'static str, String),
}

/// Result of OpenCV.
pub type Result<T> = std::result::Result<T, Error>;

/// Converts the side of a picture, in pixels, to OpenCV's integer type.
fn side(length: u32) -> Result<c_int> {
    c_int::try_from(length).map_err(|_| Error::Side(length))
}

/// Calls a C wrapper, which receives a buffer and its size in bytes. The wrapper returns 0 or more,
/// or -1 after it has written a zero-terminated reason into the buffer.
fn checked(what: &'static str, call: impl FnOnce(*mut c_char, usize) -> c_int) -> Result<usize> {
    let mut reason = [0 as c_char; 256];
    let returned = call(reason.as_mut_ptr(), reason.len());
    usize::try_from(returned).map_err(|_| {
        // SAFETY: the buffer starts as zeros, and the function ends the text with a zero.
        let words = unsafe { CStr::from_ptr(reason.as_ptr()) };
        Error::Failed(what, words.to_string_lossy().into_owned())
    })
}
