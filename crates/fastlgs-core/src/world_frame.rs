//! The frame of a scene: origin and scale of its coordinates in the world of the input poses.
//!
//! Scenes are stored and trained in 32-bit floats. Poses far from the origin (such as UTM) or in
//! very small or large units would lose digits. Such scenes get their own frame:
//! `world = origin + scale * local`.

use glam::{DMat4, DVec3, Mat4, Vec3};
use serde::{Deserialize, Serialize};

/// Origin and scale of scene coordinates in the world; the identity for most scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct WorldFrame {
    /// Origin of the scene in world coordinates.
    pub origin: DVec3,
    /// World units per scene unit, a power of two.
    pub scale: f64,
}

impl Default for WorldFrame {
    fn default() -> Self {
        Self {
            origin: DVec3::ZERO,
            scale: 1.0,
        }
    }
}

/// A pose in OpenCV axes (x right, y down, z forward), in the direction that its file states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pose {
    /// World-to-camera matrix.
    WorldToCamera(DMat4),
    /// Camera-to-world matrix.
    CameraToWorld(DMat4),
}

impl Pose {
    /// Returns the position of the camera in the world.
    pub fn centre(&self) -> DVec3 {
        match self {
            Self::WorldToCamera(pose) => pose.inverse().w_axis.truncate(),
            Self::CameraToWorld(pose) => pose.w_axis.truncate(),
        }
    }
}

/// Distance of the median camera from the world's origin, in multiples of the cameras' spread,
/// beyond which the scene gets its own origin. There, 32-bit floats keep fewer than five digits of
/// the spread. At the world's scale, the distance must also exceed 100 world units.
const MAX_ORIGIN_DISTANCE: f64 = 100.0;
/// Spreads of cameras, in world units, for which a scene keeps the scale of the world.
const USUAL_SPREAD: std::ops::Range<f64> = 0.1..100.0;

impl WorldFrame {
    /// Chooses a frame for camera positions in the world. It is the identity unless they are far
    /// from the origin or in very small or large units. It uses medians, so that a few wrong poses
    /// have no effect.
    pub fn for_cameras(centres: &[DVec3]) -> Self {
        let middle =
            DVec3::from_array([0, 1, 2].map(|k| median(centres.iter().map(|c| c[k]).collect())));
        let spread = median(centres.iter().map(|c| c.distance(middle)).collect());
        let is_far =
            middle.length() > MAX_ORIGIN_DISTANCE * spread && middle.length() > MAX_ORIGIN_DISTANCE;
        let scale = if spread > 0.0 && !USUAL_SPREAD.contains(&spread) {
            spread.log2().floor().exp2()
        } else {
            1.0
        };
        Self {
            origin: if is_far || (scale != 1.0 && middle.length() > MAX_ORIGIN_DISTANCE * spread) {
                middle
            } else {
                DVec3::ZERO
            },
            scale,
        }
    }

    /// Returns whether this frame keeps enough digits for camera positions in the world.
    pub fn keeps_precision(&self, centres: &[DVec3]) -> bool {
        let local: Vec<DVec3> = centres
            .iter()
            .map(|centre| (*centre - self.origin) / self.scale)
            .collect();
        Self::for_cameras(&local).is_identity()
    }

    /// Returns whether scene coordinates are world coordinates.
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// Converts a point from scene to world coordinates.
    pub fn to_world(&self, local: Vec3) -> DVec3 {
        self.origin + self.scale * local.as_dvec3()
    }

    /// Converts a point to world coordinates for reports, with as few digits as possible.
    pub fn to_world_decimal(&self, local: [f32; 3]) -> [f64; 3] {
        if self.is_identity() {
            local.map(shortest_decimal)
        } else {
            self.to_world(local.into()).to_array()
        }
    }

    /// Converts a point from world to scene coordinates.
    pub fn to_local(&self, world: DVec3) -> Vec3 {
        ((world - self.origin) / self.scale).as_vec3()
    }

    /// Converts a pose to a world-to-camera matrix in scene coordinates. Camera-to-world matrices
    /// are rounded to 32 bits before the inversion, as most programs that write such files do.
    pub fn local_pose(&self, pose: &Pose) -> Mat4 {
        match pose {
            Pose::WorldToCamera(pose) => {
                let mut local = *pose;
                // With the identity frame, every bit of the pose must stay the same.
                if !self.is_identity() {
                    local.w_axis = (pose.transform_point3(self.origin) / self.scale).extend(1.0);
                }
                local.as_mat4()
            }
            Pose::CameraToWorld(pose) => {
                let mut local = *pose;
                if !self.is_identity() {
                    local.w_axis =
                        ((pose.w_axis.truncate() - self.origin) / self.scale).extend(1.0);
                }
                local.as_mat4().inverse()
            }
        }
    }

    /// Converts a world-to-camera matrix in scene coordinates to a camera-to-world matrix in world
    /// coordinates.
    pub fn world_pose(&self, world_to_camera: &Mat4) -> DMat4 {
        let mut pose = world_to_camera.as_dmat4().inverse();
        pose.w_axis = (self.origin + self.scale * pose.w_axis.truncate()).extend(1.0);
        pose
    }
}

/// Returns the shortest decimal number that rounds to the given 32-bit float: 0.1, not
/// 0.10000000149.
pub fn shortest_decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}

/// Returns the (upper) median; 0 without values.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn ring(origin: DVec3, unit: f64) -> Vec<DVec3> {
        (0..12)
            .map(|k| {
                origin + unit * DVec3::new((f64::from(k)).cos(), 0.3, (f64::from(k)).sin()) * 2.5
            })
            .collect()
    }

    #[test]
    fn usual_scenes_keep_the_worlds_coordinates() {
        for (origin, unit) in [
            (DVec3::ZERO, 1.0),
            (DVec3::new(20.0, -3.0, 7.0), 1.0),
            (DVec3::splat(50.0), 0.5),
        ] {
            assert!(WorldFrame::for_cameras(&ring(origin, unit)).is_identity());
        }
        assert!(
            WorldFrame::for_cameras(&[DVec3::ZERO; 4]).is_identity(),
            "cameras that only rotate"
        );
    }

    #[test]
    fn far_and_tiny_scenes_keep_their_digits() {
        let utm = DVec3::new(512_345.6, 5_403_210.9, 431.2);
        for (origin, unit) in [
            (utm, 1.0),
            (DVec3::splat(1e5), 1.0),
            (DVec3::ZERO, 1e-5),
            (DVec3::ZERO, 1e5),
            (utm, 1e3),
        ] {
            let mut centres = ring(origin, unit);
            // An outlier.
            centres.push(DVec3::splat(1e9));
            let frame = WorldFrame::for_cameras(&centres);
            let plain = WorldFrame::for_cameras(&ring(DVec3::ZERO, 1.0));
            assert!(frame.keeps_precision(&centres) && !plain.keeps_precision(&centres));
            assert!(plain.is_identity() && !frame.is_identity());
            for (k, world) in ring(origin, unit).into_iter().enumerate() {
                let turn = DQuat::from_rotation_y(k as f64) * DQuat::from_rotation_x(0.3);
                let pose = Pose::CameraToWorld(DMat4::from_rotation_translation(turn, world));
                let inverse =
                    Pose::WorldToCamera(DMat4::from_rotation_translation(turn, world).inverse());
                let local = frame.local_pose(&pose);
                assert!(
                    local.abs_diff_eq(frame.local_pose(&inverse), 1e-5),
                    "{origin} {unit}"
                );
                assert!(
                    frame.world_pose(&local).w_axis.truncate().distance(world)
                        < 1e-5 * unit.max(1.0),
                    "{origin} {unit}"
                );
                let spread = frame.to_local(world).length();
                assert!((0.1..100.0).contains(&spread), "{origin} {unit}: {spread}");
            }
        }
    }
}
