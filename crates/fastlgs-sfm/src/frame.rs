//! Aligns newly computed poses with the given ones.
//!
//! The result stays in the given world frame, because other data and photos of the scene use it.

use crate::similarity::Similarity;
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use fastlgs_core::stats;
use glam::{Mat4, Quat};
use std::collections::BTreeSet;

/// Number of random samples of three cameras each (RANSAC).
const FRAME_TRIALS: usize = 2000;
/// Largest distance of positions that count as equal, as a share of the cameras' `spread`.
const MAX_POSE_DISTANCE: f32 = 0.02;
/// Largest angle between rotations that count as equal, in radians.
const MAX_ANGLE: f32 = 0.05;
/// Number of times that the frame is fitted again to all cameras that agree with it.
const FITS: usize = 3;
/// Smallest number of cameras that must agree on a frame.
const MIN_AGREEING: usize = 4;

/// Returns the cameras of `given` with the poses `found` for them, and the photos whose pose
/// changed.
///
/// New poses are moved into the given frame by the similarity on which most cameras agree. Cameras
/// without a new pose stay unchanged. Returns `None` if no such similarity exists.
pub fn align(
    given: &[Camera],
    found: &[Option<Mat4>],
    seed: u64,
) -> Option<(Vec<Camera>, BTreeSet<usize>)> {
    let with_pose = |(photo, pose): (usize, &Option<Mat4>)| {
        let mut camera = given[photo].clone();
        camera.world_to_camera = (*pose)?;
        Some((photo, camera))
    };
    let placed: Vec<(usize, Camera)> = found.iter().enumerate().filter_map(with_pose).collect();
    if placed.len() < MIN_AGREEING {
        return None;
    }
    let near = MAX_POSE_DISTANCE * spread(given);
    let moved_by = |frame: &Similarity, camera: &Camera| {
        let mut camera = camera.clone();
        frame.move_camera(&mut camera);
        camera
    };
    let same = |photo: usize, camera: &Camera| {
        let turn = Quat::from_mat4(&camera.world_to_camera)
            .angle_between(Quat::from_mat4(&given[photo].world_to_camera));
        camera.centre().distance(given[photo].centre()) < near && turn < MAX_ANGLE
    };
    let agree = |frame: &Similarity| -> Vec<usize> {
        let agrees = |k: &usize| same(placed[*k].0, &moved_by(frame, &placed[*k].1));
        (0..placed.len()).filter(agrees).collect()
    };
    let between = |some: &[usize]| {
        let pair = |&k: &usize| (placed[k].1.centre(), given[placed[k].0].centre());
        Similarity::between(&some.iter().map(pair).collect::<Vec<_>>())
    };
    let mut rng = Rng::new(seed, "frame");
    let mut best = Vec::new();
    for _ in 0..FRAME_TRIALS {
        let three: [usize; 3] = std::array::from_fn(|_| rng.below(placed.len()));
        let agreeing = between(&three).map(|s| agree(&s)).unwrap_or_default();
        if agreeing.len() > best.len() {
            best = agreeing;
        }
    }
    let mut frame = between(&best)?;
    for _ in 0..FITS {
        best = agree(&frame);
        if best.len() < MIN_AGREEING {
            return None;
        }
        frame = between(&best)?;
    }
    let mut cameras = given.to_vec();
    let mut moved = BTreeSet::new();
    for (photo, camera) in &placed {
        cameras[*photo] = moved_by(&frame, camera);
        if !same(*photo, &cameras[*photo]) {
            moved.insert(*photo);
        }
    }
    Some((cameras, moved))
}

/// Returns the median distance of the cameras from their median position, which is robust to
/// outliers.
fn spread(cameras: &[Camera]) -> f32 {
    let centres = cameras.iter().map(Camera::centre);
    let middle = stats::median_position(centres.clone());
    stats::median(centres.map(|centre| centre.distance(middle))).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat3;
    use glam::Vec3;

    #[test]
    fn align_finds_the_frame_of_the_correct_poses() {
        let eye = |k: usize, angle: f32| {
            let (sin, cos) = (0.3 * k as f32 + angle).sin_cos();
            Camera::look_at(
                &k.to_string(),
                Vec3::new(4.0 * sin, 0.1 * (k % 5) as f32, 4.0 * cos),
                Vec3::ZERO,
                Vec3::Y,
                64,
                48,
                0.9,
            )
        };
        let truth: Vec<Camera> = (0..20).map(|k| eye(k, 0.0)).collect();
        // The last seven given poses lie on a wrong arc that is consistent in itself. One camera is
        // far away, and one is rotated.
        let mut given: Vec<Camera> = (0..20)
            .map(|k| eye(k, if k < 13 { 0.0 } else { 1.0 }))
            .collect();
        given[1].world_to_camera.w_axis.x += 1000.0;
        given[2].world_to_camera = Mat4::from_rotation_z(0.3) * given[2].world_to_camera;
        let other = Similarity {
            scale: 0.4,
            rotation: Mat3::from_rotation_y(2.0) * Mat3::from_rotation_x(0.3),
            translation: Vec3::new(5.0, 1.0, -2.0),
        };
        let elsewhere = |(k, camera): (usize, &Camera)| {
            let mut camera = camera.clone();
            other.move_camera(&mut camera);
            (k != 4).then_some(camera.world_to_camera)
        };
        let found: Vec<Option<Mat4>> = truth.iter().enumerate().map(elsewhere).collect();
        let (cameras, moved) = align(&given, &found, 1).unwrap();
        assert_eq!(moved, [1, 2].into_iter().chain(13..20).collect());
        assert!(
            cameras
                .iter()
                .zip(&truth)
                .all(|(c, t)| c.world_to_camera.abs_diff_eq(t.world_to_camera, 1e-3))
        );
        assert_eq!(
            cameras[4], given[4],
            "a camera without a new pose stays unchanged"
        );
        assert!(align(&given, &vec![None; 20], 1).is_none());
    }
}
