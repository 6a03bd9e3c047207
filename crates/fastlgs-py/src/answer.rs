//! The Python class `Answer`.

use crate::object::FoundObject;
use crate::options::to_python;
use fastlgs::query::answer::AnswerReport;
use numpy::PyArray2;
use pyo3::prelude::*;

/// The answer to a query in one view. It is true if something was found.
#[pyclass(frozen, module = "fastlgs")]
pub struct Answer {
    /// Report of the answer.
    pub report: AnswerReport,
    /// Mask of the answer, `(height, width)`.
    pub mask: Py<PyArray2<bool>>,
    /// Confidence of the object at each pixel, 0 to 1, `(height, width)`.
    pub relevancy: Py<PyArray2<f32>>,
}

#[pymethods]
impl Answer {
    /// The text, the name of the picture, or the pixels of the query.
    #[getter]
    fn text(&self) -> &str {
        &self.report.text
    }

    /// Whether any object matches.
    #[getter]
    fn found(&self) -> bool {
        self.report.found
    }

    /// Score of the best object, 0 to 1: share of absent names whose best score is lower.
    #[getter]
    fn confidence(&self) -> f32 {
        self.report.score
    }

    /// Name of the view.
    #[getter]
    fn view(&self) -> &str {
        &self.report.view
    }

    /// Name of the view that shows most of the answer, if this view hardly shows it; else None.
    #[getter]
    fn seen_best(&self) -> Option<&str> {
        self.report.seen_best.as_deref()
    }

    /// Mask of the answer: bool, (height, width).
    #[getter]
    fn mask(&self, py: Python<'_>) -> Py<PyArray2<bool>> {
        self.mask.clone_ref(py)
    }

    /// Confidence of the object at each pixel: float32, (height, width), 0 to 1.
    #[getter]
    fn relevancy(&self, py: Python<'_>) -> Py<PyArray2<f32>> {
        self.relevancy.clone_ref(py)
    }

    /// Objects of the answer.
    #[getter]
    fn objects(&self) -> Vec<FoundObject> {
        self.report.objects.iter().map(FoundObject::from).collect()
    }

    /// Nearest objects if nothing was found, at most three: id, score and best_view of each.
    #[getter]
    fn nearest<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.report.nearest)
    }

    /// The report of the answer, as `fastlgs query --json` prints it.
    #[getter]
    fn report<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.report)
    }

    fn __bool__(&self) -> bool {
        self.report.found
    }

    fn __repr__(&self) -> String {
        let AnswerReport {
            text,
            found,
            score,
            pixels,
            view,
            ..
        } = &self.report;
        let found = if *found { "found" } else { "not found" };
        format!("Answer('{text}': {found}, confidence {score:.2}, {pixels} pixels in {view})")
    }
}
