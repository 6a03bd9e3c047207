//! Pinhole cameras, and the extent and up direction of a set of cameras.

use crate::stats;
use crate::{Error, Result, WorldFrame, fs, world_frame};
use glam::{DMat4, Mat4, Vec2, Vec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// An undistorted pinhole camera; x right, y down, looking along +z (OpenCV).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Name of the view: the photo's file name.
    pub name: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Focal length in pixels along x.
    pub fx: f32,
    /// Focal length in pixels along y.
    pub fy: f32,
    /// Principal point in pixels, x.
    pub cx: f32,
    /// Principal point in pixels, y.
    pub cy: f32,
    /// World-to-camera matrix in scene coordinates, column-major as in glam.
    pub world_to_camera: Mat4,
}

impl Camera {
    /// Returns the same view at another resolution. The field of view stays the same along each
    /// axis.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (
            width as f32 / self.width as f32,
            height as f32 / self.height as f32,
        );
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            ..self.clone()
        }
    }

    /// Returns the same view at half resolution. Odd sizes are rounded up, so the last column or
    /// row extends half a pixel beyond the image.
    pub fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        Self {
            width,
            height,
            fx: self.fx / 2.0,
            fy: self.fy / 2.0,
            cx: self.cx / 2.0,
            cy: self.cy / 2.0,
            ..self.clone()
        }
    }

    /// Returns the same view with its longer side at most `max_side` pixels. Never enlarges.
    pub fn shrunk_to(&self, max_side: u32) -> Self {
        let scale = max_side as f32 / self.width.max(self.height) as f32;
        if scale >= 1.0 {
            return self.clone();
        }
        let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
        self.resized(size(self.width), size(self.height))
    }

    /// Returns the position of the camera in scene coordinates.
    pub fn centre(&self) -> Vec3 {
        self.world_to_camera.inverse().w_axis.truncate()
    }

    /// Returns the unit viewing direction in scene coordinates.
    pub fn forward(&self) -> Vec3 {
        self.world_to_camera
            .transpose()
            .z_axis
            .truncate()
            .normalize()
    }

    /// Projects a point of camera space into the image. The result is in pixels.
    pub fn to_pixel(&self, p: Vec3) -> Vec2 {
        Vec2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy)
    }

    /// Projects a point in scene coordinates. Returns its row-major pixel index and depth, or
    /// `None` behind the camera or outside the image.
    pub fn pixel_and_depth(&self, point: Vec3) -> Option<(usize, f32)> {
        let q = self.world_to_camera.transform_point3(point);
        let pixel = self.to_pixel(q);
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < self.width as f32
            && pixel.y < self.height as f32;
        (q.z > 0.0 && inside).then(|| {
            (
                pixel.y as usize * self.width as usize + pixel.x as usize,
                q.z,
            )
        })
    }

    /// Returns the direction of a pixel's ray in camera space, with z = 1.
    pub fn ray(&self, pixel: Vec2) -> Vec3 {
        Vec3::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
            1.0,
        )
    }

    /// Returns the centre of a pixel, given by its row-major index.
    pub fn pixel_centre(&self, pixel: usize) -> Vec2 {
        let width = self.width as usize;
        Vec2::new((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5)
    }

    /// Returns the scene coordinates of the point at a depth along the ray through a pixel's
    /// centre. `pixel` is its row-major index.
    pub fn point_at(&self, pixel: usize, depth: f32) -> Vec3 {
        let place = self.ray(self.pixel_centre(pixel)) * depth;
        self.world_to_camera.inverse().transform_point3(place)
    }

    /// Creates a camera at `eye` that looks at `target`, with `up` towards the top of the image.
    /// `fov_y` is the vertical field of view in radians.
    pub fn look_at(
        name: &str,
        eye: Vec3,
        target: Vec3,
        up: Vec3,
        width: u32,
        height: u32,
        fov_y: f32,
    ) -> Self {
        let z = (target - eye).normalize();
        let x = z.cross(up).normalize();
        let y = z.cross(x);
        let camera_to_world =
            Mat4::from_cols(x.extend(0.0), y.extend(0.0), z.extend(0.0), eye.extend(1.0));
        let f = height as f32 / (2.0 * (fov_y / 2.0).tan());
        Self {
            name: name.to_owned(),
            width,
            height,
            fx: f,
            fy: f,
            cx: width as f32 / 2.0,
            cy: height as f32 / 2.0,
            world_to_camera: camera_to_world.inverse(),
        }
    }

    /// Checks that the size and focal lengths are positive, all numbers are finite, and the pose
    /// has determinant 1 within 0.05.
    ///
    /// # Errors
    /// A sentence that names the view and what is wrong.
    pub fn check(&self) -> Result<(), String> {
        let name = &self.name;
        if self.width == 0 || self.height == 0 {
            return Err(format!(
                "camera '{name}' has size {}x{}; both sides must be at least 1",
                self.width, self.height
            ));
        }
        if ![self.fx, self.fy].iter().all(|f| f.is_finite() && *f > 0.0)
            || !(self.cx + self.cy).is_finite()
        {
            return Err(format!(
                "camera '{name}' needs positive focal lengths and a finite principal point"
            ));
        }
        if !self.world_to_camera.is_finite() {
            return Err(format!(
                "the pose of '{name}' has a NaN or infinite entry; remove or correct that pose"
            ));
        }
        let determinant = self.world_to_camera.determinant();
        if (determinant - 1.0).abs() > 0.05 {
            return Err(format!(
                "the pose of '{name}' is not a rotation and a translation (determinant {determinant:.3})"
            ));
        }
        Ok(())
    }

    /// Reads a camera from a JSON file with the fields of this struct. Its pose is in world
    /// coordinates and is converted to `frame`.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Format`], also for values that `check` rejects.
    pub fn load(path: &Path, frame: &WorldFrame) -> Result<Self> {
        /// The pose in double precision.
        #[derive(Deserialize)]
        struct Pose {
            world_to_camera: DMat4,
        }
        let mut camera: Self = fs::read_json(path)?;
        if !frame.is_identity() {
            let pose: Pose = fs::read_json(path)?;
            camera.world_to_camera =
                frame.local_pose(&world_frame::Pose::WorldToCamera(pose.world_to_camera));
        }
        camera
            .check()
            .map_err(|reason| Error::format(path, reason))?;
        Ok(camera)
    }
}

/// Distance from the median camera position beyond which a pose counts as an outlier, in multiples
/// of the median distance.
const OUTLIER_CAMERA_DISTANCE: f32 = 10.0;

/// Marks the cameras that lie far outside the others; their poses are most often wrong. Uses
/// medians, so that outliers do not shift the reference.
pub fn outlier_cameras(cameras: &[Camera]) -> Vec<bool> {
    let centres = cameras.iter().map(Camera::centre);
    let middle = stats::median_position(centres.clone());
    let distances: Vec<f32> = centres.map(|c| c.distance(middle)).collect();
    let median_distance = stats::median(distances.iter().copied()).unwrap_or(0.0);
    // If most cameras share one position, the median distance is 0 and gives no scale.
    distances
        .iter()
        .map(|distance| {
            median_distance > 0.0 && *distance > OUTLIER_CAMERA_DISTANCE * median_distance
        })
        .collect()
}

/// Returns the "scene extent" of 3DGS, which scales learning rates: 1.1 times the largest distance
/// of a camera from the mean position, at least 0.001. Outlier cameras do not count.
pub fn scene_extent(cameras: &[Camera]) -> f32 {
    let outside = outlier_cameras(cameras);
    let centres: Vec<Vec3> = cameras
        .iter()
        .zip(outside)
        .filter(|(_, outside)| !outside)
        .map(|(c, _)| c.centre())
        .collect();
    let mean = centres.iter().sum::<Vec3>() / centres.len().max(1) as f32;
    let radius = centres.iter().map(|c| c.distance(mean)).fold(0.0, f32::max);
    (radius * 1.1).max(1e-3)
}

/// Estimates the up direction of the scene as a unit vector: the mean up direction of the cameras.
pub fn mean_up(cameras: &[Camera]) -> Vec3 {
    let up = |c: &Camera| -c.world_to_camera.transpose().y_axis.truncate();
    cameras
        .iter()
        .map(up)
        .sum::<Vec3>()
        .try_normalize()
        .unwrap_or(Vec3::NEG_Y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_puts_the_target_in_the_middle() {
        let camera = Camera::look_at(
            "a",
            Vec3::new(1.0, 2.0, 3.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let p = camera.world_to_camera.transform_point3(Vec3::ZERO);
        assert!((camera.to_pixel(p) - Vec2::new(32.0, 24.0)).length() < 1e-3);
        let above = camera.world_to_camera.transform_point3(Vec3::Y * 0.1);
        assert!(camera.to_pixel(above).y < 24.0, "world up must be image up");
        assert!((camera.centre() - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-4);
        assert!(camera.check().is_ok());
    }

    #[test]
    fn points_behind_or_outside_the_image_have_no_pixel() {
        let camera = Camera::look_at("a", -4.0 * Vec3::Z, Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let at = |x: f32, y: f32, depth: f32| {
            camera
                .world_to_camera
                .inverse()
                .transform_point3(camera.ray(Vec2::new(x, y)) * depth)
        };
        let (pixel, depth) = camera.pixel_and_depth(at(3.5, 7.5, 2.0)).unwrap();
        assert!(pixel == 7 * 64 + 3 && (depth - 2.0).abs() < 1e-5);
        for (x, y, depth) in [
            (-0.1, 5.0, 2.0),
            (5.0, -0.1, 2.0),
            (64.1, 5.0, 2.0),
            (5.0, 48.1, 2.0),
            (5.0, 5.0, -2.0),
        ] {
            assert_eq!(camera.pixel_and_depth(at(x, y, depth)), None);
        }
    }

    #[test]
    fn a_camera_far_outside_does_not_set_the_scale() {
        let at = |eye: Vec3| Camera::look_at("a", eye, Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let ring = (0..12).map(|k| at(Vec3::new((k as f32).cos(), 0.2, (k as f32).sin()) * 3.0));
        let mut cameras: Vec<Camera> = ring.collect();
        let extent = scene_extent(&cameras);
        cameras.push(at(Vec3::splat(1e4)));
        assert_eq!(
            (
                scene_extent(&cameras),
                outlier_cameras(&cameras).iter().filter(|o| **o).count()
            ),
            (extent, 1)
        );
        // A moderate distance is not an outlier.
        cameras.pop();
        cameras.push(at(Vec3::splat(6.0)));
        assert!(scene_extent(&cameras) > extent && !outlier_cameras(&cameras).contains(&true));
    }

    #[test]
    fn check_names_the_view_with_a_bad_pose() {
        let mut camera = Camera::look_at("view7", Vec3::ONE, Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        camera.world_to_camera.x_axis.x = f32::NAN;
        assert!(camera.check().unwrap_err().contains("view7"));
    }
}
