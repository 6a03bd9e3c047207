//! Planes through points in camera space.

use fastlgs_core::rng::Rng;
use glam::{DMat3, DVec3};

/// Smallest number of points that determine a plane.
const MIN_POINTS: usize = 10;
/// Smallest number of them that the view itself must see. The others are on surfaces that other
/// views see.
const MIN_OWN_POINTS: usize = 3;
/// Largest relative depth error of a point on its plane. It is also the largest standard deviation
/// of a plane's depth, relative to the depth.
const TOLERANCE: f64 = 0.02;
/// Smallest share of a mask's points that lie on its plane.
const MIN_INLIERS: f64 = 0.3;
/// Number of planes that RANSAC tries for each mask.
const TRIALS: usize = 150;
/// Number of refinements of the best plane by least squares.
const REFINEMENTS: usize = 3;

/// A plane n P = 1 in camera space. The residual of a point, |n P - 1|, is its relative depth
/// error.
pub(crate) struct Plane {
    n: DVec3,
    /// Covariance of `n`.
    covariance: DMat3,
}

/// Returns the relative depth error of a point on the plane n P = 1.
fn error(n: DVec3, point: DVec3) -> f64 {
    (n.dot(point) - 1.0).abs()
}

impl Plane {
    /// Fits planes to points one after another, each to the points that the earlier ones left.
    /// Returns the planes, and the index of each point's plane. The first `own` points are those
    /// that the view itself sees.
    pub fn fit_all(points: &[DVec3], own: usize, rng: &mut Rng) -> (Vec<Self>, Vec<Option<usize>>) {
        let mut planes = Vec::new();
        let mut plane_of_point = vec![None; points.len()];
        let mut left: Vec<usize> = (0..points.len()).collect();
        loop {
            let positions: Vec<DVec3> = left.iter().map(|k| points[*k]).collect();
            let own_left = left.iter().filter(|k| **k < own).count();
            let Some(plane) = Self::fit(&positions, own_left, rng) else {
                return (planes, plane_of_point);
            };
            for k in &left {
                if error(plane.n, points[*k]) < TOLERANCE {
                    plane_of_point[*k] = Some(planes.len());
                }
            }
            left.retain(|k| plane_of_point[*k].is_none());
            planes.push(plane);
        }
    }

    /// Fits a plane to points in camera space by RANSAC; `None` if fewer than [`MIN_INLIERS`] of
    /// them lie on any plane.
    fn fit(points: &[DVec3], own: usize, rng: &mut Rng) -> Option<Self> {
        if points.len() < MIN_POINTS || own < MIN_OWN_POINTS {
            return None;
        }
        let inliers = |n: DVec3| points.iter().filter(move |p| error(n, **p) < TOLERANCE);
        let own_inliers = |n: DVec3| {
            let is_inlier = |p: &&DVec3| error(n, **p) < TOLERANCE;
            points[..own].iter().filter(is_inlier).count()
        };
        let mut best = (0, DVec3::ZERO);
        for _ in 0..TRIALS {
            let [a, b, c] = [(); 3].map(|()| points[rng.below(points.len())]);
            let rows = DMat3::from_cols(a, b, c).transpose();
            let volume = rows.determinant().abs();
            if volume < 1e-6 * a.length() * b.length() * c.length() {
                continue;
            }
            let n = rows.inverse() * DVec3::ONE;
            let count = inliers(n).count();
            if count > best.0 && own_inliers(n) >= MIN_OWN_POINTS {
                best = (count, n);
            }
        }
        let mut n = best.1;
        let mut inverse = DMat3::ZERO;
        for _ in 0..REFINEMENTS {
            let outer = |p: &DVec3| DMat3::from_cols(*p * p.x, *p * p.y, *p * p.z);
            let squares = inliers(n).map(outer).fold(DMat3::ZERO, |sum, m| sum + m);
            if squares.determinant() <= 0.0 {
                return None;
            }
            inverse = squares.inverse();
            n = inverse * inliers(n).copied().sum::<DVec3>();
        }
        let count = inliers(n).count();
        let own_count = own_inliers(n);
        let is_supported =
            own_count >= MIN_OWN_POINTS && own_count as f64 >= MIN_INLIERS * own as f64;
        if count < MIN_POINTS || !is_supported {
            return None;
        }
        let squares: f64 = inliers(n).map(|p| error(n, *p).powi(2)).sum();
        Some(Self {
            n,
            covariance: inverse * (squares / count as f64),
        })
    }

    /// Returns the depth along a ray with z = 1; `None` behind the camera, or where the points
    /// leave it uncertain.
    pub fn depth(&self, ray: DVec3) -> Option<f64> {
        let depth = 1.0 / self.n.dot(ray);
        let deviation = depth * ray.dot(self.covariance * ray).max(0.0).sqrt();
        (depth > 0.0 && depth.is_finite() && deviation < TOLERANCE).then_some(depth)
    }
}
