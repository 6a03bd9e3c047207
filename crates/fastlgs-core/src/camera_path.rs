//! Camera paths in the format of nerfstudio's viewer (`camera_path.json`, also called
//! `cameras.json`).
//!
//! Its cameras have x right and y up, and look along -z (OpenGL). `camera_to_world` has 16 numbers
//! in row-major order; `fov` is vertical, in degrees. The format has no principal point: it is
//! written as the image centre.

use crate::world_frame::{Pose, shortest_decimal};
use crate::{Camera, Error, Result, WorldFrame, fs};
use glam::{DMat4, Mat4, Vec4};
use serde::{Deserialize, Serialize};
use std::path::Path;

#[derive(Serialize, Deserialize)]
struct Frame {
    camera_to_world: Vec<f64>,
    fov: f32,
    #[serde(default)]
    aspect: Option<f32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    name: Option<String>,
}

#[derive(Serialize, Deserialize)]
struct CameraPath {
    #[serde(default = "perspective")]
    camera_type: String,
    render_height: u32,
    render_width: u32,
    #[serde(default)]
    fps: Option<f32>,
    #[serde(default)]
    seconds: Option<f32>,
    camera_path: Vec<Frame>,
}

fn perspective() -> String {
    "perspective".into()
}

/// Converts between the camera axes of OpenCV and OpenGL. It is its own inverse.
const OPENCV_TO_OPENGL: Mat4 = Mat4::from_cols(
    Vec4::X,
    Vec4::new(0.0, -1.0, 0.0, 0.0),
    Vec4::new(0.0, 0.0, -1.0, 0.0),
    Vec4::W,
);

/// Frame rate of written paths, in frames per second.
const FPS: f32 = 24.0;

/// Writes cameras as a path in world coordinates, with the image size of the first camera.
///
/// # Errors
/// [`Error::Invalid`] without cameras, [`Error::Io`] with the path.
pub fn write(path: &Path, cameras: &[Camera], frame: &WorldFrame) -> Result<()> {
    let first = cameras.first().ok_or_else(|| {
        Error::Invalid(format!(
            "{}: cannot write a camera path without cameras",
            path.display()
        ))
    })?;
    let pose = |camera: &Camera| match frame.is_identity() {
        true => (camera.world_to_camera.inverse() * OPENCV_TO_OPENGL)
            .transpose()
            .to_cols_array()
            .map(shortest_decimal)
            .to_vec(),
        false => (frame.world_pose(&camera.world_to_camera) * OPENCV_TO_OPENGL.as_dmat4())
            .transpose()
            .to_cols_array()
            .to_vec(),
    };
    let path_frame = |camera: &Camera| Frame {
        camera_to_world: pose(camera),
        fov: (2.0 * (camera.height as f32 / 2.0 / camera.fy).atan()).to_degrees(),
        aspect: Some(camera.width as f32 / camera.height as f32),
        name: Some(camera.name.clone()),
    };
    let own = CameraPath {
        camera_type: perspective(),
        render_height: first.height,
        render_width: first.width,
        fps: Some(FPS),
        seconds: Some(cameras.len() as f32 / FPS),
        camera_path: cameras.iter().map(path_frame).collect(),
    };
    fs::write_json(path, &own)
}

/// Reads a path and converts its poses to the frame `world`. All cameras have the path's image
/// size. Frames without a name are called `frame_00000` and so on.
///
/// # Errors
/// Missing or damaged files, cameras that are not perspective, or poses that are not a rotation and
/// a translation.
pub fn read(path: &Path, world: &WorldFrame) -> Result<Vec<Camera>> {
    let own: CameraPath = fs::read_json(path)?;
    if own.camera_type != "perspective" {
        return Err(Error::format(
            path,
            format!(
                "camera_type is '{}'; only 'perspective' can be rendered",
                own.camera_type
            ),
        ));
    }
    let (width, height) = (own.render_width, own.render_height);
    let camera = |(k, frame): (usize, &Frame)| -> Result<Camera> {
        let numbers = <[f64; 16]>::try_from(frame.camera_to_world.as_slice()).map_err(|_| {
            Error::format(
                path,
                format!(
                    "frame {k} has {} numbers in camera_to_world, not 16",
                    frame.camera_to_world.len()
                ),
            )
        })?;
        let focal = height as f32 / 2.0 / (frame.fov.to_radians() / 2.0).tan();
        let camera = Camera {
            name: frame
                .name
                .clone()
                .unwrap_or_else(|| format!("frame_{k:05}")),
            width,
            height,
            fx: focal,
            fy: focal,
            cx: width as f32 / 2.0,
            cy: height as f32 / 2.0,
            world_to_camera: world.local_pose(&Pose::CameraToWorld(
                DMat4::from_cols_array(&numbers).transpose() * OPENCV_TO_OPENGL.as_dmat4(),
            )),
        };
        camera
            .check()
            .map_err(|reason| Error::format(path, reason))?;
        Ok(camera)
    };
    let cameras = own
        .camera_path
        .iter()
        .enumerate()
        .map(camera)
        .collect::<Result<Vec<_>>>()?;
    if cameras.is_empty() {
        return Err(Error::format(path, "the path has no frames"));
    }
    Ok(cameras)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn cameras_round_trip_with_the_axes_of_nerfstudio() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cameras.json");
        let camera = |k: f32| {
            Camera::look_at(
                &format!("{k}.png"),
                Vec3::new(k, 2.0, 3.0),
                Vec3::ZERO,
                Vec3::Y,
                64,
                48,
                0.8,
            )
        };
        let cameras = [camera(1.0), camera(2.0)];
        write(&path, &cameras, &WorldFrame::default()).unwrap();
        for (a, b) in cameras
            .iter()
            .zip(read(&path, &WorldFrame::default()).unwrap())
        {
            assert_eq!((&a.name, a.width, a.height), (&b.name, b.width, b.height));
            assert!(
                (a.fy - b.fy).abs() < 1e-3
                    && a.world_to_camera.abs_diff_eq(b.world_to_camera, 1e-5)
            );
        }
        let file: serde_json::Value = fs::read_json(&path).unwrap();
        let row = |r: usize, c: usize| {
            file["camera_path"][0]["camera_to_world"][4 * r + c]
                .as_f64()
                .unwrap() as f32
        };
        // The last column is the position. The third column points away from the target.
        assert!(
            (Vec3::new(row(0, 3), row(1, 3), row(2, 3)) - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-5
        );
        assert!(
            (Vec3::new(row(0, 2), row(1, 2), row(2, 2)) - Vec3::new(1.0, 2.0, 3.0).normalize())
                .length()
                < 1e-5
        );
        assert!(row(1, 1) > 0.0, "y is up");

        std::fs::write(&path, r#"{"render_height":4,"render_width":4,"camera_path":[{"camera_to_world":[1,2],"fov":50}]}"#).unwrap();
        assert!(
            read(&path, &WorldFrame::default())
                .unwrap_err()
                .to_string()
                .contains("frame 0 has 2 numbers")
        );
        assert!(write(&path, &[], &WorldFrame::default()).is_err());
    }
}
