//! Chooses the views in which objects are embedded.

use fastlgs_core::{Camera, Gaussians};
use fastlgs_grid::support::ViewSupport;
use glam::Vec3;

/// Number of views in which an object is embedded.
const EMBEDDED_VIEWS: usize = 3;
/// Least angle between two of these views, seen from the object, in degrees.
const LEAST_ANGLE: f32 = 15.0;

/// A view of an object with its value for an embedding.
struct Candidate {
    view: usize,
    /// Pixels, times the share of the object inside the photo, times the IoU with the best mask.
    value: f32,
    /// Unit direction from the object to the camera.
    direction: Vec3,
}

/// Returns the views in which an object is embedded, best first. `supports` are the views that show
/// it, and `own` holds the indices of its Gaussians.
///
/// A view is good if it shows many pixels of the object, if the object lies inside the photo, and
/// if a mask fits it. Views from nearly the same direction show the same, so that they are at least
/// [`LEAST_ANGLE`] apart if there are enough such views.
pub fn choose(
    supports: &[ViewSupport],
    own: &[usize],
    scene: &Gaussians,
    cameras: &[Camera],
) -> Vec<usize> {
    let count = own.len().max(1) as f32;
    let centre = own.iter().map(|i| scene.means[*i]).sum::<Vec3>() / count;
    let candidate = |support: &ViewSupport| {
        let camera = &cameras[support.view as usize];
        let is_inside = |i: &&usize| camera.pixel_and_depth(scene.means[**i]).is_some();
        let inside = own.iter().filter(is_inside).count() as f32 / count;
        Candidate {
            view: support.view as usize,
            value: support.pixels as f32 * inside * support.iou,
            direction: (camera.centre() - centre).normalize_or_zero(),
        }
    };
    let mut candidates: Vec<Candidate> = supports.iter().map(candidate).collect();
    candidates.sort_by(|a, b| b.value.total_cmp(&a.value).then(a.view.cmp(&b.view)));
    let least_cosine = LEAST_ANGLE.to_radians().cos();
    let mut chosen: Vec<&Candidate> = Vec::new();
    // The second round takes views that are not apart, if there are too few others.
    for apart in [true, false] {
        for candidate in &candidates {
            let repeats = |other: &&Candidate| {
                let is_near = other.direction.dot(candidate.direction) > least_cosine;
                other.view == candidate.view || (apart && is_near)
            };
            if chosen.len() < EMBEDDED_VIEWS && !chosen.iter().any(repeats) {
                chosen.push(candidate);
            }
        }
    }
    chosen.iter().map(|candidate| candidate.view).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras that look at the origin from these angles around it, in degrees.
    fn cameras(angles: &[f32]) -> Vec<Camera> {
        let camera = |angle: &f32| {
            let (sin, cos) = angle.to_radians().sin_cos();
            let eye = 3.0 * Vec3::new(sin, 0.0, cos);
            Camera::look_at("view", eye, Vec3::ZERO, Vec3::Y, 64, 64, 0.8)
        };
        angles.iter().map(camera).collect()
    }

    fn support(view: u32, pixels: u32, iou: f32) -> ViewSupport {
        ViewSupport { view, pixels, iou }
    }

    #[test]
    fn views_are_large_complete_masked_and_apart() {
        let mut scene = Gaussians::default();
        for x in [-0.3, 0.3] {
            scene.push_sphere(Vec3::new(x, 0.0, 0.0), 0.1, 0.9, [0.5; 3]);
        }
        let own = [0, 1];
        // View 1 lies 5 degrees beside view 0, view 4 looks past the object.
        let mut cameras = cameras(&[0.0, 5.0, 40.0, 80.0, 120.0]);
        cameras[4].cx -= 1000.0;
        let supports = [
            support(0, 900, 0.9),
            support(1, 800, 0.9),
            support(2, 300, 0.9),
            support(3, 700, 0.2),
            support(4, 2000, 0.9),
        ];
        assert_eq!(choose(&supports, &own, &scene, &cameras), [0, 2, 3]);
        // If no others are left, views may be near to each other.
        assert_eq!(choose(&supports[..2], &own, &scene, &cameras), [0, 1]);
        assert!(choose(&[], &own, &scene, &cameras).is_empty());
    }
}
