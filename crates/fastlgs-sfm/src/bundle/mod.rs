//! Bundle adjustment (Triggs et al. 2000): refines cameras, their lenses and points together.
//!
//! It minimises the reprojection error of the key points. Levenberg-Marquardt solves for the
//! cameras; the Schur complement eliminates the points. Its blocks are sparse, and conjugate
//! gradients solve it (Agarwal et al. 2010). Cauchy's loss reduces the weight of wrong matches.

mod problem;

use crate::keypoints::Keypoints;
use crate::similarity::Similarity;
use crate::tracks::{PairMatches, TOLERANCE, Track, tracks};
use fastlgs_core::Camera;
use fastlgs_core::stats;
use fastlgs_core::undistort::Distortion;
use glam::Vec3;
use problem::{Lens, Observation, Pose, Problem, Values};
use serde::{Deserialize, Serialize};

/// Tolerance of matches in each round, in multiples of [`TOLERANCE`]: loose while poses are rough.
const ROUND_TOLERANCES: [f32; 4] = [4.0, 4.0, 2.0, 1.0];
/// Smallest number of photos with the same lens for which the lens is adjusted.
const MIN_PHOTOS_PER_LENS: usize = 5;

/// Result of a bundle adjustment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BundleReport {
    /// Root mean square reprojection error in pixels, before and after. Each is computed over the
    /// tracks that agree with those poses.
    pub error: [f32; 2],
    /// Number of observations in these tracks, before and after.
    pub observations: [usize; 2],
    /// Median distance in pixels between the projections of a camera's points before and after, for
    /// each camera; 0 if it has no tracks.
    pub moved: Vec<f32>,
    /// Factor on the focal length of each camera; 1 if its lens was not adjusted.
    pub focal: Vec<f32>,
    /// First radial distortion coefficient k1 that remains in the photos of each camera. A
    /// normalised image point p is distorted to p (1 + k1 |p|^2).
    pub k1: Vec<f32>,
}

/// Refines `cameras` to fit `matches` best, in the world frame of the given cameras.
///
/// Returns `None` if a round finds no tracks; `cameras` may have changed by then.
pub fn adjust(
    cameras: &mut [Camera],
    keypoints: &[Keypoints],
    matches: &[PairMatches],
) -> Option<BundleReport> {
    let initial = cameras.to_vec();
    let obeying = |cameras: &[Camera], keypoints: &[Keypoints], tolerance: f32| -> Vec<Track> {
        let matches: Vec<PairMatches> = matches
            .iter()
            .map(|m| m.inliers(cameras, keypoints, tolerance))
            .collect();
        tracks(cameras, keypoints, &matches, tolerance)
    };
    let before = quality(&obeying(&initial, keypoints, TOLERANCE));
    let lens = lenses(&initial);
    let mut values = Values {
        poses: Vec::new(),
        lenses: vec![Lens::default(); lens.iter().flatten().max().map_or(0, |l| l + 1)],
        points: Vec::new(),
    };
    for round in ROUND_TOLERANCES {
        // Remove the distortion estimated so far: otherwise matches near corners exceed the
        // tolerance.
        let tracks = obeying(
            cameras,
            &undistorted(keypoints, cameras, &lens, &values.lenses),
            round * TOLERANCE,
        );
        if tracks.is_empty() {
            return None;
        }
        let problem = Problem {
            cameras: &initial,
            lens: lens.clone(),
            seen: observations(&tracks, keypoints),
        };
        values.poses = cameras.iter().map(Pose::of).collect();
        values.points = tracks.iter().map(|t| t.position.as_dvec3()).collect();
        problem.solve(&mut values);
        values.apply(&problem, cameras);
    }
    keep_gauge(cameras, &initial);
    let after = obeying(
        cameras,
        &undistorted(keypoints, cameras, &lens, &values.lenses),
        TOLERANCE,
    );
    let lens_of = |view: usize| lens[view].map_or_else(Lens::default, |l| values.lenses[l]);
    Some(BundleReport {
        error: [before.0, quality(&after).0],
        observations: [before.1, quality(&after).1],
        moved: movements(&initial, cameras, &after),
        focal: (0..cameras.len())
            .map(|v| lens_of(v).log_focal.exp() as f32)
            .collect(),
        k1: (0..cameras.len()).map(|v| lens_of(v).k1 as f32).collect(),
    })
}

/// Returns the key points without the distortion of their lenses.
fn undistorted(
    keypoints: &[Keypoints],
    cameras: &[Camera],
    lens: &[Option<usize>],
    lenses: &[Lens],
) -> Vec<Keypoints> {
    let mut out = keypoints.to_vec();
    for (view, points) in out.iter_mut().enumerate() {
        let Some(distortion) = lens[view].map(|l| Distortion {
            k1: lenses[l].k1 as f32,
            ..Distortion::default()
        }) else {
            continue;
        };
        points
            .positions
            .iter_mut()
            .for_each(|p| *p = distortion.undistort_pixel(&cameras[view], *p));
    }
    out
}

/// Returns the root mean square reprojection error in pixels and the number of observations.
fn quality(tracks: &[Track]) -> (f32, usize) {
    let count: usize = tracks.iter().map(|t| t.key_points.len()).sum();
    let square: f32 = tracks
        .iter()
        .map(|t| t.error * t.error * t.key_points.len() as f32)
        .sum();
    ((square / count.max(1) as f32).sqrt(), count)
}

/// Returns the lens index of each camera: cameras of equal size and intrinsics share one. `None` if
/// fewer than `MIN_PHOTOS_PER_LENS` cameras share it; it is then not adjusted.
fn lenses(cameras: &[Camera]) -> Vec<Option<usize>> {
    let same = |a: &Camera, b: &Camera| {
        (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == (b.width, b.height, b.fx, b.fy, b.cx, b.cy)
    };
    let mut shared_lenses: Vec<&Camera> = Vec::new();
    for camera in cameras {
        let sharing = cameras.iter().filter(|other| same(camera, other)).count();
        if sharing >= MIN_PHOTOS_PER_LENS && !shared_lenses.iter().any(|other| same(camera, other))
        {
            shared_lenses.push(camera);
        }
    }
    cameras
        .iter()
        .map(|camera| shared_lenses.iter().position(|other| same(camera, other)))
        .collect()
}

fn observations(tracks: &[Track], keypoints: &[Keypoints]) -> Vec<Vec<Observation>> {
    let of = |&(view, k): &(usize, usize)| Observation {
        view,
        pixel: keypoints[view].positions[k].as_dvec2(),
    };
    tracks
        .iter()
        .map(|track| track.key_points.iter().map(of).collect())
        .collect()
}

/// Moves all cameras by the similarity that best aligns them with `given` (fixes the gauge).
fn keep_gauge(cameras: &mut [Camera], given: &[Camera]) {
    let extent = fastlgs_core::camera::scene_extent(given);
    // Points in front of and above the cameras also fix the rotation about a line of cameras.
    let anchors = |c: &Camera| {
        let axes = c.world_to_camera.transpose();
        [
            c.centre(),
            c.centre() + extent * c.forward(),
            c.centre() - extent * axes.y_axis.truncate(),
        ]
    };
    let pairs: Vec<(Vec3, Vec3)> = cameras
        .iter()
        .zip(given)
        .flat_map(|(now, then)| anchors(now).into_iter().zip(anchors(then)))
        .collect();
    if let Some(back) = Similarity::between(&pairs) {
        cameras
            .iter_mut()
            .for_each(|camera| back.move_camera(camera));
    }
}

/// Returns for each camera the median distance in pixels between the projections of its tracks'
/// points by `given` and by `cameras`; 0 without tracks.
fn movements(given: &[Camera], cameras: &[Camera], tracks: &[Track]) -> Vec<f32> {
    let mut distances: Vec<Vec<f32>> = vec![Vec::new(); cameras.len()];
    for track in tracks {
        for &(view, _) in &track.key_points {
            let at = |c: &Camera| c.to_pixel(c.world_to_camera.transform_point3(track.position));
            distances[view].push(at(&given[view]).distance(at(&cameras[view])));
        }
    }
    let median = |distances: Vec<f32>| stats::median(distances).unwrap_or(0.0);
    distances.into_iter().map(median).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::matches as match_all;
    use crate::ring;
    use fastlgs_core::rng::Rng;
    use glam::{Mat4, Quat, Vec2};

    /// Returns cameras around a cloud, their key points and matches. Key points have half a pixel
    /// of noise; a tenth of them have 30 pixels.
    fn noisy_ring(count: usize) -> (Vec<Camera>, Vec<Keypoints>, Vec<PairMatches>) {
        let mut rng = Rng::new(5, "ring");
        let (cloud, cameras) = (ring::cloud(&mut rng), ring::cameras(count));
        let mut error = || {
            let size = if rng.uniform() < 0.1 { 30.0 } else { 0.5 };
            size * Vec2::new(rng.normal(), rng.normal())
        };
        let keypoints: Vec<Keypoints> = cameras
            .iter()
            .map(|c| ring::key_points(c, &cloud, &mut error))
            .collect();
        let near = |a: usize| (a + 1..count.min(a + 6)).map(move |b| (a, b));
        let matched = |(a, b): (usize, usize)| PairMatches {
            a,
            b,
            pairs: match_all(&keypoints[a], &keypoints[b]),
        };
        let matches = (0..count).flat_map(near).map(matched).collect();
        (cameras, keypoints, matches)
    }

    /// Median distance in pixels between the projections of points around the origin by two
    /// cameras.
    fn median_shift(a: &[Camera], b: &[Camera]) -> f32 {
        let points: Vec<Vec3> = (0..8)
            .map(|k| Vec3::new((k & 1) as f32, (k >> 1 & 1) as f32, (k >> 2) as f32) - 0.5)
            .collect();
        let see = |c: &Camera, p: &Vec3| c.to_pixel(c.world_to_camera.transform_point3(*p));
        let mut all: Vec<f32> = a
            .iter()
            .zip(b)
            .flat_map(|(a, b)| {
                points
                    .iter()
                    .map(|p| see(a, p).distance(see(b, p)))
                    .collect::<Vec<_>>()
            })
            .collect();
        all.sort_by(f32::total_cmp);
        all[all.len() / 2]
    }

    /// Mean difference, in pixels, between the rotations from each camera to the next. It does not
    /// depend on the world frame.
    fn mean_rotation_difference(a: &[Camera], b: &[Camera]) -> f32 {
        let turn = |c: &Camera| Quat::from_mat4(&c.world_to_camera);
        let turns = |all: &[Camera]| {
            all.windows(2)
                .map(|pair| turn(&pair[1]) * turn(&pair[0]).inverse())
                .collect::<Vec<_>>()
        };
        let angles = turns(a)
            .into_iter()
            .zip(turns(b))
            .map(|(a, b)| a.angle_between(b));
        a[0].fx * angles.sum::<f32>() / (a.len() - 1) as f32
    }

    #[test]
    fn noise_on_the_poses_is_removed() {
        let (truth, keypoints, matches) = noisy_ring(24);
        let mut cameras = truth.clone();
        let mut rng = Rng::new(8, "poses");
        for camera in &mut cameras {
            let turn =
                Quat::from_scaled_axis(0.012 * Vec3::new(rng.normal(), rng.normal(), rng.normal()));
            camera.world_to_camera =
                Mat4::from_translation(0.02 * Vec3::new(rng.normal(), rng.normal(), rng.normal()))
                    * Mat4::from_quat(turn)
                    * camera.world_to_camera;
        }
        let given = cameras.clone();
        let report = adjust(&mut cameras, &keypoints, &matches).unwrap();
        let [before, after] = [
            mean_rotation_difference(&given, &truth),
            mean_rotation_difference(&cameras, &truth),
        ];
        // In a small cloud, rotation and translation look alike, so their remaining errors
        // compensate.
        assert!(
            before > 3.0 && after < 0.2 * before,
            "{before} px before, {after} after"
        );
        assert!(
            report.error[1] < 0.9 && report.observations[1] > 2 * report.observations[0],
            "{report:?}"
        );
        assert!(
            report.moved.iter().all(|m| (0.3..20.0).contains(m)),
            "{:?}",
            report.moved
        );
    }

    #[test]
    fn focal_length_and_radial_distortion_are_recovered() {
        let (truth, mut keypoints, matches) = noisy_ring(24);
        let mut cameras = truth.clone();
        cameras
            .iter_mut()
            .for_each(|c| (c.fx, c.fy) = (1.03 * c.fx, 1.03 * c.fy));
        for pixel in keypoints.iter_mut().flat_map(|k| &mut k.positions) {
            let ray = truth[0].ray(*pixel).truncate();
            *pixel =
                Vec2::new(truth[0].fx, truth[0].fy) * ray * (1.0 - 0.05 * ray.length_squared())
                    + Vec2::new(truth[0].cx, truth[0].cy);
        }
        let report = adjust(&mut cameras, &keypoints, &matches).unwrap();
        assert!(
            (report.focal[0] * 1.03 - 1.0).abs() < 0.005 && (report.k1[0] + 0.05).abs() < 0.02,
            "{} {}",
            report.focal[0],
            report.k1[0]
        );
    }

    #[test]
    fn right_poses_hardly_move() {
        let (truth, keypoints, matches) = noisy_ring(24);
        let mut cameras = truth.clone();
        let report = adjust(&mut cameras, &keypoints, &matches).unwrap();
        assert!(
            median_shift(&cameras, &truth) < 0.2 && (report.focal[0] - 1.0).abs() < 0.003,
            "{} {}",
            median_shift(&cameras, &truth),
            report.focal[0]
        );
        assert!(adjust(&mut cameras, &keypoints, &[]).is_none());
    }

    /// Returns cameras along a wall, and their key points and matches. Each camera sees a hundred
    /// points, and shares half of them with the fifth one after it.
    fn along_a_wall(count: usize) -> (Vec<Camera>, Vec<Keypoints>, Vec<PairMatches>) {
        const SHIFT: f32 = 0.4;
        let mut rng = Rng::new(5, "wall");
        let points: Vec<Vec3> = (0..10 * count + 90)
            .map(|k| {
                Vec3::new(
                    SHIFT * 0.1 * k as f32,
                    rng.range(-1.5, 1.5),
                    rng.range(3.0, 5.0),
                )
            })
            .collect();
        let camera = |k: usize| {
            let eye = Vec3::new(SHIFT * (k as f32 + 5.0), 0.0, 0.0);
            Camera::look_at(
                &format!("{k:04}"),
                eye,
                eye + Vec3::Z,
                Vec3::Y,
                320,
                240,
                0.8,
            )
        };
        let cameras: Vec<Camera> = (0..count).map(camera).collect();
        let mut noise = || 0.5 * Vec2::new(rng.normal(), rng.normal());
        let key_points = |(k, c): (usize, &Camera)| Keypoints {
            positions: points[10 * k..10 * k + 100]
                .iter()
                .map(|p| c.to_pixel(c.world_to_camera.transform_point3(*p)) + noise())
                .collect(),
            descriptors: vec![[0; 128]; 100],
        };
        let keypoints = cameras.iter().enumerate().map(key_points).collect();
        let near = |a: usize| (a + 1..count.min(a + 6)).map(move |b| (a, b));
        let matched = |(a, b): (usize, usize)| PairMatches {
            a,
            b,
            pairs: (10 * (b - a)..100).map(|i| (i, i - 10 * (b - a))).collect(),
        };
        let matches = (0..count).flat_map(near).map(matched).collect();
        (cameras, keypoints, matches)
    }

    #[test]
    fn hundreds_of_photos_are_adjusted() {
        let (truth, keypoints, matches) = along_a_wall(700);
        let mut cameras = truth.clone();
        let mut rng = Rng::new(8, "poses");
        for camera in &mut cameras {
            let turn = 0.006 * Vec3::new(rng.normal(), rng.normal(), rng.normal());
            camera.world_to_camera =
                Mat4::from_quat(Quat::from_scaled_axis(turn)) * camera.world_to_camera;
        }
        let before = mean_rotation_difference(&cameras, &truth);
        let report = adjust(&mut cameras, &keypoints, &matches).unwrap();
        let after = mean_rotation_difference(&cameras, &truth);
        assert!(after < 0.2 * before, "{before} px before, {after} after");
        assert!(report.error[1] < 0.7, "{report:?}");
    }
}
