//! Tests of pose refinement: displaced cameras return to their true poses.

use super::{camera, cloud};
use crate::align::{self, STEPS, align};
use crate::density::State;
use crate::{Channels, CpuEngine, Engine, Exposure, Target, TargetImage, View, pack};
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use glam::{Mat4, Quat, Vec3};

/// Returns the camera, rotated and shifted at random by about `pixels`.
fn displaced(camera: &Camera, pixels: f32, rng: &mut Rng) -> Camera {
    let mut random = |size: f32| size * Vec3::new(rng.normal(), rng.normal(), rng.normal());
    let turn = Quat::from_scaled_axis(random(pixels / camera.fx));
    let shift = random(pixels / camera.fx * 4.0);
    Camera {
        world_to_camera: Mat4::from_rotation_translation(turn, shift) * camera.world_to_camera,
        ..camera.clone()
    }
}

/// Returns the mean pixel distance between the projections of eight points by two cameras.
fn pixel_distance(a: &Camera, b: &Camera) -> f32 {
    let points: Vec<Vec3> = (0..8)
        .map(|k| Vec3::new((k & 1) as f32, (k >> 1 & 1) as f32, (k >> 2) as f32) - 0.5)
        .collect();
    let see = |c: &Camera, p: &Vec3| c.to_pixel(c.world_to_camera.transform_point3(*p));
    points
        .iter()
        .map(|p| see(a, p).distance(see(b, p)))
        .sum::<f32>()
        / 8.0
}

#[test]
fn align_restores_a_displaced_camera() {
    let scene = cloud(3000, 3, 1, false);
    let mut engine = CpuEngine::new();
    engine.set_state(&State::of(&scene)).unwrap();
    let truth = camera(203, 151);
    let frame = |camera: &Camera| View::new(camera, scene.len(), 1);
    let rendered = engine.render(frame(&truth), Channels::Color).unwrap();
    let exposure = Exposure {
        gain: [0.8, 0.9, 1.0],
        offset: [0.05, 0.0, 0.0],
    };
    let byte = |c: usize, p: usize| {
        ((exposure.gain[c] * rendered.channels(c, c + 1)[p] + exposure.offset[c]).clamp(0.0, 1.0)
            * 255.0) as u8
    };
    // A tenth of the photo shows something that the scene does not contain.
    let pixel = |p: usize| {
        if p % 203 < 20 {
            pack([250, 0, 250], true)
        } else {
            pack([byte(0, p), byte(1, p), byte(2, p)], true)
        }
    };
    let image = TargetImage {
        size: [203, 151],
        color: (0..203 * 151).map(pixel).collect(),
        feature: Vec::new(),
        depth: Vec::new(),
    };
    let mut rng = Rng::new(1, "poses");
    for _ in 0..3 {
        let target = Target {
            camera: displaced(&truth, 0.7, &mut rng),
            image: image.clone(),
            gain: [1.0; 3],
        };
        let found = align(&mut engine, frame, &target, &exposure, STEPS).unwrap();
        let [before, after] = [
            pixel_distance(&target.camera, &truth),
            pixel_distance(&found, &truth),
        ];
        assert!(after < 0.1 * before, "{before} px before, {after} px after");
    }
}

#[test]
fn a_common_motion_of_all_cameras_is_undone() {
    let mut rng = Rng::new(2, "poses");
    let eye = |k: usize| 4.0 * Vec3::new((0.3 * k as f32).sin(), 0.1, -(0.3 * k as f32).cos());
    let before: Vec<Camera> = (0..12)
        .map(|k| Camera::look_at("a", eye(k), Vec3::ZERO, Vec3::Y, 64, 48, 0.9))
        .collect();
    // All cameras move together, and each one by a small random amount.
    let common_motion =
        Mat4::from_rotation_translation(Quat::from_rotation_y(0.02), Vec3::new(0.1, -0.05, 0.02));
    let shifted = |c: &Camera| Camera {
        world_to_camera: c.world_to_camera * common_motion,
        ..c.clone()
    };
    let mut after: Vec<Camera> = before
        .iter()
        .map(|c| displaced(&shifted(c), 0.2, &mut rng))
        .collect();
    align::restore_mean_pose(&before, &mut after);
    let mean = before
        .iter()
        .zip(&after)
        .map(|(b, a)| pixel_distance(b, a))
        .sum::<f32>()
        / 12.0;
    assert!(mean < 0.6, "{mean} px");
}
