//! Resection: computes the pose of a photo from scene points that its key points show. It needs no
//! initial pose, so it also repairs photos whose poses contradict all others.

use crate::keypoints::Keypoints;
use crate::tracks::{PairMatches, TOLERANCE, tracks};
use crate::triangulate::reprojection_error;
use fastlgs_core::Camera;
use glam::{DMat3, DVec2, DVec3, Mat4, Quat, Vec2, Vec3};
use nalgebra::{SMatrix, SVector};
use std::collections::{BTreeMap, BTreeSet};

/// Number of start poses: those of the photos with the most shared points.
const STARTS: usize = 6;
/// Scales of the Cauchy loss, as shares of the photo's longer side, from coarse to fine. Points
/// with larger errors count less.
const LOSS_SCALES: [f64; 4] = [0.2, 0.05, 0.015, 0.005];
/// Gauss-Newton steps per scale.
const RESECTION_STEPS: usize = 12;
/// Smallest number and smallest share of points that must agree on a pose. Repeated texture can
/// make a quarter of them agree on a wrong pose.
const MIN_RESECTION_POINTS: usize = 25;
const MIN_SHARE: f32 = 0.3;

/// Computes the poses of `lost` photos, whose poses are unknown or wrong, from points of the other
/// photos. Returns the photos that it placed, in that order.
///
/// The photo with the most agreeing points is placed first; its points then help to place the next.
/// `matches` must include those of lost photos, unfiltered by poses.
pub fn place(
    cameras: &mut [Camera],
    lost: &[usize],
    keypoints: &[Keypoints],
    matches: &[PairMatches],
) -> Vec<usize> {
    let mut lost: BTreeSet<usize> = lost.iter().copied().collect();
    let mut placed = Vec::new();
    while !lost.is_empty() {
        let known = known_points(cameras, &lost, keypoints, matches);
        let found = lost.iter().filter_map(|&photo| {
            Some((
                photo,
                place_one(cameras, photo, &lost, keypoints, matches, &known)?,
            ))
        });
        let Some((photo, (camera, _))) =
            found.max_by_key(|(photo, (_, agreeing))| (*agreeing, std::cmp::Reverse(*photo)))
        else {
            break;
        };
        cameras[photo] = camera;
        lost.remove(&photo);
        placed.push(photo);
    }
    placed
}

/// Returns the world positions of tracks between placed photos, by (photo, key point).
fn known_points(
    cameras: &[Camera],
    lost: &BTreeSet<usize>,
    keypoints: &[Keypoints],
    matches: &[PairMatches],
) -> BTreeMap<(usize, usize), Vec3> {
    let good = matches
        .iter()
        .filter(|m| !lost.contains(&m.a) && !lost.contains(&m.b));
    let obeying: Vec<PairMatches> = good
        .map(|m| m.inliers(cameras, keypoints, TOLERANCE))
        .collect();
    let tracks = tracks(cameras, keypoints, &obeying, TOLERANCE);
    tracks
        .iter()
        .flat_map(|track| track.key_points.iter().map(|seen| (*seen, track.position)))
        .collect()
}

/// Returns the camera of a lost photo and the number of points that agree with it. Returns `None`
/// if too few agree.
fn place_one(
    cameras: &[Camera],
    photo: usize,
    lost: &BTreeSet<usize>,
    keypoints: &[Keypoints],
    matches: &[PairMatches],
    known: &BTreeMap<(usize, usize), Vec3>,
) -> Option<(Camera, usize)> {
    let mut seen: Vec<(Vec2, Vec3)> = Vec::new();
    let mut shared: Vec<(usize, usize)> = Vec::new();
    for m in matches.iter().filter(|m| m.a == photo || m.b == photo) {
        let other = if m.a == photo { m.b } else { m.a };
        if lost.contains(&other) {
            continue;
        }
        let before = seen.len();
        for &(i, j) in &m.pairs {
            let (own, theirs) = if m.a == photo { (i, j) } else { (j, i) };
            seen.extend(
                known
                    .get(&(other, theirs))
                    .map(|point| (keypoints[photo].positions[own], *point)),
            );
        }
        shared.push((seen.len() - before, other));
    }
    shared.sort_by_key(|&(count, other)| (std::cmp::Reverse(count), other));
    let camera = &cameras[photo];
    let starts = shared.iter().take(STARTS).map(|&(_, other)| Camera {
        world_to_camera: cameras[other].world_to_camera,
        ..camera.clone()
    });
    let found = starts
        .map(|start| refine_pose(start, &seen))
        .max_by_key(|found| found.1)?;
    let enough = found.1 >= MIN_RESECTION_POINTS && found.1 as f32 >= MIN_SHARE * seen.len() as f32;
    tracing::debug!(
        photo = camera.name,
        points = seen.len(),
        agreeing = found.1,
        enough,
        "resection"
    );
    enough.then_some(found)
}

/// Minimises the reprojection errors of the points over the pose: Gauss-Newton with a Cauchy loss.
/// Returns the camera and the number of points within twice `TOLERANCE`.
fn refine_pose(mut camera: Camera, seen: &[(Vec2, Vec3)]) -> (Camera, usize) {
    let side = f64::from(camera.width.max(camera.height));
    for loss_scale in LOSS_SCALES.map(|share| share * side) {
        for _ in 0..RESECTION_STEPS {
            let Some(motion) = step(&camera, seen, loss_scale) else {
                break;
            };
            let turn = Quat::from_scaled_axis(Vec3::new(
                motion[0] as f32,
                motion[1] as f32,
                motion[2] as f32,
            ));
            let shift = Vec3::new(motion[3] as f32, motion[4] as f32, motion[5] as f32);
            camera.world_to_camera =
                Mat4::from_rotation_translation(turn, shift) * camera.world_to_camera;
        }
    }
    let near = |(pixel, point): &&(Vec2, Vec3)| {
        reprojection_error(&camera, *point, *pixel).is_some_and(|error| error < 2.0 * TOLERANCE)
    };
    let agreeing = seen.iter().filter(near).count();
    (camera, agreeing)
}

/// Returns one Gauss-Newton step in camera space: rotation vector, then translation. Returns `None`
/// if the system cannot be solved.
fn step(camera: &Camera, seen: &[(Vec2, Vec3)], loss_scale: f64) -> Option<SVector<f64, 6>> {
    let pose = camera.world_to_camera.as_dmat4();
    let (rotation, translation) = (DMat3::from_mat4(pose), pose.w_axis.truncate());
    let focal = DVec2::new(camera.fx.into(), camera.fy.into());
    let (mut normal, mut right) = (
        SMatrix::<f64, 6, 6>::identity() * 1e-6,
        SVector::<f64, 6>::zeros(),
    );
    for (pixel, point) in seen {
        let q = rotation * point.as_dvec3() + translation;
        if q.z <= 0.0 {
            continue;
        }
        let ray = q.truncate() / q.z;
        let residual =
            focal * ray + DVec2::new(camera.cx.into(), camera.cy.into()) - pixel.as_dvec2();
        let weight = 1.0 / (1.0 + residual.length_squared() / (loss_scale * loss_scale));
        for (row, r) in [
            (focal.x / q.z * DVec3::new(1.0, 0.0, -ray.x), residual.x),
            (focal.y / q.z * DVec3::new(0.0, 1.0, -ray.y), residual.y),
        ] {
            let turn = q.cross(row);
            let slope = SVector::from([turn.x, turn.y, turn.z, row.x, row.y, row.z]);
            normal += weight * slope * slope.transpose();
            right -= weight * r * slope;
        }
    }
    normal
        .cholesky()
        .map(|factors| factors.solve(&right))
        .filter(|step| step.iter().all(|v| v.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{matching, ring};
    use fastlgs_core::rng::Rng;

    #[test]
    fn photos_with_arbitrary_poses_are_placed() {
        let mut rng = Rng::new(5, "ring");
        let (cloud, truth) = (ring::cloud(&mut rng), ring::cameras(10));
        // 40 % of the key points are displaced.
        let mut error = || {
            let size = if rng.uniform() < 0.4 { 80.0 } else { 0.3 };
            size * Vec2::new(rng.normal(), rng.normal())
        };
        let keypoints: Vec<Keypoints> = truth
            .iter()
            .map(|c| ring::key_points(c, &cloud, &mut error))
            .collect();
        let pairs = (0..10).flat_map(|a| (a + 1..10).map(move |b| (a, b)));
        let matches: Vec<PairMatches> = pairs
            .map(|(a, b)| PairMatches {
                a,
                b,
                pairs: matching::matches(&keypoints[a], &keypoints[b]),
            })
            .collect();
        let mut cameras = truth.clone();
        for lost in [6, 7] {
            cameras[lost] = Camera::look_at(
                "lost",
                Vec3::new(30.0, 1.0, 2.0),
                Vec3::new(40.0, 0.0, 0.0),
                Vec3::Y,
                320,
                240,
                0.8,
            );
        }
        let mut placed = place(&mut cameras, &[6, 7], &keypoints, &matches);
        placed.sort_unstable();
        assert_eq!(placed, [6, 7]);
        for lost in [6, 7] {
            assert!(
                cameras[lost].centre().distance(truth[lost].centre()) < 0.05,
                "{} {}",
                cameras[lost].centre(),
                truth[lost].centre()
            );
        }
        // A photo without matches stays lost.
        let others: Vec<PairMatches> = matches
            .into_iter()
            .filter(|m| m.a != 3 && m.b != 3)
            .collect();
        assert!(place(&mut cameras, &[3], &keypoints, &others).is_empty());
    }
}
