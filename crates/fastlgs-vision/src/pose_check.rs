//! Do the poses agree with the photos? Structure from motion that was misled by repeated texture leaves groups of photos
//! that are each consistent, but wrongly placed towards each other. Photos that follow each other show it: many key
//! points match, and hardly any obeys the epipolar geometry of the poses. Such groups are moved back by the similarity
//! that brings their matched points together.

use crate::keypoints::{Keypoints, epipolar_residual, fundamental};
use crate::matching::matches;
use crate::triangulate::{epipolar_filter, intersect, overlapping_pairs};
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use glam::{DMat3, DVec3, Mat3, Mat4, Vec3};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// What was found and done.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Report {
    /// Photos whose cameras were moved.
    pub moved: Vec<usize>,
    /// Photos whose poses contradict those of the others and could not be mended.
    pub contradictory: Vec<usize>,
}

/// Photos before and after (by name) that each is compared with.
const WINDOW: usize = 4;
/// Photos that look at the same by their poses, each is compared with.
const OVERLAPPING: usize = 6;
/// When looking everywhere, each how-manieth of the other photos a photo is compared with.
const EVERYWHERE_STRIDE: usize = 2;
/// Least cosine between viewing directions: beyond, SIFT matches are mostly repeated texture.
const SAME_DIRECTION: f32 = 0.75;
/// Photos of a group by which others are placed: one photo says nothing about scale.
const SOLID: usize = 3;
/// Fewest matches that say something.
const FEW: usize = 25;
/// Trials of the robust fit.
const TRIALS: usize = 2000;
/// Smallest share of matches with other groups that obey the poses of a group in its place: repeated texture alone gives
/// about a tenth.
const MIN_OBEYING: f32 = 0.3;
/// Largest reprojection error of a point that supports a fit, as a share of the photo's width.
const MAX_ERROR: f32 = 0.02;

/// Smallest share of supporting pairs. Points of wrong matches support a wrong fit only by chance, one in a thousand.
const MIN_SUPPORT: f32 = 0.12;
/// Least parallax of a point that a fit uses, in radians: beyond, its depth is noise.
const MIN_PARALLAX: f32 = 0.03;

/// Two photos' matches, and those that obey the poses.
struct Link {
    a: usize,
    b: usize,
    all: Vec<(usize, usize)>,
    right: Vec<(usize, usize)>,
}

impl Link {
    fn agrees(&self) -> bool {
        self.right.len() >= FEW && 2 * self.right.len() >= self.all.len()
    }

    fn contradicts(&self) -> bool {
        self.all.len() >= FEW && 10 * self.right.len() < 3 * self.all.len()
    }
}

/// x -> scale rotation x + translation.
#[derive(Clone, Copy, Debug)]
struct Similarity {
    scale: f32,
    rotation: Mat3,
    translation: Vec3,
}

impl Similarity {
    fn apply(&self, p: Vec3) -> Vec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// A small change after this one: log scale, rotation vector, translation.
    fn nudged(&self, delta: &[f32; 7]) -> Self {
        let turn = Mat3::from_quat(glam::Quat::from_scaled_axis(Vec3::new(delta[1], delta[2], delta[3])));
        let grow = delta[0].exp();
        Self {
            scale: grow * self.scale,
            rotation: turn * self.rotation,
            translation: grow * (turn * self.translation) + Vec3::new(delta[4], delta[5], delta[6]),
        }
    }

    /// Moves a camera along with the world it sees; its own unit of length grows by the scale.
    fn move_camera(&self, camera: &mut Camera) {
        let (rotation, t) = (Mat3::from_mat4(camera.world_to_camera), camera.world_to_camera.w_axis.truncate());
        let turned = rotation * self.rotation.transpose();
        let mut moved = Mat4::from_mat3(turned);
        moved.w_axis = (self.scale * t - turned * self.translation).extend(1.0);
        camera.world_to_camera = moved;
    }
}

/// A point of the group to move, where it belongs, and the key point there.
#[derive(Clone, Copy)]
struct Pair {
    from: Vec3,
    to: Vec3,
    view: usize,
    pixel: glam::Vec2,
}

/// Compares poses and photos, moves groups of cameras that are misplaced, and says what it did.
///
/// First each group is fitted to those placed before it, by the links that the photos' order and the poses suggest. Once
/// they are near their places, each is fitted again to all others, over links that are looked for everywhere.
pub fn repair(cameras: &mut [Camera], keypoints: &[Keypoints], seed: u64) -> Report {
    let links = links(cameras, keypoints);
    let group = groups(cameras.len(), &links);
    let sizes = group.iter().fold(BTreeMap::<usize, usize>::new(), |mut sizes, g| {
        *sizes.entry(*g).or_default() += 1;
        sizes
    });
    let Some(base) = sizes.iter().max_by(|a, b| a.1.cmp(b.1).then(b.0.cmp(a.0))).map(|s| *s.0) else { return Report::default() };
    let points = points_of(cameras, keypoints, &links, &group);
    let before = cameras.to_vec();
    let mut work = Work { cameras, keypoints, links, group, points, seed };
    let (mut settled, mut failed) = (BTreeSet::from([base]), BTreeSet::new());
    while let Some((next, agreed)) = next_group(&work.links, &work.group, &settled, &failed) {
        if agreed || work.place(next, &settled, true) {
            settled.insert(next);
            // What was out of reach may now be in reach.
            failed.clear();
        } else {
            failed.insert(next);
        }
    }
    if work.cameras.iter().zip(&before).all(|(now, then)| now == then) && failed.is_empty() {
        return Report::default();
    }
    let moved: BTreeSet<usize> = (0..before.len()).filter(|&i| work.cameras[i] != before[i]).map(|i| work.group[i]).collect();
    let mut again: Vec<(bool, usize)> = failed.iter().map(|g| (true, *g)).chain(moved.into_iter().map(|g| (false, g))).collect();
    again.sort_by_key(|&(lost, g)| (!lost, std::cmp::Reverse(sizes[&g]), g));
    for (lost, next) in again {
        work.look_everywhere(next);
        let others = settled.iter().copied().filter(|g| *g != next).collect();
        if work.place(next, &others, lost) {
            settled.insert(next);
        }
    }
    // The group that fits worst goes first: it may be what speaks against the others.
    let mut bad = BTreeSet::new();
    loop {
        let good: BTreeSet<usize> = sizes.keys().copied().filter(|g| !bad.contains(g)).collect();
        let shares = good.iter().filter(|g| **g != base).map(|&g| (g, work.obeying_share(g, &good)));
        match shares.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0))) {
            Some((g, share)) if share < MIN_OBEYING => bad.insert(g),
            _ => break,
        };
    }
    // With only good neighbours left, a bad group may find its place after all.
    for &next in &bad.clone() {
        let good: BTreeSet<usize> = sizes.keys().copied().filter(|g| !bad.contains(g) && sizes[g] >= SOLID).collect();
        if work.place(next, &good, true) && work.obeying_share(next, &good) >= MIN_OBEYING {
            bad.remove(&next);
        }
    }
    Report {
        moved: (0..before.len()).filter(|&i| work.cameras[i] != before[i] && !bad.contains(&work.group[i])).collect(),
        contradictory: (0..before.len()).filter(|&i| bad.contains(&work.group[i])).collect(),
    }
}

/// The state of a repair.
struct Work<'a> {
    cameras: &'a mut [Camera],
    keypoints: &'a [Keypoints],
    links: Vec<Link>,
    group: Vec<usize>,
    /// Where key point k of view v lies, by (v, k).
    points: HashMap<(usize, usize), Vec3>,
    seed: u64,
}

impl Work<'_> {
    /// Whether a link joins group `next` and one of `others`.
    fn joins(&self, link: &Link, next: usize, others: &BTreeSet<usize>) -> bool {
        let (a, b) = (self.group[link.a], self.group[link.b]);
        a != b && (a == next && others.contains(&b) || b == next && others.contains(&a))
    }

    /// Share of the matches between a group and others that obey the poses; 1 where there are none.
    fn obeying_share(&self, next: usize, others: &BTreeSet<usize>) -> f32 {
        let counts = |l: &&Link| l.all.len() >= FEW && self.joins(l, next, others) && self.same_direction(l);
        let (right, all) = self.links.iter().filter(counts).fold((0, 0), |(r, a), l| (r + l.right.len(), a + l.all.len()));
        tracing::debug!(group = next, right, all, "matches that obey the poses in the end");
        if all > 0 { right as f32 / all as f32 } else { 1.0 }
    }

    /// Whether the photos of a link look the same way by their poses as they are now: other matches are often repeated
    /// texture.
    fn same_direction(&self, link: &Link) -> bool {
        self.cameras[link.a].forward().dot(self.cameras[link.b].forward()) > SAME_DIRECTION
    }

    /// Moves a group to where its matches with `others` fit; false where no place fits better than its own. A group that
    /// is `lost` is far from its place: its links count whatever their directions are now.
    fn place(&mut self, next: usize, others: &BTreeSet<usize>, lost: bool) -> bool {
        let counts = |l: &&Link| l.all.len() >= FEW && self.joins(l, next, others) && (lost || self.same_direction(l));
        let across: Vec<&Link> = self.links.iter().filter(counts).collect();
        let moves = |i: usize| self.group[i] == next;
        let pairs = pairs_between(&across, moves, self.keypoints, &self.points);
        let Some(first) = fit(&pairs, self.cameras, &mut Rng::new(self.seed, "pose check")) else { return false };
        let similarity = refined(first, &across, moves, self.cameras, self.keypoints);
        let moved: Vec<Camera> = (self.cameras.iter().enumerate())
            .map(|(i, c)| {
                let mut camera = c.clone();
                if moves(i) {
                    similarity.move_camera(&mut camera);
                }
                camera
            })
            .collect();
        // Over all links, and over those of photos that follow each other: what repeats in a scene fools distant views.
        let obeying = |cameras: &[Camera]| {
            across.iter().fold((0, 0), |(all, near), l| {
                let count = right(cameras, self.keypoints, l.a, l.b, &l.all).len();
                (all + count, near + if l.b - l.a <= WINDOW { count } else { 0 })
            })
        };
        let (before, after) = (obeying(self.cameras), obeying(&moved));
        let photos = (0..moved.len()).filter(|&i| moves(i)).count();
        tracing::debug!(photos, links = across.len(), pairs = pairs.len(), ?before, ?after, "matches across that obey the poses");
        if after.0 <= before.0 || after.1 + FEW < before.1 {
            return false;
        }
        self.cameras.clone_from_slice(&moved);
        let group = &self.group;
        self.points.iter_mut().filter(|((view, _), _)| group[*view] == next).for_each(|(_, p)| *p = similarity.apply(*p));
        for link in self.links.iter_mut().filter(|l| (group[l.a] == next) != (group[l.b] == next)) {
            link.right = right(self.cameras, self.keypoints, link.a, link.b, &link.all);
        }
        true
    }

    /// Adds links between a group and a part of all other photos: misplaced poses do not tell which see the same.
    fn look_everywhere(&mut self, next: usize) {
        let known: BTreeSet<(usize, usize)> = self.links.iter().map(|l| (l.a, l.b)).collect();
        let (members, others): (Vec<usize>, Vec<usize>) = (0..self.cameras.len()).partition(|&i| self.group[i] == next);
        let others: Vec<usize> = others.into_iter().step_by(EVERYWHERE_STRIDE).collect();
        let pairs = members.iter().flat_map(|&a| others.iter().map(move |&b| (a.min(b), a.max(b))));
        let new = pairs.filter(|p| !known.contains(p)).collect();
        let found = matched(new, self.cameras, self.keypoints);
        self.links.extend(found.into_iter().filter(|l| l.all.len() >= FEW));
    }
}

/// The matches that obey the poses.
fn right(cameras: &[Camera], keypoints: &[Keypoints], a: usize, b: usize, all: &[(usize, usize)]) -> Vec<(usize, usize)> {
    epipolar_filter((&cameras[a], &keypoints[a]), (&cameras[b], &keypoints[b]), all)
}

/// The group with the most matches that contradict what is settled, and whether it agrees with it all the same.
fn next_group(links: &[Link], group: &[usize], settled: &BTreeSet<usize>, failed: &BTreeSet<usize>) -> Option<(usize, bool)> {
    let mut between: BTreeMap<usize, (usize, usize)> = BTreeMap::new();
    for link in links {
        for (inner, outer) in [(group[link.a], group[link.b]), (group[link.b], group[link.a])] {
            if settled.contains(&inner) && !settled.contains(&outer) && !failed.contains(&outer) {
                let (contra, pro) = between.entry(outer).or_default();
                *contra += if link.contradicts() { link.all.len() } else { 0 };
                *pro += if link.agrees() { link.right.len() } else { 0 };
            }
        }
    }
    let worst = between.into_iter().filter(|b| b.1.0 > 0).max_by(|a, b| a.1.0.cmp(&b.1.0).then(b.0.cmp(&a.0)));
    worst.map(|(next, (contra, pro))| (next, pro > contra))
}

fn links(cameras: &[Camera], keypoints: &[Keypoints]) -> Vec<Link> {
    let n = cameras.len();
    let mut pairs = overlapping_pairs(cameras, OVERLAPPING);
    pairs.retain(|&(a, b)| cameras[a].forward().dot(cameras[b].forward()) > SAME_DIRECTION);
    pairs.extend((0..n).flat_map(|a| (a + 1..n.min(a + 1 + WINDOW)).map(move |b| (a, b))));
    pairs.sort_unstable();
    pairs.dedup();
    matched(pairs, cameras, keypoints)
}

fn matched(pairs: Vec<(usize, usize)>, cameras: &[Camera], keypoints: &[Keypoints]) -> Vec<Link> {
    let link = |(a, b): (usize, usize)| {
        let all = matches(&keypoints[a], &keypoints[b]);
        let right = right(cameras, keypoints, a, b, &all);
        Link { a, b, all, right }
    };
    pairs.into_par_iter().map(link).collect()
}

/// Group of each photo: the strongest agreeing links join first, and two groups never join against a majority of links.
fn groups(n: usize, links: &[Link]) -> Vec<usize> {
    let mut group: Vec<usize> = (0..n).collect();
    let mut agreeing: Vec<&Link> = links.iter().filter(|l| l.agrees()).collect();
    agreeing.sort_by_key(|l| (std::cmp::Reverse(l.right.len()), l.a, l.b));
    for link in agreeing {
        let (a, b) = (group[link.a], group[link.b]);
        if a == b {
            continue;
        }
        let across = |l: &&Link| (group[l.a], group[l.b]) == (a, b) || (group[l.a], group[l.b]) == (b, a);
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

/// Where the key points of each photo lie by the poses of its own group.
fn points_of(cameras: &[Camera], keypoints: &[Keypoints], links: &[Link], group: &[usize]) -> HashMap<(usize, usize), Vec3> {
    let mut sums: HashMap<(usize, usize), (Vec3, f32)> = HashMap::new();
    for link in links.iter().filter(|l| l.agrees() && group[l.a] == group[l.b]) {
        for &(i, j) in &link.right {
            let (pa, pb) = (keypoints[link.a].positions[i], keypoints[link.b].positions[j]);
            let parallax = |p: &Vec3| (*p - cameras[link.a].centre()).angle_between(*p - cameras[link.b].centre()) > MIN_PARALLAX;
            if let Some(point) = intersect(&cameras[link.a], pa, &cameras[link.b], pb).filter(parallax) {
                for key in [(link.a, i), (link.b, j)] {
                    let sum = sums.entry(key).or_default();
                    *sum = (sum.0 + point, sum.1 + 1.0);
                }
            }
        }
    }
    sums.into_iter().map(|(key, (sum, count))| (key, sum / count)).collect()
}

/// Matched points on both sides of the links; `moves` tells the photos that are to be moved.
fn pairs_between(
    across: &[&Link],
    moves: impl Fn(usize) -> bool,
    keypoints: &[Keypoints],
    points: &HashMap<(usize, usize), Vec3>,
) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for link in across {
        for &(i, j) in &link.all {
            let (inner, outer) = if moves(link.b) { ((link.a, i), (link.b, j)) } else { ((link.b, j), (link.a, i)) };
            if let (Some(&to), Some(&from)) = (points.get(&inner), points.get(&outer)) {
                pairs.push(Pair { from, to, view: inner.0, pixel: keypoints[inner.0].positions[inner.1] });
            }
        }
    }
    pairs
}

/// The similarity that most pairs support (RANSAC over three pairs, then least squares); none where few do.
fn fit(pairs: &[Pair], cameras: &[Camera], rng: &mut Rng) -> Option<Similarity> {
    if pairs.len() < FEW {
        tracing::debug!(pairs = pairs.len(), "too few pairs");
        return None;
    }
    let supports = |s: &Similarity, p: &Pair| {
        let camera = &cameras[p.view];
        let q = camera.world_to_camera.transform_point3(s.apply(p.from));
        q.z > 0.0 && camera.to_pixel(q).distance(p.pixel) < MAX_ERROR * camera.width as f32
    };
    let supporters = |s: &Similarity| pairs.iter().filter(|p| supports(s, p)).copied().collect::<Vec<_>>();
    let mut best: Vec<Pair> = Vec::new();
    for _ in 0..TRIALS {
        let three: [Pair; 3] = std::array::from_fn(|_| pairs[rng.below(pairs.len())]);
        if let Some(s) = umeyama(&three) {
            let found = supporters(&s);
            if found.len() > best.len() {
                best = found;
            }
        }
    }
    for _ in 0..5 {
        let refined = supporters(&umeyama(&best)?);
        if refined.len() <= best.len() {
            break;
        }
        best = refined;
    }
    tracing::debug!(pairs = pairs.len(), support = best.len(), "similarity");
    (best.len() >= FEW && best.len() as f32 >= MIN_SUPPORT * pairs.len() as f32).then(|| umeyama(&best)).flatten()
}

/// Fits the epipolar geometry of all matches across: Gauss-Newton on the seven parameters of a small similarity after
/// `first`, with weights that fade out wrong matches.
fn refined(first: Similarity, across: &[&Link], moves: impl Fn(usize) -> bool, cameras: &[Camera], keypoints: &[Keypoints]) -> Similarity {
    let residuals = |s: &Similarity| -> Vec<f32> {
        let placed = |i: usize| {
            let mut camera = cameras[i].clone();
            if moves(i) {
                s.move_camera(&mut camera);
            }
            camera
        };
        let of_link = |l: &&Link| {
            let f = fundamental(&placed(l.a), &placed(l.b));
            let error = |&(i, j): &(usize, usize)| epipolar_residual(&f, keypoints[l.a].positions[i], keypoints[l.b].positions[j]);
            l.all.iter().map(error).collect::<Vec<_>>()
        };
        across.iter().flat_map(of_link).collect()
    };
    let weight = |r: f32, width: f32| 1.0 / (1.0 + (r / width).powi(2)).powi(2);
    let cost = |r: &[f32], width: f32| r.iter().map(|r| 1.0 - 1.0 / (1.0 + (r / width).powi(2))).sum::<f32>();
    let mut best = first;
    for width in [8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 2.0, 2.0] {
        let now = residuals(&best);
        const STEP: f32 = 1e-4;
        let slopes: Vec<Vec<f32>> = (0..7)
            .map(|k| {
                let mut delta = [0.0; 7];
                delta[k] = STEP;
                residuals(&best.nudged(&delta)).iter().zip(&now).map(|(a, b)| (a - b) / STEP).collect()
            })
            .collect();
        let (mut normal, mut right) = ([[0.0f64; 7]; 7], [0.0f64; 7]);
        for (m, r) in now.iter().enumerate() {
            let w = f64::from(weight(*r, width));
            for i in 0..7 {
                right[i] -= w * f64::from(slopes[i][m] * r);
                for j in 0..7 {
                    normal[i][j] += w * f64::from(slopes[i][m] * slopes[j][m]);
                }
            }
        }
        (0..7).for_each(|i| normal[i][i] *= 1.0 + 1e-3);
        let Some(delta) = solve(normal, right) else { break };
        let next = best.nudged(&delta.map(|d| d as f32));
        if cost(&residuals(&next), width) < cost(&now, width) {
            best = next;
        }
    }
    best
}

/// Gaussian elimination with pivoting; none for a singular matrix.
fn solve(mut a: [[f64; 7]; 7], mut b: [f64; 7]) -> Option<[f64; 7]> {
    for k in 0..7 {
        let pivot = (k..7).max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()))?;
        a.swap(k, pivot);
        b.swap(k, pivot);
        if a[k][k].abs() < 1e-12 {
            return None;
        }
        for i in (0..7).filter(|&i| i != k) {
            let factor = a[i][k] / a[k][k];
            let row = a[k];
            (k..7).for_each(|j| a[i][j] -= factor * row[j]);
            b[i] -= factor * b[k];
        }
    }
    Some(std::array::from_fn(|k| b[k] / a[k][k]))
}

/// Least-squares similarity between matched points (Umeyama 1991); none where they lie on a line.
fn umeyama(pairs: &[Pair]) -> Option<Similarity> {
    let n = pairs.len() as f64;
    let mean = |point: &dyn Fn(&Pair) -> Vec3| pairs.iter().map(|p| point(p).as_dvec3()).sum::<DVec3>() / n;
    let (from, to) = (mean(&|p| p.from), mean(&|p| p.to));
    let (mut covariance, mut variance) = (DMat3::ZERO, 0.0);
    for p in pairs {
        let (x, y) = (p.from.as_dvec3() - from, p.to.as_dvec3() - to);
        covariance += DMat3::from_cols(y * x.x, y * x.y, y * x.z) * (1.0 / n);
        variance += x.length_squared() / n;
    }
    // The rotation nearest to the covariance, by Newton's iteration for the polar factor; three points span only a
    // plane, so its normal is added first.
    let normal_from = plane_normal(pairs.iter().map(|p| p.from.as_dvec3() - from))?;
    let normal_to = plane_normal(pairs.iter().map(|p| p.to.as_dvec3() - to))?;
    let scale_of = covariance.col(0).length() + covariance.col(1).length() + covariance.col(2).length();
    let mut best: Option<Similarity> = None;
    for sign in [1.0, -1.0] {
        let lift = if pairs.len() == 3 { sign * 0.3 * scale_of } else { 0.0 };
        let mut r = covariance + DMat3::from_cols(normal_to * normal_from.x, normal_to * normal_from.y, normal_to * normal_from.z) * lift;
        if r.determinant() <= 1e-12 * scale_of.powi(3) {
            continue;
        }
        for _ in 0..60 {
            r = (r + r.inverse().transpose()) * 0.5;
        }
        if !r.is_finite() || (r.determinant() - 1.0).abs() > 1e-6 {
            continue;
        }
        let trace = (r.transpose() * covariance).to_cols_array_2d();
        let scale = (trace[0][0] + trace[1][1] + trace[2][2]) / variance;
        if scale > 1e-3 && scale < 1e3 {
            let translation = (to - scale * (r * from)).as_vec3();
            let found = Similarity { scale: scale as f32, rotation: r.as_mat3(), translation };
            let error = |s: &Similarity| pairs.iter().map(|p| s.apply(p.from).distance_squared(p.to)).sum::<f32>();
            if best.as_ref().is_none_or(|b| error(&found) < error(b)) {
                best = Some(found);
            }
        }
    }
    best
}

/// Normal of the first two directions that are not parallel.
fn plane_normal(mut directions: impl Iterator<Item = DVec3>) -> Option<DVec3> {
    let first = directions.next().filter(|d| d.length() > 1e-9)?.normalize();
    directions.map(|d| first.cross(d)).find(|n| n.length() > 1e-6).map(DVec3::normalize)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photos around a cloud whose points have descriptors of their own.
    fn ring(count: usize) -> (Vec<Camera>, Vec<Keypoints>) {
        let mut rng = Rng::new(5, "ring");
        let points: Vec<(Vec3, [u8; 128])> = (0..300)
            .map(|_| {
                let p = Vec3::new(rng.range(-1.0, 1.0), rng.range(-1.0, 1.0), rng.range(-1.0, 1.0));
                (p, std::array::from_fn(|_| rng.below(256) as u8))
            })
            .collect();
        let cameras: Vec<Camera> = (0..count)
            .map(|k| {
                let angle = k as f32 * 0.15;
                let eye = 5.0 * Vec3::new(angle.cos(), 0.2, angle.sin());
                Camera::look_at(&format!("{k:03}"), eye, Vec3::ZERO, Vec3::Y, 320, 240, 0.8)
            })
            .collect();
        let see = |c: &Camera| {
            let pixel = |p: Vec3| c.to_pixel(c.world_to_camera.transform_point3(p));
            Keypoints { positions: points.iter().map(|p| pixel(p.0)).collect(), descriptors: points.iter().map(|p| p.1).collect() }
        };
        let keypoints = cameras.iter().map(see).collect();
        (cameras, keypoints)
    }

    #[test]
    fn right_poses_stay_as_they_are() {
        let (mut cameras, keypoints) = ring(16);
        let before = cameras.clone();
        assert_eq!(repair(&mut cameras, &keypoints, 0), Report::default());
        assert_eq!(cameras, before);
    }

    #[test]
    fn a_misplaced_group_is_moved_back() {
        let (mut cameras, keypoints) = ring(16);
        let truth = cameras.clone();
        let wrong = Similarity {
            scale: 1.7,
            rotation: Mat3::from_rotation_y(0.9) * Mat3::from_rotation_x(0.4),
            translation: Vec3::new(2.0, -1.0, 0.5),
        };
        cameras[11..].iter_mut().for_each(|c| wrong.move_camera(c));
        let report = repair(&mut cameras, &keypoints, 0);
        assert_eq!(report, Report { moved: (11..16).collect(), contradictory: Vec::new() });
        for (found, right) in cameras.iter().zip(&truth) {
            assert!(found.centre().distance(right.centre()) < 0.02, "{}: {} {}", right.name, found.centre(), right.centre());
            assert!(found.forward().dot(right.forward()) > 0.9999);
        }
    }

    #[test]
    fn what_cannot_be_mended_is_named() {
        let (mut cameras, mut keypoints) = ring(16);
        let wrong = Similarity { scale: 1.0, rotation: Mat3::from_rotation_y(1.0), translation: Vec3::new(2.0, 0.0, 0.0) };
        cameras[13..].iter_mut().for_each(|c| wrong.move_camera(c));
        // Matches that no rigid scene explains.
        let mut rng = Rng::new(9, "noise");
        for k in &mut keypoints[13..] {
            k.positions.iter_mut().for_each(|p| *p = glam::Vec2::new(rng.range(0.0, 320.0), rng.range(0.0, 240.0)));
        }
        let report = repair(&mut cameras, &keypoints, 0);
        assert_eq!(report.moved, Vec::<usize>::new());
        assert_eq!(report.contradictory, vec![13, 14, 15]);
    }
}
