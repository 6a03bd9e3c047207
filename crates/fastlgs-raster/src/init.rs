//! The first Gaussians: from points, from random points as a last resort, and as a backdrop.

use crate::Result;
use crate::floaters::neighbourhood;
use crate::target::{Target, Targets};
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use glam::{Mat3, Vec2, Vec3};
use kiddo::{KdTree, SquaredEuclidean};
use std::collections::BTreeSet;

/// Returns one isotropic Gaussian for each point. Its scale is the root mean square distance to the
/// three nearest neighbours (3DGS). Of points at the same position only the first is used.
pub fn from_points(points: &[SfmPoint]) -> Gaussians {
    let mut known = BTreeSet::new();
    let points: Vec<&SfmPoint> = points
        .iter()
        .filter(|p| known.insert(p.position.to_array().map(f32::to_bits)))
        .collect();
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
        scene.push_sphere(
            p.position,
            radius,
            0.1,
            p.color.map(|c| f32::from(c) / 255.0),
        );
    }
    scene
}

/// Largest number of random pixels that are tried. If the loss ignores all of them, the last one is
/// used.
const TRIES: usize = 32;

/// Returns `count` random points in front of the views, the same number for each view.
///
/// They have the colours of the photos. Their depths are 0.3 to 2 times the distance between the
/// camera and the common focus of all cameras. This is the last resort if no points are known.
///
/// # Errors
/// When a photo cannot be read.
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
            let ray = camera.ray(Vec2::new(pixel[0] as f32 + 0.5, pixel[1] as f32 + 0.5));
            let [r, g, b, _] = image.color[pixel[1] * width + pixel[0]].to_le_bytes();
            out.push(SfmPoint {
                position: inverse.transform_point3(ray * depth),
                color: [r, g, b],
                seen_by: Vec::new(),
            });
        }
    }
    Ok(out)
}

/// Cells of the backdrop along the longer side of a photo.
const CELLS: u32 = 30;
/// Share of the points that may lie outside the backdrop.
const OUTSIDE_SHARE: f32 = 0.02;
/// Smallest radius of the backdrop, in multiples of the largest distance between a camera and the
/// focus. It keeps the backdrop away from cameras that look outwards.
const RADIUS_FACTOR: f32 = 2.0;
/// Opacity of the backdrop: nearly opaque, so that training adds nothing to explain the same
/// pixels.
const BACKDROP_OPACITY: f32 = 0.9;

/// Returns the radius of the backdrop: all but `OUTSIDE_SHARE` of the points lie within it, and all
/// cameras with a margin.
fn backdrop_radius(cameras: &[Camera], points: &[SfmPoint], focus: Vec3) -> f32 {
    let distances = points.iter().map(|point| point.position.distance(focus));
    let mut distances: Vec<f32> = distances.collect();
    distances.sort_by(f32::total_cmp);
    let of_cameras = cameras.iter().map(|camera| camera.centre().distance(focus));
    let min_radius = RADIUS_FACTOR * of_cameras.fold(0.0, f32::max);
    distances
        .get(((1.0 - OUTSIDE_SHARE) * distances.len() as f32) as usize)
        .map_or(min_radius, |farthest| farthest.max(min_radius))
}

/// Returns a backdrop for few photos: at most `max_count` nearly opaque Gaussians on a sphere.
///
/// The sphere surrounds the common focus, all cameras, and all but a few of `points`. Its Gaussians
/// have the colours of the photos. They cover the parts of the photos that show no point nearby.
///
/// Few photos do not determine the depth of these parts. Without a backdrop, training explains them
/// by a haze that hides the scene from other views.
///
/// # Errors
/// When a photo cannot be read.
pub fn backdrop(views: &Targets, points: &[SfmPoint], max_count: usize) -> Result<Gaussians> {
    let focus = common_focus(&views.cameras);
    let radius = backdrop_radius(&views.cameras, points, focus);
    let mut scene = Gaussians::default();
    for id in 0..views.len() {
        let Target { camera, image, .. } = views.get(id)?;
        let cells = camera.shrunk_to(CELLS);
        let [width, height] = [cells.width, cells.height].map(|side| side as usize);
        let mut covered = vec![false; width * height];
        // Include the Gaussians that earlier photos added.
        let projected_points = points
            .iter()
            .map(|point| point.position)
            .chain(scene.means.iter().copied());
        for (cell, _) in projected_points.filter_map(|place| cells.pixel_and_depth(place)) {
            neighbourhood(&cells, cell, 1).for_each(|at| covered[at] = true);
        }
        let camera_to_world = Mat3::from_mat4(camera.world_to_camera).transpose();
        let from = camera.centre() - focus;
        for cell in (0..width * height).filter(|cell| !covered[*cell]) {
            let middle = Vec2::new((cell % width) as f32 + 0.5, (cell / width) as f32 + 0.5);
            let ray = camera_to_world * cells.ray(middle).normalize();
            // Distance to the point where the ray leaves the sphere.
            let towards = from.dot(ray);
            let distance = (towards * towards + radius * radius - from.length_squared())
                .max(0.0)
                .sqrt()
                - towards;
            let [x, y] = [
                middle.x * camera.width as f32 / cells.width as f32,
                middle.y * camera.height as f32 / cells.height as f32,
            ];
            let [r, g, b, counts] =
                image.color[y as usize * camera.width as usize + x as usize].to_le_bytes();
            // The radius is 0 if all cameras have the same position and there are no points.
            if counts == 255 && distance > 0.0 {
                scene.push_sphere(
                    camera.centre() + distance * ray,
                    distance / cells.fx,
                    BACKDROP_OPACITY,
                    [r, g, b].map(|c| f32::from(c) / 255.0),
                );
            }
        }
    }
    let kept: Vec<usize> = (0..scene.len().min(max_count))
        .map(|k| k * scene.len() / max_count.min(scene.len()))
        .collect();
    Ok(scene.select(&kept))
}

/// Returns the point nearest to all optical axes (least squares). For parallel axes, returns a
/// point in front of the mean position.
pub fn common_focus(cameras: &[Camera]) -> Vec3 {
    let (mut a, mut b) = (Mat3::ZERO, Vec3::ZERO);
    for camera in cameras {
        let d = camera.forward();
        let across = Mat3::IDENTITY - Mat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * camera.centre();
    }
    let mean = cameras.iter().map(Camera::centre).sum::<Vec3>() / cameras.len().max(1) as f32;
    // Parallel axes have no nearest point.
    if a.determinant().abs() > 1e-4 {
        a.inverse() * b
    } else {
        mean + cameras[0].forward()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TargetImage;

    #[test]
    fn points_at_one_position_give_one_gaussian() {
        let point = |x: f32| SfmPoint {
            position: Vec3::X * x,
            color: [9; 3],
            seen_by: Vec::new(),
        };
        let mut points = vec![point(0.0); 100];
        points.extend([point(1.0), point(2.0)]);
        let scene = from_points(&points);
        assert_eq!(scene.len(), 3);
        assert!(
            (scene.log_scales[1].x.exp() - 1.0).abs() < 1e-5,
            "the distance to both neighbours"
        );
        assert_eq!(from_points(&points[..1]).len(), 1);
    }

    #[test]
    fn focus_is_where_the_cameras_look() {
        let target = Vec3::new(0.5, -1.0, 2.0);
        let eyes = [
            Vec3::new(4.0, 0.0, 0.0),
            Vec3::new(0.0, 1.0, -5.0),
            Vec3::new(-3.0, 0.5, 3.0),
        ];
        let cameras = eyes.map(|e| Camera::look_at("c", e, target, Vec3::Y, 64, 48, 0.8));
        assert!((common_focus(&cameras) - target).length() < 1e-3);
    }

    /// Four photos from around the origin, each of one colour. The loss ignores their right third.
    fn photos() -> Targets {
        let eyes = [Vec3::X, Vec3::Z, -Vec3::X, -Vec3::Z].map(|eye| 4.0 * eye);
        let target = |(k, eye): (usize, &Vec3)| {
            let camera = Camera::look_at(&k.to_string(), *eye, Vec3::ZERO, Vec3::Y, 60, 40, 0.8);
            let color = (0..60 * 40)
                .map(|pixel| crate::pack([50 + k as u8, 100, 200], pixel % 60 < 40))
                .collect();
            Target {
                camera,
                image: TargetImage {
                    size: [60, 40],
                    color,
                    feature: Vec::new(),
                    depth: Vec::new(),
                },
                gain: [1.0; 3],
            }
        };
        eyes.iter()
            .enumerate()
            .map(target)
            .collect::<Vec<_>>()
            .into()
    }

    #[test]
    fn backdrop_covers_the_parts_of_photos_without_points() {
        let views = photos();
        // A ball of radius 1, and one wrong point far away.
        let mut points: Vec<SfmPoint> = (0..200)
            .map(|k| {
                let (up, around) = (k as f32 / 100.0 - 1.0, 2.4 * k as f32);
                let across = (1.0 - up * up).max(0.0).sqrt();
                SfmPoint {
                    position: Vec3::new(across * around.cos(), up, across * around.sin()),
                    color: [0; 3],
                    seen_by: Vec::new(),
                }
            })
            .collect();
        points.push(SfmPoint {
            position: Vec3::splat(900.0),
            color: [0; 3],
            seen_by: Vec::new(),
        });
        let scene = backdrop(&views, &points, usize::MAX).unwrap();
        assert!(scene.len() > 500, "{} Gaussians", scene.len());
        for (mean, color) in scene.means.iter().zip(&scene.sh_dc) {
            assert!(
                (mean.length() - 8.0).abs() < 1e-3,
                "on the sphere around cameras and points: {mean}"
            );
            let shown =
                [color.x, color.y, color.z].map(|c| (255.0 * (0.5 + 0.282_094_79 * c)).round());
            assert!(
                (50.0..54.0).contains(&shown[0]) && shown[1..] == [100.0, 200.0],
                "{shown:?}"
            );
        }
        let first = &views.cameras[0].shrunk_to(CELLS);
        let shown: Vec<usize> = scene
            .means
            .iter()
            .filter_map(|mean| first.pixel_and_depth(*mean))
            .map(|(cell, _)| cell)
            .collect();
        assert!(
            shown
                .iter()
                .all(|cell| cell % first.width as usize != 15 || cell / first.width as usize != 10),
            "no Gaussian covers the ball"
        );
        let own = 20 * 20 - shown.iter().filter(|cell| *cell % 30 < 20).count();
        assert!(
            own < 200,
            "all other cells that count are covered, except {own}"
        );
        assert!(backdrop(&views, &points, 40).unwrap().len() == 40);
        assert!(
            backdrop(&views, &[], usize::MAX).unwrap().len() > scene.len(),
            "no points are needed"
        );
        assert_eq!(backdrop(&views, &points, 0).unwrap().len(), 0);
    }
}
