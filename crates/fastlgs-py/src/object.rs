//! The Python classes `Object` and `FoundObject`.

use fastlgs::query::answer::ObjectReport;
use fastlgs_grid::grid;
use pyo3::prelude::*;

/// An object or part of a scene.
#[pyclass(frozen, get_all, module = "fastlgs")]
pub struct Object {
    id: u16,
    parent: u16,
    support: f32,
    views: usize,
    area: f32,
    code: (f32, f32, f32),
}

impl From<&grid::Object> for Object {
    fn from(object: &grid::Object) -> Self {
        Self {
            id: object.id,
            parent: object.parent,
            support: object.support,
            views: object.views,
            area: object.areas.iter().copied().fold(0.0, f32::max),
            code: object.code.into(),
        }
    }
}

#[pymethods]
impl Object {
    fn __repr__(&self) -> String {
        let Self {
            id, support, views, ..
        } = self;
        format!("Object(id={id}, support={support:.2}, views={views})")
    }
}

/// An object of an answer.
#[pyclass(frozen, get_all, module = "fastlgs")]
pub struct FoundObject {
    id: u16,
    parent: u16,
    support: f32,
    score: f32,
    bbox2d: Option<(u32, u32, u32, u32)>,
    bbox3d: Option<([f64; 3], [f64; 3])>,
    pixels: usize,
    gaussians: usize,
}

impl From<&ObjectReport> for FoundObject {
    fn from(object: &ObjectReport) -> Self {
        Self {
            id: object.id,
            parent: object.parent,
            support: object.support,
            score: object.score,
            bbox2d: object.bbox2d.map(Into::into),
            bbox3d: object.bbox3d.map(Into::into),
            pixels: object.pixels,
            gaussians: object.gaussians,
        }
    }
}

#[pymethods]
impl FoundObject {
    fn __repr__(&self) -> String {
        let Self {
            id, score, pixels, ..
        } = self;
        format!("FoundObject(id={id}, score={score:.2}, pixels={pixels})")
    }
}
