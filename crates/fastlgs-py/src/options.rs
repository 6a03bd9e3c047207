//! Keyword arguments to configurations, and reports to dictionaries: by way of JSON, which both have.

use crate::Error;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

fn refused(error: impl std::fmt::Display) -> PyErr {
    Error::new_err(error.to_string())
}

/// A configuration with some of its values replaced.
///
/// # Errors
/// An option that it does not have, or a value that does not fit.
pub fn with<T: Serialize + DeserializeOwned>(known: &T, options: Option<&Bound<'_, PyDict>>) -> PyResult<T> {
    let mut all = serde_json::to_value(known).map_err(refused)?;
    let Some(options) = options else { return serde_json::from_value(all).map_err(refused) };
    let py = options.py();
    // Paths are options, too.
    let how = [("default", py.import("os")?.getattr("fspath")?)].into_py_dict(py)?;
    let plain = py.import("json")?.call_method("dumps", (options,), Some(&how))?;
    let given: serde_json::Map<String, Value> = serde_json::from_str(&plain.extract::<String>()?).map_err(refused)?;
    for (name, value) in given {
        let Some(place) = all.get_mut(&name) else {
            let names: Vec<&str> = all.as_object().into_iter().flat_map(|all| all.keys().map(String::as_str)).collect();
            return Err(Error::new_err(format!("there is no option '{name}'; there are {}", names.join(", "))));
        };
        let before = place.clone();
        *place = value;
        // One by one, so that the message names the one that does not fit.
        if let Err(error) = serde_json::from_value::<T>(all.clone()) {
            return Err(Error::new_err(format!("the option '{name}' does not fit: {error}; by default it is {before}")));
        }
    }
    serde_json::from_value(all).map_err(refused)
}

/// A value by its name, such as `quick`.
///
/// # Errors
/// A name that there is not.
pub fn value_of<T: DeserializeOwned>(option: &str, name: &str) -> PyResult<T> {
    serde_json::from_value(Value::from(name)).map_err(|error| Error::new_err(format!("the option '{option}' does not fit: {error}")))
}

/// A report as dictionaries, lists and numbers.
///
/// # Errors
/// None that a report gives cause for.
pub fn to_python<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(refused)?;
    py.import("json")?.call_method1("loads", (text,))
}
