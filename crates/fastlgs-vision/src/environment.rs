//! ONNX Runtime, which is loaded from a shared library, or linked in with the feature
//! `download-ort`.

use crate::{Error, Result, model_paths};
use ort::environment::Environment;
use std::sync::Mutex;

static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// Returns the process-wide environment, and creates it on first use.
pub(crate) fn environment() -> Result<Environment> {
    let mut slot = ENVIRONMENT.lock().expect("no panic while holding the lock");
    if let Some(environment) = slot.as_ref() {
        return Ok(environment.clone());
    }
    let library = model_paths::runtime_library()?;
    let failed = |e: &dyn std::fmt::Display| {
        Error::Missing(format!(
            "{}: ONNX Runtime cannot be loaded: {e}",
            library.display()
        ))
    };
    #[cfg(feature = "load-ort")]
    let builder = ort::init_from(&library).map_err(|e| failed(&e))?;
    #[cfg(not(feature = "load-ort"))]
    let builder = ort::init();
    let environment = builder
        .with_name("fastlgs")
        .build()
        .map_err(|e| failed(&e))?;
    Ok(slot.insert(environment).clone())
}
