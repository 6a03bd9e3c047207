//! Triangulates points of the scene from pixels of several photos with known poses.

use fastlgs_core::Camera;
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};

/// Smallest angle between the two rays of a triangulated point, in radians.
const MIN_ANGLE: f32 = 0.02;
/// Largest number of pixels of a point from whose pairs start values are computed.
const MAX_START_PIXELS: usize = 6;
/// Gauss-Newton steps. Near the solution, two are sufficient.
const TRIANGULATION_STEPS: usize = 4;

/// A triangulated point and the pixels that agree with it.
#[derive(Clone, Debug, PartialEq)]
pub struct Located {
    /// World position.
    pub position: Vec3,
    /// Root mean square of the reprojection errors, in pixels.
    pub error: f32,
    /// Indices of the given pixels that agree.
    pub agreeing: Vec<usize>,
}

/// Returns the distance in pixels between the projection of a point and `pixel`; `None` if the
/// point is behind the camera.
pub fn reprojection_error(camera: &Camera, point: Vec3, pixel: Vec2) -> Option<f32> {
    let q = camera.world_to_camera.transform_point3(point);
    (q.z > 0.0).then(|| camera.to_pixel(q).distance(pixel))
}

/// Returns the midpoint of the shortest segment between two rays. Returns `None` if their angle is
/// too small, or if the point is behind a camera or has a reprojection error of `tolerance` pixels
/// or more.
pub(crate) fn intersect(
    a: &Camera,
    pa: Vec2,
    b: &Camera,
    pb: Vec2,
    tolerance: f32,
) -> Option<Vec3> {
    let ray =
        |c: &Camera, p: Vec2| (c.world_to_camera.inverse().transform_vector3(c.ray(p))).normalize();
    let (oa, ob, da, db) = (a.centre(), b.centre(), ray(a, pa), ray(b, pb));
    let cosine = da.dot(db);
    if cosine > MIN_ANGLE.cos() {
        return None;
    }
    let between = ob - oa;
    let (along_a, along_b) = (between.dot(da), between.dot(db));
    let sine2 = 1.0 - cosine * cosine;
    let (s, t) = (
        (along_a - cosine * along_b) / sine2,
        (cosine * along_a - along_b) / sine2,
    );
    let point = 0.5 * (oa + s * da + ob + t * db);
    let seen = |c: &Camera, p: Vec2| {
        reprojection_error(c, point, p).is_some_and(|error| error < tolerance)
    };
    (s > 0.0 && t > 0.0 && seen(a, pa) && seen(b, pb)).then_some(point)
}

/// Returns the point with which most pixels agree within `tolerance` pixels. The best intersection
/// of two rays is refined by least squares over its inliers. Returns `None` if fewer than two
/// pixels agree.
pub fn locate(seen: &[(&Camera, Vec2)], tolerance: f32) -> Option<Located> {
    let agreeing = |point: Vec3| -> (Vec<usize>, f32) {
        let errors = seen
            .iter()
            .enumerate()
            .filter_map(|(k, (c, p))| Some((k, reprojection_error(c, point, *p)?)));
        let near: Vec<(usize, f32)> = errors.filter(|(_, error)| *error < tolerance).collect();
        let square = near.iter().map(|(_, e)| e * e).sum::<f32>();
        (near.iter().map(|n| n.0).collect(), square)
    };
    let tried: Vec<usize> = (0..seen.len().min(MAX_START_PIXELS))
        .map(|k| k * seen.len() / seen.len().min(MAX_START_PIXELS))
        .collect();
    let mut best: Option<(Vec3, Vec<usize>, f32)> = None;
    for (n, &i) in tried.iter().enumerate() {
        for &j in &tried[n + 1..] {
            let Some(point) = intersect(seen[i].0, seen[i].1, seen[j].0, seen[j].1, tolerance)
            else {
                continue;
            };
            let (inliers, square) = agreeing(point);
            let better = |b: &(Vec3, Vec<usize>, f32)| {
                inliers.len() > b.1.len() || inliers.len() == b.1.len() && square < b.2
            };
            if best.as_ref().is_none_or(better) {
                best = Some((point, inliers, square));
            }
        }
    }
    let (start, inliers, _) = best.filter(|b| b.1.len() >= 2)?;
    let position = least_squares(start, inliers.iter().map(|&k| seen[k]));
    let (agreeing, square) = agreeing(position);
    (agreeing.len() >= 2).then(|| Located {
        position,
        error: (square / agreeing.len() as f32).sqrt(),
        agreeing,
    })
}

/// Minimises the sum of squared reprojection errors from `start` (Gauss-Newton).
fn least_squares<'a>(start: Vec3, seen: impl Iterator<Item = (&'a Camera, Vec2)> + Clone) -> Vec3 {
    let mut point = start.as_dvec3();
    for _ in 0..TRIANGULATION_STEPS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (camera, pixel) in seen.clone() {
            let pose = camera.world_to_camera.as_dmat4();
            let q = pose.transform_point3(point);
            let (fx, fy) = (f64::from(camera.fx), f64::from(camera.fy));
            let projected = DVec2::new(
                fx * q.x / q.z + f64::from(camera.cx),
                fy * q.y / q.z + f64::from(camera.cy),
            );
            let residual = projected - pixel.as_dvec2();
            let camera_to_world = DMat3::from_mat4(pose).transpose();
            for (row, r) in [
                (
                    camera_to_world * DVec3::new(fx / q.z, 0.0, -fx * q.x / (q.z * q.z)),
                    residual.x,
                ),
                (
                    camera_to_world * DVec3::new(0.0, fy / q.z, -fy * q.y / (q.z * q.z)),
                    residual.y,
                ),
            ] {
                normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
                right -= row * r;
            }
        }
        let step = normal.inverse() * right;
        if !step.is_finite() {
            break;
        }
        point += step;
    }
    point.as_vec3()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    fn ring(count: usize) -> Vec<Camera> {
        let eye = |k: usize| 4.0 * Vec3::new((0.3 * k as f32).cos(), 0.2, (0.3 * k as f32).sin());
        (0..count)
            .map(|k| Camera::look_at(&k.to_string(), eye(k), Vec3::ZERO, Vec3::Y, 320, 240, 0.8))
            .collect()
    }

    fn see(camera: &Camera, point: Vec3) -> Vec2 {
        camera.to_pixel(camera.world_to_camera.transform_point3(point))
    }

    #[test]
    fn two_rays_meet_where_the_point_is() {
        let cameras = ring(3);
        let point = Vec3::new(0.2, -0.3, 0.1);
        let [a, b] = [&cameras[0], &cameras[2]];
        assert!(
            (intersect(a, see(a, point), b, see(b, point), 1.0).unwrap() - point).length() < 1e-3
        );
        assert!(
            intersect(a, see(a, point), a, see(a, point), 1.0).is_none(),
            "rays without parallax must give no point"
        );
    }

    #[test]
    fn more_views_are_more_accurate_and_an_outlier_is_rejected() {
        let cameras = ring(8);
        let mut rng = Rng::new(2, "noise");
        let (mut of_all, mut of_two) = (0.0, 0.0);
        for _ in 0..50 {
            let point = Vec3::new(
                rng.range(-0.5, 0.5),
                rng.range(-0.5, 0.5),
                rng.range(-0.5, 0.5),
            );
            let mut seen: Vec<(&Camera, Vec2)> = cameras
                .iter()
                .map(|c| {
                    (
                        c,
                        see(c, point) + 0.5 * Vec2::new(rng.normal(), rng.normal()),
                    )
                })
                .collect();
            of_two += locate(&seen[..2], 4.0).map_or(0.0, |l| l.position.distance(point));
            seen[5].1 += Vec2::new(40.0, -30.0);
            let located = locate(&seen, 4.0).unwrap();
            assert_eq!(located.agreeing, [0, 1, 2, 3, 4, 6, 7]);
            assert!(located.error < 1.5);
            of_all += located.position.distance(point);
        }
        assert!(of_all < 0.5 * of_two, "{of_all} against {of_two}");
    }
}
