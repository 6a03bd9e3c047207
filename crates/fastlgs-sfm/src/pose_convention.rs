//! Detects the convention in which poses are written. With the right one, key points of
//! neighbouring photos lie on each other's epipolar lines.

use crate::keypoints::{Keypoints, epipolar_error, fundamental};
use crate::matching;
use crate::tracks::PairMatches;
use fastlgs_core::Camera;
use fastlgs_core::dataset::PoseConvention;
use rayon::prelude::*;

/// Largest number of photo pairs that are matched.
const PAIRS: usize = 40;
/// Largest number of key points per photo that are matched. Only shares are estimated.
const KEY_POINTS: usize = 1200;
/// Smallest number of matches of a pair that is used.
const MIN_CONVENTION_MATCHES: usize = 20;
/// Largest epipolar error of an inlier, as a share of the photo's longer side. It is large because
/// poses may be rough.
const TOLERANCE: f32 = 0.01;
/// Smallest share of inliers with which another convention is accepted.
const MIN_CONVENTION_SHARE: f32 = 0.5;
/// Factor by which the accepted convention's share of inliers must exceed that of every other.
const MIN_RATIO: f32 = 1.5;

/// Matches a sample of the key points of photos that are one or two apart in the order of names.
/// Pairs with few matches are left out.
pub fn sample(keypoints: &[Keypoints]) -> Vec<PairMatches> {
    let part = |points: &Keypoints| {
        let stride = points.positions.len().div_ceil(KEY_POINTS).max(1);
        let every = |k: usize| k.is_multiple_of(stride);
        let positions = points
            .positions
            .iter()
            .enumerate()
            .filter(|(k, _)| every(*k))
            .map(|p| *p.1)
            .collect();
        let descriptors = points
            .descriptors
            .iter()
            .enumerate()
            .filter(|(k, _)| every(*k))
            .map(|d| *d.1)
            .collect();
        (
            stride,
            Keypoints {
                positions,
                descriptors,
            },
        )
    };
    let count = keypoints.len();
    let pairs: Vec<(usize, usize)> = (0..count)
        .flat_map(|a| [(a, a + 1), (a, a + 2)])
        .filter(|(_, b)| *b < count)
        .collect();
    let stride = pairs.len().div_ceil(PAIRS).max(1);
    let compared = pairs.into_par_iter().step_by(stride).map(|(a, b)| {
        let ((stride_a, points_a), (stride_b, points_b)) =
            (part(&keypoints[a]), part(&keypoints[b]));
        let found = matching::matches(&points_a, &points_b);
        PairMatches {
            a,
            b,
            pairs: found
                .into_iter()
                .map(|(i, j)| (i * stride_a, j * stride_b))
                .collect(),
        }
    });
    compared
        .filter(|pair| pair.pairs.len() >= MIN_CONVENTION_MATCHES)
        .collect()
}

/// Distance of two cameras below which they count as one position, as a share of their distance
/// from the origin.
const SAME_POSITION: f32 = 1e-5;

/// Returns the share of matches that are inliers of the epipolar geometry of these cameras; `None`
/// without matches.
pub fn inlier_share(
    cameras: &[Camera],
    keypoints: &[Keypoints],
    matches: &[PairMatches],
) -> Option<f32> {
    let all: usize = matches.iter().map(|pair| pair.pairs.len()).sum();
    let obeying = |pair: &PairMatches| {
        let (a, b) = (&cameras[pair.a], &cameras[pair.b]);
        let [at_a, at_b] = [a.centre(), b.centre()];
        if at_a.distance(at_b) <= SAME_POSITION * at_a.length().max(at_b.length()) {
            // Without a baseline there are no epipolar lines.
            return 0;
        }
        let f = fundamental(a, b);
        let tolerance = TOLERANCE * a.width.max(a.height) as f32;
        let error = |&(i, j): &(usize, usize)| {
            epipolar_error(
                &f,
                keypoints[pair.a].positions[i],
                keypoints[pair.b].positions[j],
            )
        };
        pair.pairs
            .iter()
            .filter(|pair| error(pair) < tolerance)
            .count()
    };
    (all > 0).then(|| matches.iter().map(obeying).sum::<usize>() as f32 / all as f32)
}

/// Result of `judge`.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// No evidence against the standard convention.
    Standard,
    /// Another convention fits clearly better. The numbers are the inlier shares of this and of the
    /// standard convention.
    Other(PoseConvention, [f32; 2]),
    /// Several other conventions fit better, and about equally well.
    Unclear(Vec<PoseConvention>),
}

/// Compares the inlier shares of the cameras in each convention. The first candidate is the
/// standard one.
pub fn judge(
    candidates: &[(PoseConvention, Vec<Camera>)],
    keypoints: &[Keypoints],
    matches: &[PairMatches],
) -> Verdict {
    let share = |candidate: &(PoseConvention, Vec<Camera>)| {
        inlier_share(&candidate.1, keypoints, matches).unwrap_or(0.0)
    };
    let Some((standard, others)) = candidates.split_first() else {
        return Verdict::Standard;
    };
    let standard_share = share(standard);
    let mut shares: Vec<(PoseConvention, f32)> =
        others.iter().map(|other| (other.0, share(other))).collect();
    shares.sort_by(|a, b| b.1.total_cmp(&a.1));
    tracing::debug!(
        standard_share,
        ?shares,
        "epipolar inlier share by pose convention"
    );
    match shares[..] {
        [(best, share), ..] if share >= MIN_CONVENTION_SHARE.max(MIN_RATIO * standard_share) => {
            let alike: Vec<PoseConvention> = shares
                .iter()
                .filter(|other| MIN_RATIO * other.1 > share)
                .map(|other| other.0)
                .collect();
            if alike.len() == 1 {
                Verdict::Other(best, [share, standard_share])
            } else {
                Verdict::Unclear(alike)
            }
        }
        _ => Verdict::Standard,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ring;
    use fastlgs_core::dataset::RawPose;
    use fastlgs_core::rng::Rng;
    use fastlgs_core::world_frame::WorldFrame;
    use glam::{DMat4, DVec4, Quat, Vec2};

    /// Returns the cameras read in each of `kinds`, if their poses are written as `written`.
    fn read(
        cameras: &[Camera],
        written: PoseConvention,
        kinds: &[PoseConvention],
    ) -> Vec<(PoseConvention, Vec<Camera>)> {
        use PoseConvention::{
            C2wOpencv, C2wOpencvXyzw, C2wOpengl, W2cOpencv, W2cOpencvXyzw, W2cOpengl,
        };
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let stated = |camera: &Camera| {
            let w2c = camera.world_to_camera.as_dmat4();
            let matrix = match written {
                C2wOpengl => w2c.inverse() * flip,
                C2wOpencv | C2wOpencvXyzw => w2c.inverse(),
                W2cOpengl => flip * w2c,
                W2cOpencv | W2cOpencvXyzw => w2c,
            };
            if kinds == PoseConvention::OF_MATRICES {
                return RawPose::Matrix(matrix);
            }
            let (_, rotation, translation) = matrix.to_scale_rotation_translation();
            let [x, y, z, w] = rotation.to_array();
            let xyzw = matches!(written, W2cOpencvXyzw | C2wOpencvXyzw);
            RawPose::Quaternion(if xyzw { [x, y, z, w] } else { [w, x, y, z] }, translation)
        };
        let by = |kind: PoseConvention| {
            let pose = |camera: &Camera| Camera {
                world_to_camera: WorldFrame::default().local_pose(&stated(camera).to_pose(kind)),
                ..camera.clone()
            };
            (kind, cameras.iter().map(pose).collect())
        };
        kinds.iter().map(|kind| by(*kind)).collect()
    }

    #[test]
    fn pose_convention_is_detected() {
        let mut rng = Rng::new(3, "convention");
        let cloud = ring::cloud(&mut rng);
        // As if hand-held: cameras do not look exactly at the centre.
        let mut cameras = ring::cameras(12);
        for camera in &mut cameras {
            let [x, y, z] = [(); 3].map(|()| rng.range(-0.1, 0.1));
            camera.world_to_camera = glam::Mat4::from_rotation_translation(
                Quat::from_euler(glam::EulerRot::XYZ, x, y, z),
                [x, z, y].into(),
            ) * camera.world_to_camera;
        }
        let keypoints: Vec<Keypoints> = cameras
            .iter()
            .map(|c| {
                ring::key_points(c, &cloud, || {
                    Vec2::new(rng.range(-0.5, 0.5), rng.range(-0.5, 0.5))
                })
            })
            .collect();
        let matches = sample(&keypoints);
        assert!(
            matches.len() > 10 && matches[0].pairs.len() > 250,
            "{}",
            matches.len()
        );
        for kinds in [PoseConvention::OF_MATRICES, PoseConvention::OF_QUATERNIONS] {
            for written in kinds {
                let candidates = read(&cameras, written, &kinds);
                match judge(&candidates, &keypoints, &matches) {
                    Verdict::Standard => assert_eq!(written, kinds[0]),
                    Verdict::Other(found, [share, usual]) => assert!(
                        found == written && share > 0.95 && usual < 0.6,
                        "{share} {usual}"
                    ),
                    Verdict::Unclear(among) => panic!("{written:?}: {among:?}"),
                }
            }
        }
        // Poses that are wrong in every convention are kept in the standard one.
        let wrong: Vec<Camera> = cameras
            .iter()
            .rev()
            .zip(&cameras)
            .map(|(pose, c)| Camera {
                name: c.name.clone(),
                ..pose.clone()
            })
            .collect();
        let kinds = PoseConvention::OF_MATRICES;
        assert_eq!(
            judge(&read(&wrong, kinds[0], &kinds), &keypoints, &matches),
            Verdict::Standard
        );
        // A camera that only rotates gives no evidence about the convention.
        let turning: Vec<Camera> = cameras
            .iter()
            .map(|c| Camera {
                world_to_camera: glam::Mat4::from_mat3(glam::Mat3::from_mat4(c.world_to_camera)),
                ..c.clone()
            })
            .collect();
        assert_eq!(
            judge(&read(&turning, kinds[0], &kinds), &keypoints, &matches),
            Verdict::Standard
        );
    }
}
