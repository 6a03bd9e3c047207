//! Points from matched key points and known poses, and which photos see the same.

use crate::keypoints::{Keypoints, epipolar_error, fundamental};
use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::{Vec2, Vec3};

/// A matched pair of photos: indices, and key-point pairs that obey the known poses.
#[derive(Clone, Debug)]
pub struct PairMatches {
    /// Index of the earlier photo.
    pub a: usize,
    /// Index of the later photo.
    pub b: usize,
    /// (key point in a, key point in b).
    pub pairs: Vec<(usize, usize)>,
}

/// Largest epipolar error of a match in pixels.
const MAX_EPIPOLAR: f32 = 2.0;
/// Smallest angle between the rays of a triangulated point, in radians.
const MIN_ANGLE: f32 = 0.02;

/// For each photo the `count` others that look at the same from nearby: pairs (a, b), a < b, sorted.
pub fn overlapping_pairs(cameras: &[Camera], count: usize) -> Vec<(usize, usize)> {
    let span = fastlgs_core::camera::scene_extent(cameras);
    let mut pairs = std::collections::BTreeSet::new();
    for (i, a) in cameras.iter().enumerate() {
        let cost = |b: &Camera| a.centre().distance(b.centre()) / span + 2.0 * (1.0 - a.forward().dot(b.forward()));
        let mut others: Vec<usize> = (0..cameras.len()).filter(|&j| j != i && a.forward().dot(cameras[j].forward()) > 0.3).collect();
        others.sort_by(|&x, &y| cost(&cameras[x]).total_cmp(&cost(&cameras[y])).then(x.cmp(&y)));
        pairs.extend(others.into_iter().take(count).map(|j| (i.min(j), i.max(j))));
    }
    pairs.into_iter().collect()
}

/// Keeps the matches that agree with the poses.
pub fn epipolar_filter(a: (&Camera, &Keypoints), b: (&Camera, &Keypoints), pairs: &[(usize, usize)]) -> Vec<(usize, usize)> {
    let f = fundamental(a.0, b.0);
    let good = |&&(i, j): &&(usize, usize)| epipolar_error(&f, a.1.positions[i], b.1.positions[j]) < MAX_EPIPOLAR;
    pairs.iter().filter(good).copied().collect()
}

/// The point nearest to both rays, if it lies before both cameras and reprojects well.
pub(crate) fn intersect(a: &Camera, pa: Vec2, b: &Camera, pb: Vec2) -> Option<Vec3> {
    let ray = |c: &Camera, p: Vec2| (c.world_to_camera.inverse().transform_vector3(c.ray(p))).normalize();
    let (oa, ob, da, db) = (a.centre(), b.centre(), ray(a, pa), ray(b, pb));
    let cosine = da.dot(db);
    if cosine > MIN_ANGLE.cos() {
        return None;
    }
    let between = ob - oa;
    let (pa_, pb_) = (between.dot(da), between.dot(db));
    let sine2 = 1.0 - cosine * cosine;
    let (s, t) = ((pa_ - cosine * pb_) / sine2, (cosine * pa_ - pb_) / sine2);
    let point = 0.5 * (oa + s * da + ob + t * db);
    let seen = |c: &Camera, p: Vec2| {
        let q = c.world_to_camera.transform_point3(point);
        q.z > 0.0 && c.to_pixel(q).distance(p) < MAX_EPIPOLAR
    };
    (s > 0.0 && t > 0.0 && seen(a, pa) && seen(b, pb)).then_some(point)
}

/// Triangulates every match; `colors` are those of each photo's key points, of which the first photo's is taken.
pub fn triangulate(cameras: &[Camera], keypoints: &[Keypoints], colors: &[Vec<[u8; 3]>], matches: &[PairMatches]) -> Vec<SfmPoint> {
    let mut points = Vec::new();
    for m in matches {
        let (a, b) = (&cameras[m.a], &cameras[m.b]);
        for &(i, j) in &m.pairs {
            let pa = keypoints[m.a].positions[i];
            if let Some(position) = intersect(a, pa, b, keypoints[m.b].positions[j]) {
                points.push(SfmPoint { position, color: colors[m.a][i] });
            }
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_rays_meet_where_the_point_is() {
        let a = Camera::look_at("a", Vec3::new(3.0, 0.0, 0.0), Vec3::ZERO, Vec3::Y, 320, 240, 0.8);
        let b = Camera::look_at("b", Vec3::new(1.0, 0.5, 3.0), Vec3::ZERO, Vec3::Y, 300, 200, 0.7);
        let point = Vec3::new(0.2, -0.3, 0.1);
        let see = |c: &Camera| c.to_pixel(c.world_to_camera.transform_point3(point));
        assert!((intersect(&a, see(&a), &b, see(&b)).unwrap() - point).length() < 1e-3);
        assert!(intersect(&a, see(&a), &a, see(&a)).is_none(), "no parallax, no point");
        let pairs = overlapping_pairs(&[a.clone(), b, a], 1);
        assert!(pairs.contains(&(0, 2)), "the twin camera is the nearest: {pairs:?}");
    }
}
