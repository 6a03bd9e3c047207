//! Checks poses against the photos and repairs them.
//!
//! Repeated texture can mislead structure from motion. The photos then form groups: each group is
//! consistent, but misplaced relative to the others. Between consecutive photos of two such groups
//! many key points match, but few matches satisfy the epipolar geometry of the poses. `repair`
//! moves such a group by the similarity that aligns its matched points.

mod fit;
mod links;

use crate::keypoints::Keypoints;
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use fit::{fit, pairs_between, points_of, refined};
use glam::Vec3;
use links::{Link, MIN_LINK_MATCHES, SAME_DIRECTION, WINDOW, groups, inliers, links, matched};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// Result of `repair`.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct PoseCheckReport {
    /// Indices of the photos whose cameras were moved.
    pub moved: Vec<usize>,
    /// Indices of the photos whose poses contradict the others and could not be repaired.
    pub contradictory: Vec<usize>,
}

/// Stride over the other photos when a group is linked to all of them.
const EVERYWHERE_STRIDE: usize = 2;
/// Smallest group, in photos, that other groups may be fitted to in the last attempt. A single
/// photo does not determine scale.
const MIN_REFERENCE_PHOTOS: usize = 3;
/// Smallest share of a group's matches with other groups that must be epipolar inliers. Repeated
/// texture alone reaches about 0.1.
const MIN_GROUP_INLIER_SHARE: f32 = 0.3;

/// Moves groups of cameras that are misplaced, and returns the moved and the contradictory photos.
///
/// First, each group is fitted to the groups placed before it. The links come from the order of the
/// photos and from their poses. Then each moved or unplaced group is fitted to all settled groups,
/// with additional links to all parts of the scene.
pub fn repair(cameras: &mut [Camera], keypoints: &[Keypoints], seed: u64) -> PoseCheckReport {
    let links = links(cameras, keypoints);
    let group = groups(cameras.len(), &links);
    let sizes = group
        .iter()
        .fold(BTreeMap::<usize, usize>::new(), |mut sizes, g| {
            *sizes.entry(*g).or_default() += 1;
            sizes
        });
    let Some(base) = sizes
        .iter()
        .max_by(|a, b| a.1.cmp(b.1).then(b.0.cmp(a.0)))
        .map(|s| *s.0)
    else {
        return PoseCheckReport::default();
    };
    let points = points_of(cameras, keypoints, &links, &group);
    let before = cameras.to_vec();
    let mut work = Repair {
        cameras,
        keypoints,
        links,
        group,
        points,
        seed,
    };
    let (mut settled, mut failed) = (BTreeSet::from([base]), BTreeSet::new());
    while let Some((next, agreed)) = next_group(&work.links, &work.group, &settled, &failed) {
        if agreed || work.place(next, &settled, true) {
            settled.insert(next);
            // A group that failed may now have links to a settled group.
            failed.clear();
        } else {
            failed.insert(next);
        }
    }
    if work
        .cameras
        .iter()
        .zip(&before)
        .all(|(now, then)| now == then)
        && failed.is_empty()
    {
        return PoseCheckReport::default();
    }
    let moved: BTreeSet<usize> = (0..before.len())
        .filter(|&i| work.cameras[i] != before[i])
        .map(|i| work.group[i])
        .collect();
    let mut again: Vec<(bool, usize)> = failed
        .iter()
        .map(|g| (true, *g))
        .chain(moved.into_iter().map(|g| (false, g)))
        .collect();
    again.sort_by_key(|&(lost, g)| (!lost, std::cmp::Reverse(sizes[&g]), g));
    for (lost, next) in again {
        work.link_to_all_photos(next);
        let others = settled.iter().copied().filter(|g| *g != next).collect();
        if work.place(next, &others, lost) {
            settled.insert(next);
        }
    }
    // Only the worst group is rejected in each round: its matches may lower the share of the
    // others.
    let mut bad = BTreeSet::new();
    loop {
        let good: BTreeSet<usize> = sizes.keys().copied().filter(|g| !bad.contains(g)).collect();
        let shares = good
            .iter()
            .filter(|g| **g != base)
            .map(|&g| (g, work.inlier_share(g, &good)));
        match shares.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0))) {
            Some((g, share)) if share < MIN_GROUP_INLIER_SHARE => bad.insert(g),
            _ => break,
        };
    }
    // A rejected group is fitted once more, to the remaining groups only.
    for &next in &bad.clone() {
        let good: BTreeSet<usize> = sizes
            .keys()
            .copied()
            .filter(|g| !bad.contains(g) && sizes[g] >= MIN_REFERENCE_PHOTOS)
            .collect();
        if work.place(next, &good, true) && work.inlier_share(next, &good) >= MIN_GROUP_INLIER_SHARE
        {
            bad.remove(&next);
        }
    }
    PoseCheckReport {
        moved: (0..before.len())
            .filter(|&i| work.cameras[i] != before[i] && !bad.contains(&work.group[i]))
            .collect(),
        contradictory: (0..before.len())
            .filter(|&i| bad.contains(&work.group[i]))
            .collect(),
    }
}

/// State of a repair.
struct Repair<'a> {
    cameras: &'a mut [Camera],
    keypoints: &'a [Keypoints],
    links: Vec<Link>,
    group: Vec<usize>,
    /// World position of key point k of view v, by (v, k).
    points: HashMap<(usize, usize), Vec3>,
    seed: u64,
}

impl Repair<'_> {
    /// Returns whether a link joins group `next` and one of `others`.
    fn joins(&self, link: &Link, next: usize, others: &BTreeSet<usize>) -> bool {
        let (a, b) = (self.group[link.a], self.group[link.b]);
        a != b && (a == next && others.contains(&b) || b == next && others.contains(&a))
    }

    /// Returns the share of epipolar inliers among the matches between a group and `others`. It is
    /// 1 if there are no matches.
    fn inlier_share(&self, next: usize, others: &BTreeSet<usize>) -> f32 {
        let counts = |l: &&Link| {
            l.all.len() >= MIN_LINK_MATCHES && self.joins(l, next, others) && self.same_direction(l)
        };
        let (right, all) = self
            .links
            .iter()
            .filter(counts)
            .fold((0, 0), |(r, a), l| (r + l.inliers.len(), a + l.all.len()));
        tracing::debug!(
            group = next,
            right,
            all,
            "epipolar inliers between groups after the repair"
        );
        if all > 0 {
            right as f32 / all as f32
        } else {
            1.0
        }
    }

    /// Returns whether both photos of a link look in a similar direction, by their current poses.
    /// Matches of other pairs are often repeated texture.
    fn same_direction(&self, link: &Link) -> bool {
        self.cameras[link.a]
            .forward()
            .dot(self.cameras[link.b].forward())
            > SAME_DIRECTION
    }

    /// Moves a group so that its matches with `others` fit. Returns whether a better position was
    /// found.
    ///
    /// A `lost` group is far from its true position, so its viewing directions are unreliable. All
    /// of its links are then used, not only those between similar directions.
    fn place(&mut self, next: usize, others: &BTreeSet<usize>, lost: bool) -> bool {
        let counts = |l: &&Link| {
            l.all.len() >= MIN_LINK_MATCHES
                && self.joins(l, next, others)
                && (lost || self.same_direction(l))
        };
        let across: Vec<&Link> = self.links.iter().filter(counts).collect();
        let moves = |i: usize| self.group[i] == next;
        let pairs = pairs_between(&across, moves, self.keypoints, &self.points);
        let Some(first) = fit(&pairs, self.cameras, &mut Rng::new(self.seed, "pose check")) else {
            return false;
        };
        let similarity = refined(first, &across, moves, self.cameras, self.keypoints);
        let mut moved = self.cameras.to_vec();
        for (i, camera) in moved.iter_mut().enumerate() {
            if moves(i) {
                similarity.move_camera(camera);
            }
        }
        // Inliers of all links, and of links between consecutive photos. Repeated structures can
        // produce wrong matches between distant views.
        let obeying = |cameras: &[Camera]| {
            across.iter().fold((0, 0), |(all, near), l| {
                let count = inliers(cameras, self.keypoints, l.a, l.b, &l.all).len();
                (
                    all + count,
                    near + if l.b - l.a <= WINDOW { count } else { 0 },
                )
            })
        };
        let (before, after) = (obeying(self.cameras), obeying(&moved));
        let photos = (0..moved.len()).filter(|&i| moves(i)).count();
        tracing::debug!(
            photos,
            links = across.len(),
            pairs = pairs.len(),
            ?before,
            ?after,
            "epipolar inliers between groups before and after a move"
        );
        if after.0 <= before.0 || after.1 + MIN_LINK_MATCHES < before.1 {
            return false;
        }
        self.cameras.clone_from_slice(&moved);
        let group = &self.group;
        self.points
            .iter_mut()
            .filter(|((view, _), _)| group[*view] == next)
            .for_each(|(_, p)| *p = similarity.apply(*p));
        for link in self
            .links
            .iter_mut()
            .filter(|l| (group[l.a] == next) != (group[l.b] == next))
        {
            link.inliers = inliers(self.cameras, self.keypoints, link.a, link.b, &link.all);
        }
        true
    }

    /// Adds links between a group and every second other photo. Misplaced poses do not show which
    /// photos overlap.
    fn link_to_all_photos(&mut self, next: usize) {
        let known: BTreeSet<(usize, usize)> = self.links.iter().map(|l| (l.a, l.b)).collect();
        let (members, others): (Vec<usize>, Vec<usize>) =
            (0..self.cameras.len()).partition(|&i| self.group[i] == next);
        let others: Vec<usize> = others.into_iter().step_by(EVERYWHERE_STRIDE).collect();
        let pairs = members
            .iter()
            .flat_map(|&a| others.iter().map(move |&b| (a.min(b), a.max(b))));
        let new = pairs.filter(|p| !known.contains(p)).collect();
        let found = matched(new, self.cameras, self.keypoints);
        self.links.extend(
            found
                .into_iter()
                .filter(|l| l.all.len() >= MIN_LINK_MATCHES),
        );
    }
}

/// Returns the unsettled group with the most matches that contradict settled groups, or `None` if
/// no match does. The flag is true if the agreeing matches outnumber the contradicting ones.
fn next_group(
    links: &[Link],
    group: &[usize],
    settled: &BTreeSet<usize>,
    failed: &BTreeSet<usize>,
) -> Option<(usize, bool)> {
    let mut between: BTreeMap<usize, (usize, usize)> = BTreeMap::new();
    for link in links {
        for (inner, outer) in [
            (group[link.a], group[link.b]),
            (group[link.b], group[link.a]),
        ] {
            if settled.contains(&inner) && !settled.contains(&outer) && !failed.contains(&outer) {
                let (contra, pro) = between.entry(outer).or_default();
                *contra += if link.contradicts() {
                    link.all.len()
                } else {
                    0
                };
                *pro += if link.agrees() { link.inliers.len() } else { 0 };
            }
        }
    }
    let worst = between
        .into_iter()
        .filter(|b| b.1.0 > 0)
        .max_by(|a, b| a.1.0.cmp(&b.1.0).then(b.0.cmp(&a.0)));
    worst.map(|(next, (contra, pro))| (next, pro > contra))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ring;
    use crate::similarity::Similarity;
    use glam::{Mat3, Vec2};

    /// Cameras around a point cloud, and key points without noise.
    fn exact_ring(count: usize) -> (Vec<Camera>, Vec<Keypoints>) {
        let (cloud, cameras) = (ring::cloud(&mut Rng::new(5, "ring")), ring::cameras(count));
        let keypoints = cameras
            .iter()
            .map(|c| ring::key_points(c, &cloud, || Vec2::ZERO))
            .collect();
        (cameras, keypoints)
    }

    #[test]
    fn right_poses_stay_as_they_are() {
        let (mut cameras, keypoints) = exact_ring(16);
        let before = cameras.clone();
        assert_eq!(
            repair(&mut cameras, &keypoints, 0),
            PoseCheckReport::default()
        );
        assert_eq!(cameras, before);
    }

    #[test]
    fn a_misplaced_group_is_moved_back() {
        let (mut cameras, keypoints) = exact_ring(16);
        let truth = cameras.clone();
        let wrong = Similarity {
            scale: 1.7,
            rotation: Mat3::from_rotation_y(0.9) * Mat3::from_rotation_x(0.4),
            translation: Vec3::new(2.0, -1.0, 0.5),
        };
        cameras[11..].iter_mut().for_each(|c| wrong.move_camera(c));
        let report = repair(&mut cameras, &keypoints, 0);
        assert_eq!(
            report,
            PoseCheckReport {
                moved: (11..16).collect(),
                contradictory: Vec::new()
            }
        );
        for (found, right) in cameras.iter().zip(&truth) {
            assert!(
                found.centre().distance(right.centre()) < 0.02,
                "{}: {} {}",
                right.name,
                found.centre(),
                right.centre()
            );
            assert!(found.forward().dot(right.forward()) > 0.9999);
        }
    }

    #[test]
    fn unrepairable_photos_are_reported_as_contradictory() {
        let (mut cameras, mut keypoints) = exact_ring(16);
        let wrong = Similarity {
            scale: 1.0,
            rotation: Mat3::from_rotation_y(1.0),
            translation: Vec3::new(2.0, 0.0, 0.0),
        };
        cameras[13..].iter_mut().for_each(|c| wrong.move_camera(c));
        // Random positions: no rigid scene explains these matches.
        let mut rng = Rng::new(9, "noise");
        for k in &mut keypoints[13..] {
            k.positions
                .iter_mut()
                .for_each(|p| *p = Vec2::new(rng.range(0.0, 320.0), rng.range(0.0, 240.0)));
        }
        let report = repair(&mut cameras, &keypoints, 0);
        assert_eq!(report.moved, Vec::<usize>::new());
        assert_eq!(report.contradictory, vec![13, 14, 15]);
    }
}
