//! Fits the similarity that aligns a group of photos with the others: first to triangulated points,
//! then to the epipolar geometry of all matches.

use super::links::{Link, MIN_LINK_MATCHES};
use crate::keypoints::{Keypoints, epipolar_residual, fundamental};
use crate::similarity::Similarity;
use crate::tracks::TOLERANCE;
use crate::triangulate::{intersect, reprojection_error};
use fastlgs_core::Camera;
use fastlgs_core::rng::Rng;
use glam::Vec3;
use nalgebra::{SMatrix, SVector};
use std::collections::HashMap;

/// RANSAC iterations.
const FIT_TRIALS: usize = 2000;
/// Largest reprojection error of an inlier, as a share of the photo's width.
const MAX_ERROR: f32 = 0.02;
/// Smallest share of inliers of an accepted fit. A pair from a wrong match supports a wrong fit
/// with a chance of about 1 in 1,000.
const MIN_SUPPORT: f32 = 0.12;
/// Smallest parallax of a point that a fit uses, in radians. At smaller angles its depth is noise.
const MIN_PARALLAX: f32 = 0.03;

/// A matched point: its position by the group that moves (`from`), its position by the groups that
/// stay (`to`), and the key point that shows it in a photo that stays.
#[derive(Clone, Copy)]
pub(super) struct Pair {
    pub from: Vec3,
    pub to: Vec3,
    pub view: usize,
    pub pixel: glam::Vec2,
}

/// Triangulates the key points of each photo with the poses of its own group. Returns world
/// positions by (view, key point), averaged over all inlier matches.
pub(super) fn points_of(
    cameras: &[Camera],
    keypoints: &[Keypoints],
    links: &[Link],
    group: &[usize],
) -> HashMap<(usize, usize), Vec3> {
    let mut sums: HashMap<(usize, usize), (Vec3, f32)> = HashMap::new();
    for link in links
        .iter()
        .filter(|l| l.agrees() && group[l.a] == group[l.b])
    {
        for &(i, j) in &link.inliers {
            let (pa, pb) = (
                keypoints[link.a].positions[i],
                keypoints[link.b].positions[j],
            );
            let parallax = |p: &Vec3| {
                (*p - cameras[link.a].centre()).angle_between(*p - cameras[link.b].centre())
                    > MIN_PARALLAX
            };
            if let Some(point) =
                intersect(&cameras[link.a], pa, &cameras[link.b], pb, TOLERANCE).filter(parallax)
            {
                for key in [(link.a, i), (link.b, j)] {
                    let sum = sums.entry(key).or_default();
                    *sum = (sum.0 + point, sum.1 + 1.0);
                }
            }
        }
    }
    sums.into_iter()
        .map(|(key, (sum, count))| (key, sum / count))
        .collect()
}

/// Returns the triangulated points on both sides of the links; `moves` selects the photos that
/// move.
pub(super) fn pairs_between(
    across: &[&Link],
    moves: impl Fn(usize) -> bool,
    keypoints: &[Keypoints],
    points: &HashMap<(usize, usize), Vec3>,
) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for link in across {
        for &(i, j) in &link.all {
            let (inner, outer) = if moves(link.b) {
                ((link.a, i), (link.b, j))
            } else {
                ((link.b, j), (link.a, i))
            };
            if let (Some(&to), Some(&from)) = (points.get(&inner), points.get(&outer)) {
                pairs.push(Pair {
                    from,
                    to,
                    view: inner.0,
                    pixel: keypoints[inner.0].positions[inner.1],
                });
            }
        }
    }
    pairs
}

/// Returns the similarity that most pairs support: RANSAC over three pairs, then least squares over
/// the inliers. Returns `None` if too few pairs support it.
pub(super) fn fit(pairs: &[Pair], cameras: &[Camera], rng: &mut Rng) -> Option<Similarity> {
    if pairs.len() < MIN_LINK_MATCHES {
        tracing::debug!(pairs = pairs.len(), "too few point pairs for a similarity");
        return None;
    }
    let supports = |s: &Similarity, p: &Pair| {
        let camera = &cameras[p.view];
        reprojection_error(camera, s.apply(p.from), p.pixel)
            .is_some_and(|error| error < MAX_ERROR * camera.width as f32)
    };
    let supporters = |s: &Similarity| {
        pairs
            .iter()
            .filter(|p| supports(s, p))
            .copied()
            .collect::<Vec<_>>()
    };
    let placing = |pairs: &[Pair]| {
        Similarity::between(&pairs.iter().map(|p| (p.from, p.to)).collect::<Vec<_>>())
    };
    let mut best: Vec<Pair> = Vec::new();
    for _ in 0..FIT_TRIALS {
        let three: [Pair; 3] = std::array::from_fn(|_| pairs[rng.below(pairs.len())]);
        if let Some(s) = placing(&three) {
            let found = supporters(&s);
            if found.len() > best.len() {
                best = found;
            }
        }
    }
    for _ in 0..5 {
        let refined = supporters(&placing(&best)?);
        if refined.len() <= best.len() {
            break;
        }
        best = refined;
    }
    tracing::debug!(pairs = pairs.len(), support = best.len(), "similarity");
    (best.len() >= MIN_LINK_MATCHES && best.len() as f32 >= MIN_SUPPORT * pairs.len() as f32)
        .then(|| placing(&best))
        .flatten()
}

/// Returns a camera, moved by a similarity if it belongs to the moved group.
fn moved(camera: &Camera, similarity: &Similarity, moves: bool) -> Camera {
    let mut camera = camera.clone();
    if moves {
        similarity.move_camera(&mut camera);
    }
    camera
}

/// Refines `first` on the epipolar geometry of all matches between the groups.
///
/// Gauss-Newton on the seven parameters of a small similarity applied after `first`. The residuals
/// are Sampson distances in pixels. Geman-McClure weights reduce the effect of wrong matches.
pub(super) fn refined(
    first: Similarity,
    across: &[&Link],
    moves: impl Fn(usize) -> bool,
    cameras: &[Camera],
    keypoints: &[Keypoints],
) -> Similarity {
    let residuals = |s: &Similarity| -> Vec<f32> {
        let placed = |i: usize| moved(&cameras[i], s, moves(i));
        let of_link = |l: &&Link| {
            let f = fundamental(&placed(l.a), &placed(l.b));
            let error = |&(i, j): &(usize, usize)| {
                epipolar_residual(&f, keypoints[l.a].positions[i], keypoints[l.b].positions[j])
            };
            l.all.iter().map(error).collect::<Vec<_>>()
        };
        across.iter().flat_map(of_link).collect()
    };
    let weight = |r: f32, width: f32| 1.0 / (1.0 + (r / width).powi(2)).powi(2);
    let cost = |r: &[f32], width: f32| -> f32 {
        let costs = r.iter().map(|r| 1.0 - 1.0 / (1.0 + (r / width).powi(2)));
        costs.sum()
    };
    let mut best = first;
    for loss_scale in [8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 2.0, 2.0] {
        let now = residuals(&best);
        const STEP: f32 = 1e-4;
        let slope = |k: usize| -> Vec<f32> {
            let mut delta = [0.0; 7];
            delta[k] = STEP;
            let moved = residuals(&best.followed_by_small(&delta));
            moved
                .iter()
                .zip(&now)
                .map(|(a, b)| (a - b) / STEP)
                .collect()
        };
        let slopes: Vec<Vec<f32>> = (0..7).map(slope).collect();
        let (mut normal, mut right) = (SMatrix::<f64, 7, 7>::zeros(), SVector::<f64, 7>::zeros());
        for (m, r) in now.iter().enumerate() {
            let w = f64::from(weight(*r, loss_scale));
            let row = SVector::<f64, 7>::from_fn(|k, _| slopes[k][m].into());
            normal += w * row * row.transpose();
            right -= w * f64::from(*r) * row;
        }
        (0..7).for_each(|i| normal[(i, i)] *= 1.0 + 1e-3);
        let Some(delta) = normal.lu().solve(&right) else {
            break;
        };
        let next = best.followed_by_small(&std::array::from_fn(|k| delta[k] as f32));
        if cost(&residuals(&next), loss_scale) < cost(&now, loss_scale) {
            best = next;
        }
    }
    best
}
