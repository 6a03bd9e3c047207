//! Keyword arguments to configurations, and reports to dictionaries: by way of JSON, which both have.

use crate::Error;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyCFunction, PyDict, PyTupleMethods};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

fn refused(error: impl std::fmt::Display) -> PyErr {
    Error::new_err(error.to_string())
}

/// An option that JSON does not know as one that it does: numbers and arrays of NumPy, and paths.
fn plain<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    if value.hasattr("tolist")? {
        return value.call_method0("tolist");
    }
    let path = value.py().import("os")?.call_method1("fspath", (value,));
    path.map_err(|_| Error::new_err(format!("'{value}' is no number, text, path or list")))
}

/// A configuration with some of its values replaced.
///
/// # Errors
/// An option that it does not have, or a value that does not fit.
pub fn with<T: Serialize + DeserializeOwned>(known: &T, options: Option<&Bound<'_, PyDict>>) -> PyResult<T> {
    let mut all = serde_json::to_value(known).map_err(refused)?;
    let Some(options) = options else { return serde_json::from_value(all).map_err(refused) };
    let py = options.py();
    let default = PyCFunction::new_closure(py, None, None, |arguments, _| plain(&arguments.get_item(0)?).map(Bound::unbind))?;
    let how = [("default", default)].into_py_dict(py)?;
    let dumped = py.import("json")?.call_method("dumps", (options,), Some(&how));
    let plain = dumped.map_err(|error| Error::new_err(format!("an option does not fit: {error}")))?;
    let given: serde_json::Map<String, Value> = serde_json::from_str(&plain.extract::<String>()?).map_err(refused)?;
    for (name, value) in given {
        // Its name in earlier versions.
        let name = if name == "init_ply" { "init".to_owned() } else { name };
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
