//! Detects forked processes. A child has none of the threads of its parent, and would wait for them
//! forever.

use crate::Error;
use pyo3::PyResult;
use std::sync::OnceLock;

/// Id of the process that used this module first and owns its threads.
static OWNER: OnceLock<u32> = OnceLock::new();

/// Returns an error in a forked child of the process that used this module first.
///
/// # Errors
/// One sentence with the solution.
pub fn check() -> PyResult<()> {
    let own = std::process::id();
    if *OWNER.get_or_init(|| own) == own {
        return Ok(());
    }
    Err(Error::new_err(
        "this process was forked from one that used fastlgs, and has none of its threads; start processes with the method 'spawn' \
         (multiprocessing.get_context(\"spawn\")), or use fastlgs only in the children",
    ))
}
