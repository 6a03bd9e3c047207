//! Similarity transforms: rotation, translation and uniform scale.

use fastlgs_core::Camera;
use glam::{Mat3, Mat4, Quat, Vec3};
use nalgebra::{Matrix3, Vector3};

/// A similarity transform: x -> scale * (rotation x) + translation.
#[derive(Clone, Copy, Debug)]
pub struct Similarity {
    /// Uniform scale.
    pub scale: f32,
    /// Rotation.
    pub rotation: Mat3,
    /// Translation, applied after scale and rotation.
    pub translation: Vec3,
}

impl Similarity {
    /// Transforms a point.
    pub fn apply(&self, p: Vec3) -> Vec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// Returns this similarity followed by a small one: log scale, rotation vector (3), translation
    /// (3).
    pub fn followed_by_small(&self, delta: &[f32; 7]) -> Self {
        let turn = Mat3::from_quat(Quat::from_scaled_axis(Vec3::new(
            delta[1], delta[2], delta[3],
        )));
        let grow = delta[0].exp();
        Self {
            scale: grow * self.scale,
            rotation: turn * self.rotation,
            translation: grow * (turn * self.translation) + Vec3::new(delta[4], delta[5], delta[6]),
        }
    }

    /// Moves a camera together with the world it sees. Lengths in its camera space are multiplied
    /// by the scale.
    pub fn move_camera(&self, camera: &mut Camera) {
        let (rotation, t) = (
            Mat3::from_mat4(camera.world_to_camera),
            camera.world_to_camera.w_axis.truncate(),
        );
        let turned = rotation * self.rotation.transpose();
        let mut moved = Mat4::from_mat3(turned);
        moved.w_axis = (self.scale * t - turned * self.translation).extend(1.0);
        camera.world_to_camera = moved;
    }

    /// Returns the similarity that maps the first point of each pair to the second, by least
    /// squares (Umeyama 1991). Returns `None` if the points lie on a line, or if the scale is
    /// outside 0.001 to 1,000.
    pub fn between(pairs: &[(Vec3, Vec3)]) -> Option<Self> {
        let vector = |p: Vec3| Vector3::new(f64::from(p.x), f64::from(p.y), f64::from(p.z));
        let n = pairs.len() as f64;
        let (mut from, mut to) = (Vector3::zeros(), Vector3::zeros());
        pairs
            .iter()
            .for_each(|(x, y)| (from, to) = (from + vector(*x) / n, to + vector(*y) / n));
        let (mut covariance, mut variance) = (Matrix3::zeros(), 0.0);
        for (x, y) in pairs {
            let (x, y) = (vector(*x) - from, vector(*y) - to);
            covariance += y * x.transpose() / n;
            variance += x.norm_squared() / n;
        }
        let svd = covariance.svd(true, true);
        let (u, vt) = (svd.u?, svd.v_t?);
        // If the points lie on a line, the rotation around it is undetermined.
        let mut sizes = svd.singular_values;
        if sizes[1] <= 1e-9 * sizes[0] || !variance.is_normal() {
            return None;
        }
        let mut sign = Matrix3::identity();
        if u.determinant() * vt.determinant() < 0.0 {
            sign[(2, 2)] = -1.0;
            sizes[2] = -sizes[2];
        }
        let rotation = u * sign * vt;
        let scale = sizes.sum() / variance;
        let translation = to - scale * rotation * from;
        let found = Self {
            scale: scale as f32,
            rotation: Mat3::from_cols_array(&std::array::from_fn(|k| {
                rotation[(k % 3, k / 3)] as f32
            })),
            translation: Vec3::new(
                translation[0] as f32,
                translation[1] as f32,
                translation[2] as f32,
            ),
        };
        (1e-3..1e3).contains(&found.scale).then_some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    #[test]
    fn the_similarity_between_points_is_found_from_three_on() {
        let mut rng = Rng::new(4, "similarity");
        let truth = Similarity {
            scale: 1.7,
            rotation: Mat3::from_rotation_y(2.9) * Mat3::from_rotation_x(0.4),
            translation: Vec3::new(2.0, -1.0, 0.5),
        };
        let mut point = || Vec3::new(rng.normal(), rng.normal(), rng.normal());
        let points: Vec<Vec3> = (0..20).map(|_| point()).collect();
        for count in [3, 4, 20] {
            let pairs: Vec<(Vec3, Vec3)> = points[..count]
                .iter()
                .map(|p| (*p, truth.apply(*p)))
                .collect();
            let found = Similarity::between(&pairs).unwrap();
            assert!(
                points
                    .iter()
                    .all(|p| found.apply(*p).distance(truth.apply(*p)) < 1e-3),
                "from {count} points: {found:?}"
            );
        }
        let line: Vec<(Vec3, Vec3)> = (0..5)
            .map(|k| (Vec3::X * k as f32, Vec3::Y * k as f32))
            .collect();
        assert!(Similarity::between(&line).is_none());
    }
}
