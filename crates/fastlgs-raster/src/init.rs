//! First Gaussians: from points, or at worst at random in what the cameras see together.

use crate::Result;
use crate::target::{Target, Targets};
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use glam::Vec3;
use kiddo::{KdTree, SquaredEuclidean};
use std::collections::BTreeSet;

/// One isotropic Gaussian a point, as wide as the mean distance to its three nearest neighbours (3DGS); of points in one place the first.
pub fn from_points(points: &[SfmPoint]) -> Gaussians {
    let mut known = BTreeSet::new();
    let points: Vec<&SfmPoint> = points.iter().filter(|p| known.insert(p.position.to_array().map(f32::to_bits))).collect();
    let mut tree: KdTree<f64, 3> = KdTree::new();
    for (i, p) in points.iter().enumerate() {
        tree.add(&p.position.as_dvec3().to_array(), i as u64);
    }
    let mut scene = Gaussians::default();
    for p in points {
        let near = tree.nearest_n::<SquaredEuclidean>(&p.position.as_dvec3().to_array(), 4);
        let others = near.iter().skip(1).map(|n| n.distance);
        let mean_square = others.sum::<f64>() / near.len().saturating_sub(1).max(1) as f64;
        let radius = (mean_square.sqrt() as f32).clamp(1e-6, 1e3);
        scene.push_sphere(p.position, radius, 0.1, p.color.map(|c| f32::from(c) / 255.0));
    }
    scene
}

/// Pixels that are tried for a random point before one is taken that does not count.
const TRIES: usize = 32;

/// `count` points in front of the views, as many of each, coloured as their photos are there, at depths around their distance to the cameras' common
/// focus: the last resort where nothing else is known.
///
/// # Errors
/// When a picture cannot be read.
pub fn random_points(views: &Targets, count: usize, rng: &mut Rng) -> Result<Vec<SfmPoint>> {
    let focus = common_focus(&views.cameras);
    let mut out = Vec::with_capacity(count);
    for id in 0..views.len() {
        let so_far = count * (id + 1) / views.len();
        if out.len() == so_far {
            continue;
        }
        let Target { camera, image, .. } = views.get(id)?;
        let width = camera.width as usize;
        let counts = |p: &[usize; 2]| image.color[p[1] * width + p[0]].to_le_bytes()[3] == 255;
        let inverse = camera.world_to_camera.inverse();
        while out.len() < so_far {
            let mut pixel = [0; 2];
            for _ in 0..TRIES {
                pixel = [camera.width, camera.height].map(|side| rng.below(side as usize));
                if counts(&pixel) {
                    break;
                }
            }
            let depth = camera.centre().distance(focus).max(1e-3) * rng.range(0.3, 2.0);
            let ray = camera.ray(glam::Vec2::new(pixel[0] as f32 + 0.5, pixel[1] as f32 + 0.5));
            let [r, g, b, _] = image.color[pixel[1] * width + pixel[0]].to_le_bytes();
            out.push(SfmPoint { position: inverse.transform_point3(ray * depth), color: [r, g, b], seen_by: Vec::new() });
        }
    }
    Ok(out)
}

/// The point nearest to all viewing axes (least squares).
pub fn common_focus(cameras: &[Camera]) -> Vec3 {
    let (mut a, mut b) = (glam::Mat3::ZERO, Vec3::ZERO);
    for camera in cameras {
        let d = camera.forward();
        let across = glam::Mat3::IDENTITY - glam::Mat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * camera.centre();
    }
    let mean = cameras.iter().map(Camera::centre).sum::<Vec3>() / cameras.len().max(1) as f32;
    // Parallel axes have no nearest point.
    if a.determinant().abs() > 1e-4 { a.inverse() * b } else { mean + cameras[0].forward() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_in_one_place_are_one() {
        let point = |x: f32| SfmPoint { position: Vec3::X * x, color: [9; 3], seen_by: Vec::new() };
        let mut points = vec![point(0.0); 100];
        points.extend([point(1.0), point(2.0)]);
        let scene = from_points(&points);
        assert_eq!(scene.len(), 3);
        assert!((scene.log_scales[1].x.exp() - 1.0).abs() < 1e-5, "the distance to both neighbours");
        assert_eq!(from_points(&points[..1]).len(), 1);
    }

    #[test]
    fn focus_is_where_the_cameras_look() {
        let target = Vec3::new(0.5, -1.0, 2.0);
        let eyes = [Vec3::new(4.0, 0.0, 0.0), Vec3::new(0.0, 1.0, -5.0), Vec3::new(-3.0, 0.5, 3.0)];
        let cameras = eyes.map(|e| Camera::look_at("c", e, target, Vec3::Y, 64, 48, 0.8));
        assert!((common_focus(&cameras) - target).length() < 1e-3);
    }
}
