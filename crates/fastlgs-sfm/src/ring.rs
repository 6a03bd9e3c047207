//! Test scene for poses: cameras around a point cloud in which each point has its own descriptor.

use crate::keypoints::Keypoints;
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use glam::{Vec2, Vec3};

/// A point with its descriptor.
pub type Point = (Vec3, [u8; 128]);

/// Returns 300 random points in the cube from -1 to 1.
pub fn cloud(rng: &mut Rng) -> Vec<Point> {
    let mut point = || {
        let p = Vec3::new(
            rng.range(-1.0, 1.0),
            rng.range(-1.0, 1.0),
            rng.range(-1.0, 1.0),
        );
        (p, std::array::from_fn(|_| rng.below(256) as u8))
    };
    (0..300).map(|_| point()).collect()
}

/// Returns cameras on an arc of radius 5 that look at the origin.
pub fn cameras(count: usize) -> Vec<Camera> {
    let eye = |k: usize| 5.0 * Vec3::new((0.15 * k as f32).cos(), 0.2, (0.15 * k as f32).sin());
    (0..count)
        .map(|k| {
            Camera::look_at(
                &format!("{k:03}"),
                eye(k),
                Vec3::ZERO,
                Vec3::Y,
                320,
                240,
                0.8,
            )
        })
        .collect()
}

/// Returns the key points of a camera, each displaced by `error()` pixels.
pub fn key_points(camera: &Camera, cloud: &[Point], mut error: impl FnMut() -> Vec2) -> Keypoints {
    let pixel = |p: &Point| camera.to_pixel(camera.world_to_camera.transform_point3(p.0)) + error();
    Keypoints {
        positions: cloud.iter().map(pixel).collect(),
        descriptors: cloud.iter().map(|p| p.1).collect(),
    }
}
