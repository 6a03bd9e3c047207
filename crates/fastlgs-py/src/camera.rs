//! The Python class `Camera`.

use crate::Error;
use fastlgs_core::WorldFrame;
use fastlgs_core::world_frame::Pose;
use glam::{DMat4, DVec4};
use numpy::{PyArrayMethods, PyReadonlyArray2};
use pyo3::prelude::*;

/// An undistorted pinhole camera: x right, y down, looking along +z (OpenCV).
#[pyclass(frozen, module = "fastlgs")]
#[derive(Clone)]
pub struct Camera {
    /// The camera; its pose is `pose` in single precision.
    camera: fastlgs_core::Camera,
    /// World-to-camera matrix, in world coordinates.
    pose: DMat4,
}

impl Camera {
    /// Converts a camera of a scene to world coordinates.
    pub fn from_scene(camera: fastlgs_core::Camera, frame: &WorldFrame) -> Self {
        let pose = match frame.is_identity() {
            true => camera.world_to_camera.as_dmat4(),
            false => frame.world_pose(&camera.world_to_camera).inverse(),
        };
        Self { camera, pose }
    }

    /// Converts the camera to the coordinates of a scene.
    pub fn to_scene(&self, frame: &WorldFrame) -> fastlgs_core::Camera {
        fastlgs_core::Camera {
            world_to_camera: frame.local_pose(&Pose::WorldToCamera(self.pose)),
            ..self.camera.clone()
        }
    }
}

/// Reads a pose from a NumPy array or nested lists of numbers, (3, 4) or (4, 4).
///
/// # Errors
/// Another shape, values that are not finite, or a singular matrix.
fn matrix(values: &Bound<'_, PyAny>) -> PyResult<DMat4> {
    let numpy = values.py().import("numpy")?;
    let array = numpy
        .call_method1("asarray", (values, "float64"))
        .map_err(|_| Error::new_err("a pose must be a matrix of numbers"))?;
    let array: PyReadonlyArray2<'_, f64> = array
        .extract()
        .map_err(|_| Error::new_err("a pose must be a matrix of 3x4 or 4x4 numbers"))?;
    let view = array.as_array();
    let (rows, columns) = view.dim();
    if columns != 4 || !(3..=4).contains(&rows) {
        return Err(Error::new_err(format!(
            "a pose must be a matrix of 3x4 or 4x4 numbers, not {rows}x{columns}"
        )));
    }
    let row = |r: usize| {
        DVec4::from_array(std::array::from_fn(|c| {
            if r < rows { view[(r, c)] } else { DVec4::W[c] }
        }))
    };
    let matrix = DMat4::from_cols(row(0), row(1), row(2), row(3)).transpose();
    if !matrix.is_finite() || matrix.determinant().abs() < 1e-6 {
        return Err(Error::new_err(
            "the pose has values that are not finite, or is singular",
        ));
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
        world_to_camera: &Bound<'_, PyAny>,
        cx: Option<f32>,
        cy: Option<f32>,
        name: &str,
    ) -> PyResult<Self> {
        let is_valid = (1..=16384).contains(&width)
            && (1..=16384).contains(&height)
            && fx > 0.0
            && fy > 0.0
            && fx.is_finite()
            && fy.is_finite();
        if !is_valid {
            return Err(Error::new_err(format!(
                "a camera cannot have {width}x{height} pixels and focal lengths {fx} and {fy}; sides must be 1 to 16384 pixels, focal lengths positive"
            )));
        }
        let (cx, cy) = (
            cx.unwrap_or(width as f32 / 2.0),
            cy.unwrap_or(height as f32 / 2.0),
        );
        let name = name.to_owned();
        let pose = matrix(world_to_camera)?;
        let camera = fastlgs_core::Camera {
            name,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            world_to_camera: pose.as_mat4(),
        };
        camera.check().map_err(Error::new_err)?;
        Ok(Self { camera, pose })
    }

    /// Creates a camera from a pose of nerfstudio or OpenGL: camera to world, x right, y up,
    /// looking along -z.
    #[staticmethod]
    #[pyo3(signature = (camera_to_world, fx, fy, width, height, cx = None, cy = None, name = "camera"))]
    fn from_nerfstudio(
        camera_to_world: &Bound<'_, PyAny>,
        fx: f32,
        fy: f32,
        width: u32,
        height: u32,
        cx: Option<f32>,
        cy: Option<f32>,
        name: &str,
    ) -> PyResult<Self> {
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let rows = to_numpy(
            camera_to_world.py(),
            (matrix(camera_to_world)? * flip).inverse(),
        )?;
        Self::new(width, height, fx, fy, &rows, cx, cy, name)
    }

    /// Name of the view, which is that of its photo.
    #[getter]
    fn name(&self) -> &str {
        &self.camera.name
    }

    /// Width and height in pixels.
    #[getter]
    fn size(&self) -> (u32, u32) {
        (self.camera.width, self.camera.height)
    }

    /// Focal lengths and principal point in pixels: fx, fy, cx, cy.
    #[getter]
    fn intrinsics(&self) -> (f32, f32, f32, f32) {
        (
            self.camera.fx,
            self.camera.fy,
            self.camera.cx,
            self.camera.cy,
        )
    }

    /// World-to-camera matrix, (4, 4).
    #[getter]
    fn world_to_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_numpy(py, self.pose)
    }

    /// Returns the same view at another size. The field of view stays the same along each axis.
    fn resized(&self, width: u32, height: u32) -> PyResult<Self> {
        if !(1..=16384).contains(&width) || !(1..=16384).contains(&height) {
            return Err(Error::new_err(format!(
                "a camera cannot have {width}x{height} pixels; sides must be 1 to 16384 pixels"
            )));
        }
        Ok(Self {
            camera: self.camera.resized(width, height),
            pose: self.pose,
        })
    }

    fn __repr__(&self) -> String {
        format!(
            "Camera('{}', {}x{})",
            self.camera.name, self.camera.width, self.camera.height
        )
    }
}

/// Converts a matrix to a NumPy array, (4, 4).
fn to_numpy<'py>(py: Python<'py>, matrix: DMat4) -> PyResult<Bound<'py, PyAny>> {
    let rows = matrix.transpose().to_cols_array().to_vec();
    Ok(numpy::PyArray1::from_vec(py, rows)
        .reshape([4, 4])?
        .into_any())
}
