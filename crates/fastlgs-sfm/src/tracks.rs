//! Builds tracks: merges the matches of photo pairs into all key points that show one point of the
//! scene.

use crate::keypoints::{Keypoints, epipolar_error, fundamental};
use crate::triangulate::{Located, locate};
use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::Vec3;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A matched pair of photos.
#[derive(Clone, Debug)]
pub struct PairMatches {
    /// Index of the earlier photo.
    pub a: usize,
    /// Index of the later photo.
    pub b: usize,
    /// (key point in a, key point in b).
    pub pairs: Vec<(usize, usize)>,
}

/// Inlier threshold in pixels, for the epipolar error of a match and for the reprojection error of
/// a key point.
pub const TOLERANCE: f32 = 2.0;

/// Returns the pairs of each photo with the `count` others that overlap it most, by position and
/// viewing direction. Pairs are (a, b) with a < b, sorted.
pub fn overlapping_pairs(cameras: &[Camera], count: usize) -> Vec<(usize, usize)> {
    let span = fastlgs_core::camera::scene_extent(cameras);
    let mut pairs = std::collections::BTreeSet::new();
    for (i, a) in cameras.iter().enumerate() {
        let cost = |b: &Camera| {
            a.centre().distance(b.centre()) / span + 2.0 * (1.0 - a.forward().dot(b.forward()))
        };
        let overlaps =
            |j: usize| count >= cameras.len() || a.forward().dot(cameras[j].forward()) > 0.3;
        let mut others: Vec<usize> = (0..cameras.len())
            .filter(|&j| j != i && overlaps(j))
            .collect();
        others.sort_by(|&x, &y| {
            cost(&cameras[x])
                .total_cmp(&cost(&cameras[y]))
                .then(x.cmp(&y))
        });
        pairs.extend(others.into_iter().take(count).map(|j| (i.min(j), i.max(j))));
    }
    pairs.into_iter().collect()
}

impl PairMatches {
    /// Returns the inliers: matches whose epipolar error by the poses is below `tolerance` pixels.
    pub fn inliers(&self, cameras: &[Camera], keypoints: &[Keypoints], tolerance: f32) -> Self {
        let f = fundamental(&cameras[self.a], &cameras[self.b]);
        let error = |i: usize, j: usize| {
            epipolar_error(
                &f,
                keypoints[self.a].positions[i],
                keypoints[self.b].positions[j],
            )
        };
        let pairs = self
            .pairs
            .iter()
            .filter(|(i, j)| error(*i, *j) < tolerance)
            .copied()
            .collect();
        Self { pairs, ..*self }
    }
}

/// A point of the scene and the key points that show it.
#[derive(Clone, Debug)]
pub struct Track {
    /// (photo, key point), at most one per photo.
    pub key_points: Vec<(usize, usize)>,
    /// World position.
    pub position: Vec3,
    /// Root mean square of the reprojection errors, in pixels.
    pub error: f32,
}

/// Groups key points that are connected by matches. Earlier matches take precedence. A match that
/// would put two key points of one photo into a group is left out.
fn merged(matches: &[PairMatches]) -> Vec<Vec<(usize, usize)>> {
    let mut group: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    let mut members: Vec<Vec<(usize, usize)>> = Vec::new();
    for m in matches {
        for &(i, j) in &m.pairs {
            let [a, b] = [(m.a, i), (m.b, j)].map(|point| {
                *group.entry(point).or_insert_with(|| {
                    members.push(vec![point]);
                    members.len() - 1
                })
            });
            let (from, to) = if members[a].len() < members[b].len() {
                (a, b)
            } else {
                (b, a)
            };
            let clash = members[from]
                .iter()
                .any(|(photo, _)| members[to].iter().any(|(other, _)| other == photo));
            if a != b && !clash {
                let moved = std::mem::take(&mut members[from]);
                moved.iter().for_each(|point| {
                    *group.get_mut(point).expect("every member has a group") = to
                });
                members[to].extend(moved);
            }
        }
    }
    members.retain(|track| track.len() >= 2);
    members.iter_mut().for_each(|track| track.sort_unstable());
    members
}

/// Triangulates tracks from matches. Key points with a reprojection error of `tolerance` pixels or
/// more are left out. Tracks with fewer than two remaining key points are omitted.
pub fn tracks(
    cameras: &[Camera],
    keypoints: &[Keypoints],
    matches: &[PairMatches],
    tolerance: f32,
) -> Vec<Track> {
    let located = |seen: Vec<(usize, usize)>| {
        let views: Vec<_> = seen
            .iter()
            .map(|&(photo, k)| (&cameras[photo], keypoints[photo].positions[k]))
            .collect();
        let Located {
            position,
            error,
            agreeing,
        } = locate(&views, tolerance)?;
        Some(Track {
            key_points: agreeing.into_iter().map(|k| seen[k]).collect(),
            position,
            error,
        })
    };
    merged(matches)
        .into_par_iter()
        .filter_map(located)
        .collect()
}

/// Returns one point per track, with the mean colour of its key points. `colors` holds the colours
/// of each photo's key points.
pub fn points(tracks: &[Track], colors: &[Vec<[u8; 3]>]) -> Vec<SfmPoint> {
    let color = |track: &Track| {
        let sum = track.key_points.iter().fold([0u32; 3], |sum, &(photo, k)| {
            std::array::from_fn(|c| sum[c] + u32::from(colors[photo][k][c]))
        });
        sum.map(|s| (s / track.key_points.len() as u32) as u8)
    };
    let seen_by = |track: &Track| {
        track
            .key_points
            .iter()
            .map(|(photo, _)| *photo as u32)
            .collect()
    };
    tracks
        .iter()
        .map(|track| SfmPoint {
            position: track.position,
            color: color(track),
            seen_by: seen_by(track),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_track_has_each_photo_once() {
        let pair = |a, b, pairs: &[(usize, usize)]| PairMatches {
            a,
            b,
            pairs: pairs.to_vec(),
        };
        // Key point 0 of all photos is one point. Key point 7 of photo 2 also matches it, through
        // photo 1.
        let matches = [
            pair(0, 1, &[(0, 0), (5, 5)]),
            pair(0, 2, &[(0, 0)]),
            pair(1, 2, &[(0, 7), (5, 6)]),
        ];
        assert_eq!(
            merged(&matches),
            [vec![(0, 0), (1, 0), (2, 0)], vec![(0, 5), (1, 5), (2, 6)]]
        );
    }

    #[test]
    fn points_list_the_photos_of_their_track() {
        let track = Track {
            key_points: vec![(1, 0), (3, 1)],
            position: Vec3::ONE,
            error: 0.1,
        };
        let colors = [vec![], vec![[10; 3]], vec![], vec![[0; 3], [20; 3]]];
        assert_eq!(
            points(&[track], &colors),
            [SfmPoint {
                position: Vec3::ONE,
                color: [15; 3],
                seen_by: vec![1, 3]
            }]
        );
    }

    #[test]
    fn the_nearest_photos_are_compared() {
        let at = |x: f32| {
            Camera::look_at(
                "a",
                Vec3::new(x, 0.0, 3.0),
                Vec3::ZERO,
                Vec3::Y,
                320,
                240,
                0.8,
            )
        };
        let pairs = overlapping_pairs(&[at(3.0), at(0.0), at(3.0)], 1);
        assert!(
            pairs.contains(&(0, 2)),
            "the twin camera is the nearest: {pairs:?}"
        );
    }
}
