//! Answers.

use crate::options::to_python;
use fastlgs::session::answer::Report;
use numpy::PyArray2;
use pyo3::prelude::*;

/// What a question was answered with, in one view.
#[pyclass(frozen, module = "fastlgs")]
pub struct Answer {
    /// What is told of it.
    pub report: Report,
    /// Pixels of the answer, `(height, width)`.
    pub mask: Py<PyArray2<bool>>,
    /// How much each pixel is like what was asked for, `(height, width)`.
    pub relevancy: Py<PyArray2<f32>>,
}

#[pymethods]
impl Answer {
    /// What was asked.
    #[getter]
    fn text(&self) -> &str {
        &self.report.text
    }

    /// Whether anything in the scene matches.
    #[getter]
    fn found(&self) -> bool {
        self.report.found
    }

    /// The share of absent names whose best score is lower.
    #[getter]
    fn confidence(&self) -> f32 {
        self.report.score
    }

    /// Name of the view.
    #[getter]
    fn view(&self) -> &str {
        &self.report.view
    }

    /// The view that shows the answer best, where this one hardly does.
    #[getter]
    fn seen_best(&self) -> Option<&str> {
        self.report.seen_best.as_deref()
    }

    /// Pixels of the answer: bool, (height, width).
    #[getter]
    fn mask(&self, py: Python<'_>) -> Py<PyArray2<bool>> {
        self.mask.clone_ref(py)
    }

    /// Confidence of the object that each pixel shows: float32, (height, width), 0 to 1.
    #[getter]
    fn relevancy(&self, py: Python<'_>) -> Py<PyArray2<f32>> {
        self.relevancy.clone_ref(py)
    }

    /// The objects of the answer: id, parent, support, score, bbox2d, bbox3d, pixels, gaussians.
    #[getter]
    fn objects<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.report.objects)
    }

    /// The same as `query --json` prints.
    #[getter]
    fn report<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.report)
    }

    fn __bool__(&self) -> bool {
        self.report.found
    }

    fn __repr__(&self) -> String {
        let Report { text, found, score, pixels, view, .. } = &self.report;
        let found = if *found { "found" } else { "not found" };
        format!("Answer('{text}': {found}, confidence {score:.2}, {pixels} pixels in {view})")
    }
}
