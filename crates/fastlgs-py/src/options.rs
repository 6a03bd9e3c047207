//! Conversion of keyword arguments to configurations, and of reports to dictionaries, by way of
//! JSON.

use crate::Error;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyCFunction, PyDict, PyTupleMethods};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

fn to_error(error: impl std::fmt::Display) -> PyErr {
    Error::new_err(error.to_string())
}

/// Converts an option that is not JSON: NumPy numbers and arrays, and paths.
fn to_json_type<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    if value.hasattr("tolist")? {
        return value.call_method0("tolist");
    }
    let path = value.py().import("os")?.call_method1("fspath", (value,));
    path.map_err(|_| Error::new_err(format!("'{value}' is not a number, text, path or list")))
}

/// Returns a configuration with the given options replaced.
///
/// # Errors
/// An unknown option, or a value of the wrong type.
pub fn with_options<T: Serialize + DeserializeOwned>(
    known: &T,
    options: Option<&Bound<'_, PyDict>>,
) -> PyResult<T> {
    let mut all = serde_json::to_value(known).map_err(to_error)?;
    let Some(options) = options else {
        return serde_json::from_value(all).map_err(to_error);
    };
    let py = options.py();
    let default = PyCFunction::new_closure(py, None, None, |arguments, _| {
        to_json_type(&arguments.get_item(0)?).map(Bound::unbind)
    })?;
    let keywords = [("default", default)].into_py_dict(py)?;
    let dumped = py
        .import("json")?
        .call_method("dumps", (options,), Some(&keywords));
    let plain =
        dumped.map_err(|error| Error::new_err(format!("an option is not valid: {error}")))?;
    let given: serde_json::Map<String, Value> =
        serde_json::from_str(&plain.extract::<String>()?).map_err(to_error)?;
    for (name, value) in given {
        let Some(place) = all.get_mut(&name) else {
            let names: Vec<&str> = all
                .as_object()
                .into_iter()
                .flat_map(|all| all.keys().map(String::as_str))
                .collect();
            return Err(Error::new_err(format!(
                "unknown option '{name}'; the options are {}",
                names.join(", ")
            )));
        };
        let before = place.clone();
        *place = value;
        // Checked one by one, so that the message names the invalid option.
        if let Err(error) = serde_json::from_value::<T>(all.clone()) {
            return Err(Error::new_err(format!(
                "the option '{name}' is not valid: {error}; its default is {before}"
            )));
        }
    }
    serde_json::from_value(all).map_err(to_error)
}

/// Returns a value of an option by its name, such as `quick`.
///
/// # Errors
/// An unknown name.
pub fn value_of<T: DeserializeOwned>(option: &str, name: &str) -> PyResult<T> {
    serde_json::from_value(Value::from(name))
        .map_err(|error| Error::new_err(format!("the option '{option}' is not valid: {error}")))
}

/// Converts a report to dictionaries, lists and numbers.
///
/// # Errors
/// None for the reports of this crate.
pub fn to_python<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(to_error)?;
    py.import("json")?.call_method1("loads", (text,))
}
