//! Cameras.

use crate::Error;
use glam::{Mat4, Vec4};
use numpy::{PyArray2, PyArrayMethods, PyReadonlyArray2};
use pyo3::prelude::*;

/// An undistorted pinhole camera: x right, y down, looking along +z (OpenCV).
#[pyclass(frozen, module = "fastlgs")]
pub struct Camera(pub fastlgs_core::Camera);

/// A matrix of at least three rows of four, as Python has it: by rows.
fn matrix(values: &PyReadonlyArray2<'_, f64>) -> PyResult<Mat4> {
    let view = values.as_array();
    let (rows, columns) = view.dim();
    if columns != 4 || !(3..=4).contains(&rows) {
        return Err(Error::new_err(format!("a pose is a matrix of 3x4 or 4x4 numbers, not of {rows}x{columns}")));
    }
    let row = |r: usize| {
        let last = [0.0, 0.0, 0.0, 1.0];
        Vec4::from_array(std::array::from_fn(|c| if r < rows { view[(r, c)] as f32 } else { last[c] }))
    };
    let matrix = Mat4::from_cols(row(0), row(1), row(2), row(3)).transpose();
    if !matrix.is_finite() || matrix.determinant().abs() < 1e-6 {
        return Err(Error::new_err("the pose has values that are no numbers, or does not turn space into space"));
    }
    Ok(matrix)
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (width, height, fx, fy, world_to_camera, cx = None, cy = None, name = "camera"))]
    fn new(
        width: u32,
        height: u32,
        fx: f32,
        fy: f32,
        world_to_camera: PyReadonlyArray2<'_, f64>,
        cx: Option<f32>,
        cy: Option<f32>,
        name: &str,
    ) -> PyResult<Self> {
        let fits =
            (1..=16384).contains(&width) && (1..=16384).contains(&height) && fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite();
        if !fits {
            return Err(Error::new_err(format!("no camera has {width}x{height} pixels and focal lengths of {fx} and {fy}")));
        }
        let (cx, cy) = (cx.unwrap_or(width as f32 / 2.0), cy.unwrap_or(height as f32 / 2.0));
        let name = name.to_owned();
        let camera = fastlgs_core::Camera { name, width, height, fx, fy, cx, cy, world_to_camera: matrix(&world_to_camera)? };
        camera.check().map_err(Error::new_err)?;
        Ok(Self(camera))
    }

    /// From a pose as nerfstudio and OpenGL have it: camera to world, x right, y up, looking along -z.
    #[staticmethod]
    #[pyo3(signature = (camera_to_world, fx, fy, width, height, cx = None, cy = None, name = "camera"))]
    fn from_nerfstudio(
        camera_to_world: PyReadonlyArray2<'_, f64>,
        fx: f32,
        fy: f32,
        width: u32,
        height: u32,
        cx: Option<f32>,
        cy: Option<f32>,
        name: &str,
    ) -> PyResult<Self> {
        let py = camera_to_world.py();
        let pose = matrix(&camera_to_world)? * Mat4::from_diagonal(Vec4::new(1.0, -1.0, -1.0, 1.0));
        let rows = by_rows(py, pose.inverse())?;
        Self::new(width, height, fx, fy, rows.cast_into::<PyArray2<f64>>()?.readonly(), cx, cy, name)
    }

    /// The view's name: that of its photo.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Width and height in pixels.
    #[getter]
    fn size(&self) -> (u32, u32) {
        (self.0.width, self.0.height)
    }

    /// Focal lengths and principal point in pixels: fx, fy, cx, cy.
    #[getter]
    fn intrinsics(&self) -> (f32, f32, f32, f32) {
        (self.0.fx, self.0.fy, self.0.cx, self.0.cy)
    }

    /// World to camera, (4, 4).
    #[getter]
    fn world_to_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        by_rows(py, self.0.world_to_camera)
    }

    /// The same view at another size; the field of view is kept along each axis.
    fn resized(&self, width: u32, height: u32) -> PyResult<Self> {
        if !(1..=16384).contains(&width) || !(1..=16384).contains(&height) {
            return Err(Error::new_err(format!("no camera has {width}x{height} pixels")));
        }
        Ok(Self(self.0.resized(width, height)))
    }

    fn __repr__(&self) -> String {
        format!("Camera('{}', {}x{})", self.0.name, self.0.width, self.0.height)
    }
}

/// A matrix as Python has it.
fn by_rows<'py>(py: Python<'py>, matrix: Mat4) -> PyResult<Bound<'py, PyAny>> {
    let rows = matrix.transpose().to_cols_array().map(f64::from).to_vec();
    Ok(numpy::PyArray1::from_vec(py, rows).reshape([4, 4])?.into_any())
}
