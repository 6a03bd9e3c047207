//! Camera paths of generated scenes.

use fastlgs_core::Camera;
use glam::{Mat3, Vec3};
use std::f32::consts::TAU;

/// Cameras on a circle whose height varies as a sine wave. All look at one point.
pub struct Ring {
    /// Radius of the circle in metres.
    pub radius: f32,
    /// Mean height of the cameras in metres.
    pub height: f32,
    /// Amplitude of the height in metres; the wave has three periods per turn.
    pub wave: f32,
    /// Point that all cameras look at.
    pub target: Vec3,
    /// Vertical field of view in radians.
    pub fov: f32,
}

impl Ring {
    pub fn cameras(&self, count: usize, (width, height): (u32, u32)) -> Vec<Camera> {
        let at = |k: usize| {
            let angle = TAU * k as f32 / count as f32;
            let eye = Vec3::new(
                self.radius * angle.cos(),
                self.height + self.wave * (3.0 * angle).sin(),
                self.radius * angle.sin(),
            );
            Camera::look_at(
                &format!("{k:03}.png"),
                eye,
                self.target,
                Vec3::Y,
                width,
                height,
                self.fov,
            )
        };
        (0..count).map(at).collect()
    }
}

/// Half extents of the corridor's outer walls (`CORRIDOR`) and of the block inside it (`CORE`).
pub const CORRIDOR: Vec3 = Vec3::new(6.5, 1.5, 6.5);
pub const CORE: Vec3 = Vec3::new(3.5, 1.5, 3.5);

/// Returns a point at floor level on the square path in the middle of the corridor. `along` is the
/// fraction of one round, 0 to 1; other values wrap around.
pub fn corridor_path(along: f32) -> Vec3 {
    let side = 4.0 * along.rem_euclid(1.0);
    let r = 0.5 * (CORRIDOR.x + CORE.x);
    let t = 2.0 * side.fract() - 1.0;
    // Corners of the square are cut off.
    let cut = |v: f32| v.clamp(-0.8, 0.8);
    let p = match side as u32 {
        0 => Vec3::new(1.0, 0.0, cut(t)),
        1 => Vec3::new(cut(-t), 0.0, 1.0),
        2 => Vec3::new(-1.0, 0.0, cut(-t)),
        _ => Vec3::new(cut(t), 0.0, -1.0),
    };
    p * r
}

/// Returns `count` cameras on one walk around the corridor. They look ahead and swing to both
/// sides.
pub fn walk(count: usize, (width, height): (u32, u32)) -> Vec<Camera> {
    let at = |k: usize| {
        let along = k as f32 / count as f32;
        // A moving average of the path, which rounds the corners.
        let smooth = |from: f32| {
            (0..9)
                .map(|s| corridor_path(from + (s as f32 - 4.0) * 0.008))
                .sum::<Vec3>()
                / 9.0
        };
        let (eye, ahead) = (
            smooth(along) + Vec3::Y * 1.25,
            smooth(along + 0.05) + Vec3::Y * 0.75,
        );
        let sway = Mat3::from_rotation_y(0.55 * (TAU * k as f32 / 17.0).sin());
        Camera::look_at(
            &format!("{k:03}.png"),
            eye,
            eye + sway * (ahead - eye),
            Vec3::Y,
            width,
            height,
            0.95,
        )
    };
    (0..count).map(at).collect()
}

/// Returns `count` cameras of a person who turns twice around while moving once along a small
/// ellipse in the middle of a room, so that neighbouring views have little parallax.
pub fn turns(count: usize, (width, height): (u32, u32)) -> Vec<Camera> {
    let at = |k: usize| {
        let angle = TAU * k as f32 / count as f32;
        let (s, c) = angle.sin_cos();
        let eye = Vec3::new(0.9 * c, 1.45 + 0.1 * (3.0 * angle).sin(), 0.6 * s);
        let (s, c) = (2.0 * angle).sin_cos();
        let ahead = Vec3::new(c, -0.2, s);
        Camera::look_at(
            &format!("{k:03}.png"),
            eye,
            eye + ahead,
            Vec3::Y,
            width,
            height,
            1.1,
        )
    };
    (0..count).map(at).collect()
}
