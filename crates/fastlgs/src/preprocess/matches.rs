//! Matches key points of overlapping photos, and counts the matches between their masks.

use super::photos::PreparedPhoto;
use crate::cache::{self, Cache};
use crate::{Error, Result, Run, masks};
use fastlgs_core::{Camera, SceneFolder};
use fastlgs_grid::mask_pairs::Pairs;
use fastlgs_sfm::keypoints::{self, Keypoints};
use fastlgs_sfm::matching;
use fastlgs_sfm::tracks::{self, PairMatches};
use glam::Vec2;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Matches each photo with the `neighbours` photos that overlap it most by their poses. Photos in
/// `lost` have wrong poses and are matched with all others. Matches that contradict the poses are
/// kept.
pub(super) fn match_photos(
    photos: &[PreparedPhoto],
    lost: &[usize],
    neighbours: usize,
    cache: &Cache,
    run: &Run,
) -> Result<Vec<PairMatches>> {
    let cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let mut chosen: BTreeSet<(usize, usize)> = tracks::overlapping_pairs(&cameras, neighbours)
        .into_iter()
        .collect();
    for &photo in lost {
        chosen.extend(
            (0..photos.len())
                .filter(|other| *other != photo)
                .map(|other| (photo.min(other), photo.max(other))),
        );
    }
    let work = run.work("matches", chosen.len() as u64);
    let match_pair = |(a, b): (usize, usize)| {
        let pairs = cached_matches(photos, a, b, cache)?;
        work.advance()?;
        Ok::<_, Error>(PairMatches { a, b, pairs })
    };
    let chosen: Vec<(usize, usize)> = chosen.into_iter().collect();
    chosen.into_par_iter().map(match_pair).collect()
}

/// Returns the matches of photos `a` and `b` as pairs of key point indices. They are cached.
pub(super) fn cached_matches(
    photos: &[PreparedPhoto],
    a: usize,
    b: usize,
    cache: &Cache,
) -> Result<Vec<(usize, usize)>> {
    let inputs = [
        &photos[a].key,
        &photos[b].key,
        keypoints::version().as_bytes(),
    ];
    cache.get("matches", &cache::key(&inputs), || {
        Ok(matching::matches(&photos[a].points, &photos[b].points))
    })
}

/// Returns the matches between the photos in `kept` that agree with the poses. Photos are
/// renumbered by their position in `kept`.
pub(super) fn consistent_matches(
    kept: &[usize],
    matches: &[PairMatches],
    cameras: &[Camera],
    points: &[Keypoints],
) -> Vec<PairMatches> {
    let new_index: BTreeMap<usize, usize> = kept
        .iter()
        .enumerate()
        .map(|(new, old)| (*old, new))
        .collect();
    let renumbered = |m: &PairMatches| {
        Some(PairMatches {
            a: *new_index.get(&m.a)?,
            b: *new_index.get(&m.b)?,
            pairs: m.pairs.clone(),
        })
    };
    let obeying = |m: PairMatches| m.inliers(cameras, points, tracks::TOLERANCE);
    matches.iter().filter_map(renumbered).map(obeying).collect()
}

/// Matches the same pairs of photos again along the epipolar lines of their poses. The result is
/// used for points and masks. It cannot verify poses, because every match on an epipolar line
/// agrees with them.
pub(super) fn match_along_epipolar_lines(
    matches: &[PairMatches],
    cameras: &[Camera],
    points: &[Keypoints],
) -> Vec<PairMatches> {
    let match_pair = |m: &PairMatches| {
        let f = keypoints::fundamental(&cameras[m.a], &cameras[m.b]);
        PairMatches {
            pairs: matching::guided(&points[m.a], &points[m.b], &f, tracks::TOLERANCE),
            ..*m
        }
    };
    matches.par_iter().map(match_pair).collect()
}

/// A photo is isolated if it has fewer matches than this with every other photo.
const MIN_NEIGHBOUR_MATCHES: usize = 15;

/// Returns a warning if photos overlap with no other photo, else `None`. It names the isolated
/// photo with the largest angle to its nearest photo.
pub(super) fn gap_warning(cameras: &[Camera], matches: &[PairMatches]) -> Option<String> {
    let mut most = vec![0; cameras.len()];
    for m in matches {
        [m.a, m.b]
            .into_iter()
            .for_each(|photo| most[photo] = most[photo].max(m.pairs.len()));
    }
    let isolated: Vec<usize> = (0..cameras.len())
        .filter(|&photo| most[photo] < MIN_NEIGHBOUR_MATCHES)
        .collect();
    let angle_between = |a: usize, b: usize| {
        cameras[a]
            .forward()
            .angle_between(cameras[b].forward())
            .to_degrees()
    };
    let gap = |&photo: &usize| {
        let others = (0..cameras.len()).filter(|other| *other != photo);
        let nearest =
            others.min_by(|a, b| angle_between(photo, *a).total_cmp(&angle_between(photo, *b)))?;
        Some((photo, nearest, angle_between(photo, nearest)))
    };
    let (photo, nearest, degrees) = isolated
        .iter()
        .filter_map(gap)
        .max_by(|a, b| a.2.total_cmp(&b.2))?;
    Some(format!(
        "{} of {} photos overlap too little with any other to reconstruct shapes; the largest gap is {degrees:.0} degrees, from {} to {}: \
         take photos between them",
        isolated.len(),
        cameras.len(),
        cameras[photo].name,
        cameras[nearest].name
    ))
}

/// Counts the key point matches between the masks of matched photos (level whole).
pub(super) fn count_mask_pairs(
    folder: &SceneFolder,
    cameras: &[Camera],
    points: &[Keypoints],
    matches: &[PairMatches],
) -> Result<Pairs> {
    let of_view = |(view, camera): (usize, &Camera)| -> Result<Vec<u16>> {
        let map = masks::whole_masks(folder, camera)?;
        // Removing distortion can move key points beyond the edges of the photo.
        let inside = |p: &Vec2| {
            p.x >= 0.0 && p.y >= 0.0 && p.x < map.width as f32 && p.y < map.height as f32
        };
        let label = |p: &Vec2| {
            if inside(p) {
                map.at(p.x as u32, p.y as u32)
            } else {
                0
            }
        };
        Ok(points[view].positions.iter().map(label).collect())
    };
    let label_at: Vec<Vec<u16>> = cameras
        .iter()
        .enumerate()
        .map(of_view)
        .collect::<Result<_>>()?;
    let mut out = Pairs::new();
    for m in matches {
        for &(i, j) in &m.pairs {
            let (a, b) = (label_at[m.a][i], label_at[m.b][j]);
            if a > 0 && b > 0 {
                *out.entry([(m.b, b), (m.a, a)]).or_default() += 1;
            }
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn the_largest_gap_is_named() {
        let eye = |degrees: f32| {
            4.0 * Vec3::new(degrees.to_radians().sin(), 0.0, -degrees.to_radians().cos())
        };
        let camera = |degrees: f32| {
            Camera::look_at(
                &format!("{degrees}.png"),
                eye(degrees),
                Vec3::ZERO,
                Vec3::Y,
                64,
                48,
                0.9,
            )
        };
        let cameras = [camera(0.0), camera(10.0), camera(60.0)];
        let shared = |a, b, count| PairMatches {
            a,
            b,
            pairs: vec![(0, 0); count],
        };
        let warning = gap_warning(&cameras, &[shared(0, 1, 80), shared(1, 2, 4)]).unwrap();
        assert!(
            warning.starts_with("1 of 3 photos")
                && warning.contains("50 degrees, from 60.png to 10.png"),
            "{warning}"
        );
        assert_eq!(
            gap_warning(&cameras, &[shared(0, 1, 80), shared(1, 2, 40)]),
            None
        );
    }
}
