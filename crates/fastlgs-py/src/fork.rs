//! A process that was forked while this module was in use has none of its threads, and would wait for them for ever.

use crate::Error;
use pyo3::PyResult;
use std::sync::OnceLock;

/// The process in which threads were started.
static OWNER: OnceLock<u32> = OnceLock::new();

/// Fails in a forked child of the process that used this module first.
///
/// # Errors
/// One sentence with the mend.
pub fn check() -> PyResult<()> {
    let own = std::process::id();
    if *OWNER.get_or_init(|| own) == own {
        return Ok(());
    }
    Err(Error::new_err(
        "this process was forked from one that used fastlgs, whose threads it does not have; start processes with the method 'spawn' \
         (multiprocessing.get_context(\"spawn\")), or use fastlgs in the children only",
    ))
}
