//! A text encoder that runs in Python.

use fastlgs_vision::encoder::normalise;
use fastlgs_vision::{Error, Result, TextEncoder};
use numpy::{PyArrayLike2, TypeMustMatch};
use pyo3::prelude::*;

/// Text encoder by a Python function: a list of str to float32 (texts, numbers).
pub struct Texts(pub Py<PyAny>);

impl TextEncoder for Texts {
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        let rows = |py: Python<'_>| -> PyResult<Vec<Vec<f32>>> {
            let made = self.0.call1(py, (texts.to_vec(),))?;
            let array: PyArrayLike2<'_, f32, TypeMustMatch> = made.extract(py)?;
            Ok(array
                .as_array()
                .outer_iter()
                .map(|row| row.to_vec())
                .collect())
        };
        let mut rows = Python::attach(rows).map_err(|e| {
            Error::Invalid(format!(
                "embed_text: {e}; it must take a list of str and return float32 of (texts, numbers)"
            ))
        })?;
        if rows.len() != texts.len() || rows.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Invalid(format!(
                "embed_text returned {} rows for {} texts; it must return one row of finite numbers per text",
                rows.len(),
                texts.len()
            )));
        }
        rows.iter_mut().for_each(|row| normalise(row));
        Ok(rows)
    }
}
