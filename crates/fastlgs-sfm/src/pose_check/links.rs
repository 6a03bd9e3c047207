//! Matches of photo pairs, tested against the epipolar geometry of their poses, and the groups of
//! photos that agree.

use crate::keypoints::Keypoints;
use crate::matching::matches;
use crate::tracks::{PairMatches, TOLERANCE, overlapping_pairs};
use fastlgs_core::Camera;
use rayon::prelude::*;

/// Number of photos before and after each photo, by name, that it is compared with.
pub(super) const WINDOW: usize = 4;
/// Number of overlapping photos, according to the poses, that each photo is compared with.
pub(super) const OVERLAPPING: usize = 6;
/// Smallest cosine between the viewing directions of an overlapping pair. At larger angles, SIFT
/// matches are mostly repeated texture.
pub(super) const SAME_DIRECTION: f32 = 0.75;
/// Smallest number of matches, or of inliers, that counts as evidence.
pub(super) const MIN_LINK_MATCHES: usize = 25;

/// All matches of two photos, as (key point in a, key point in b), and those that are epipolar
/// inliers.
pub(super) struct Link {
    pub a: usize,
    pub b: usize,
    pub all: Vec<(usize, usize)>,
    pub inliers: Vec<(usize, usize)>,
}

impl Link {
    /// Returns whether at least [`MIN_LINK_MATCHES`] matches, and at least half of them, are inliers.
    pub fn agrees(&self) -> bool {
        self.inliers.len() >= MIN_LINK_MATCHES && 2 * self.inliers.len() >= self.all.len()
    }

    /// Returns whether fewer than 30 % of at least [`MIN_LINK_MATCHES`] matches are inliers.
    pub fn contradicts(&self) -> bool {
        self.all.len() >= MIN_LINK_MATCHES && 10 * self.inliers.len() < 3 * self.all.len()
    }
}

/// Returns the matches within `TOLERANCE` pixels of their epipolar lines.
pub(super) fn inliers(
    cameras: &[Camera],
    keypoints: &[Keypoints],
    a: usize,
    b: usize,
    all: &[(usize, usize)],
) -> Vec<(usize, usize)> {
    PairMatches {
        a,
        b,
        pairs: all.to_vec(),
    }
    .inliers(cameras, keypoints, TOLERANCE)
    .pairs
}

/// Matches all pairs of photos that are near by name, or that overlap by their poses.
pub(super) fn links(cameras: &[Camera], keypoints: &[Keypoints]) -> Vec<Link> {
    let n = cameras.len();
    let mut pairs = overlapping_pairs(cameras, OVERLAPPING);
    pairs.retain(|&(a, b)| cameras[a].forward().dot(cameras[b].forward()) > SAME_DIRECTION);
    pairs.extend((0..n).flat_map(|a| (a + 1..n.min(a + 1 + WINDOW)).map(move |b| (a, b))));
    pairs.sort_unstable();
    pairs.dedup();
    matched(pairs, cameras, keypoints)
}

/// Matches these pairs of photos.
pub(super) fn matched(
    pairs: Vec<(usize, usize)>,
    cameras: &[Camera],
    keypoints: &[Keypoints],
) -> Vec<Link> {
    let link = |(a, b): (usize, usize)| {
        let all = matches(&keypoints[a], &keypoints[b]);
        let right = inliers(cameras, keypoints, a, b, &all);
        Link {
            a,
            b,
            all,
            inliers: right,
        }
    };
    pairs.into_par_iter().map(link).collect()
}

/// Returns the group of each photo. Agreeing links join groups in descending order of inliers. Two
/// groups are not joined if as many links between them contradict as agree.
pub(super) fn groups(n: usize, links: &[Link]) -> Vec<usize> {
    let mut group: Vec<usize> = (0..n).collect();
    let mut agreeing: Vec<&Link> = links.iter().filter(|l| l.agrees()).collect();
    agreeing.sort_by_key(|l| (std::cmp::Reverse(l.inliers.len()), l.a, l.b));
    for link in agreeing {
        let (a, b) = (group[link.a], group[link.b]);
        if a == b {
            continue;
        }
        let across =
            |l: &&Link| (group[l.a], group[l.b]) == (a, b) || (group[l.a], group[l.b]) == (b, a);
        let (mut pro, mut contra) = (0, 0);
        for l in links.iter().filter(across) {
            pro += usize::from(l.agrees());
            contra += usize::from(l.contradicts());
        }
        if pro > contra {
            group.iter_mut().filter(|g| **g == b).for_each(|g| *g = a);
        }
    }
    group
}
