//! Free space: regions that views have shown to be empty. Gaussians in them are floaters.
//!
//! A floater explains one photo and hides the scene from others. With few photos the loss does not
//! penalise floaters, but the points and the Gaussians that training starts from reveal them:
//!
//! * Between a camera and a point that at least three cameras agree on, space is free.
//! * Space nearer to a camera than a fifth of the median depth of the first Gaussians is free. A
//!   larger share would remove the near ends of textureless surfaces.
//! * Space around a camera is free as well, within a similar radius. Otherwise a haze in the colour
//!   of a wall can hide the scene from a view between two cameras.
//!
//! With many photos, other photos contradict floaters, and these rules would do harm: some camera is
//! near to each object, and photos agree on the wall behind a thin object. Only the space before
//! surfaces is then free. A surface covers the pixels of its mask alone, and thus none of what stands
//! before it.

use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::Vec3;
use rayon::prelude::*;

/// Free space is used with fewer training views than this: other views may then not contradict a
/// floater.
pub const FEW_VIEWS: usize = 25;
/// Share of the depth of a point up to which space is free.
const FREE_SHARE: f32 = 0.85;
/// Longer side of the depth maps in pixels: that of the plane sweep, which computes the points.
const DEPTH_MAP_SIDE: u32 = 240;
/// Distance in pixels from the projection of a point up to which space in front of it is free.
const FREE_RADIUS: usize = 1;
/// Distance in pixels from the projection of a point up to which free space ends before the point.
/// Thin objects have few points, and between these only the wall behind has points. With 0, views
/// of wires lose 1.2 dB; with 8, nothing.
const LIMIT_RADIUS: usize = 8;
/// Smallest number of cameras that must see a point. With two, a wrong match also gives a point:
/// each point on one line of sight lies on some line of sight of the other camera.
const MIN_CAMERAS: usize = 3;
/// Share of the depth of a surface up to which space before it is free.
const BEFORE_SURFACE: f32 = 0.9;
/// Number of cameras that must see a surface behind a Gaussian, for it to be removed.
const MIN_VIEWS: usize = 2;
/// Share of the median depth of the first Gaussians up to which space near a camera is free. It is
/// less if more than one in `OUTLIER` of them would lie in it.
const NEAR_SHARE: f32 = 0.2;
/// One of this many first Gaussians may be wrong.
const OUTLIER: usize = 50;
/// Fewest visible Gaussians that determine near space; also the most Gaussians around a camera that
/// may be wrong.
const MIN_GAUSSIANS: usize = 50;

/// The free space of a camera.
#[derive(Clone, Debug)]
struct CameraFreeSpace {
    /// At most [`DEPTH_MAP_SIDE`] pixels wide and high.
    camera: Camera,
    /// Depth up to which space is free at each pixel, row by row.
    depth: Vec<f32>,
    /// Position of the camera, and the radius of the free space around it.
    centre: Vec3,
    radius: f32,
}

impl CameraFreeSpace {
    /// Computes the free space of a camera that sees the points `seen`. `means` are the centres of
    /// the first Gaussians.
    fn of(camera: &Camera, means: &[Vec3], seen: &[Vec3]) -> Self {
        let camera = camera.shrunk_to(DEPTH_MAP_SIDE);
        let depths = sorted(
            means
                .iter()
                .filter_map(|mean| camera.pixel_and_depth(*mean))
                .map(|(_, depth)| depth),
        );
        let distances = sorted(means.iter().map(|mean| mean.distance(camera.centre())));
        let [mut near, mut radius] = [0.0; 2];
        if depths.len() >= MIN_GAUSSIANS {
            let share = NEAR_SHARE * depths[depths.len() / 2];
            near = share.min(depths[depths.len() / OUTLIER]);
            // Other cameras may see Gaussians that this one does not, so at most MIN_GAUSSIANS of
            // them are treated as outliers.
            radius = share.min(distances[(distances.len() / OUTLIER).min(MIN_GAUSSIANS)]);
        }
        let pixels = (camera.width * camera.height) as usize;
        let (mut near_a_point, mut nearest) = (vec![false; pixels], vec![f32::INFINITY; pixels]);
        for (pixel, depth) in seen
            .iter()
            .filter_map(|point| camera.pixel_and_depth(*point))
        {
            neighbourhood(&camera, pixel, FREE_RADIUS).for_each(|at| near_a_point[at] = true);
            neighbourhood(&camera, pixel, LIMIT_RADIUS)
                .for_each(|at| nearest[at] = nearest[at].min(depth));
        }
        let depth = near_a_point
            .into_iter()
            .zip(nearest)
            .map(|(known, nearest)| {
                if known {
                    near.max(FREE_SHARE * nearest)
                } else {
                    near
                }
            })
            .collect();
        Self {
            centre: camera.centre(),
            camera,
            depth,
            radius,
        }
    }

    fn contains(&self, place: Vec3) -> bool {
        let before = || {
            self.camera
                .pixel_and_depth(place)
                .is_some_and(|(pixel, depth)| depth < self.depth[pixel])
        };
        self.centre.distance(place) < self.radius || before()
    }
}

/// Returns the indices of the pixels up to `reach` columns and rows from a pixel, itself included.
pub(crate) fn neighbourhood(
    camera: &Camera,
    pixel: usize,
    reach: usize,
) -> impl Iterator<Item = usize> {
    let [width, height] = [camera.width, camera.height].map(|side| side as usize);
    let range_around =
        |at: usize, side: usize| at.saturating_sub(reach)..(at + reach + 1).min(side);
    let (columns, rows) = (
        range_around(pixel % width, width),
        range_around(pixel / width, height),
    );
    rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
}

/// The free space of all cameras.
#[derive(Clone, Debug, Default)]
pub struct FreeSpace {
    cameras: Vec<CameraFreeSpace>,
    /// Number of cameras to which space must be free.
    min_cameras: usize,
}

impl FreeSpace {
    /// Computes the free space of `cameras` from the centres of the first Gaussians and from
    /// points. The [`SfmPoint::seen_by`] of the points are indices of `cameras`. Nothing is free
    /// with `FEW_VIEWS` cameras or more.
    pub fn of(cameras: &[Camera], means: &[Vec3], points: &[SfmPoint]) -> Self {
        if cameras.len() >= FEW_VIEWS {
            return Self::default();
        }
        let mut seen = vec![Vec::new(); cameras.len()];
        for point in points
            .iter()
            .filter(|point| point.seen_by.len() >= MIN_CAMERAS)
        {
            for view in &point.seen_by {
                if let Some(seen) = seen.get_mut(*view as usize) {
                    seen.push(point.position);
                }
            }
        }
        let of = |(camera, seen): (&Camera, &Vec<Vec3>)| CameraFreeSpace::of(camera, means, seen);
        Self {
            cameras: cameras.par_iter().zip(&seen).map(of).collect(),
            min_cameras: 1,
        }
    }

    /// Returns the space before surfaces that at least two cameras see. `maps` has a
    /// camera and the depths at its pixels, row by row; 0 where no surface is known.
    pub fn before_surfaces<'a>(maps: impl Iterator<Item = (&'a Camera, &'a [f32])>) -> Self {
        let of = |(camera, depth): (&Camera, &[f32])| CameraFreeSpace {
            camera: camera.clone(),
            depth: depth.iter().map(|depth| BEFORE_SURFACE * depth).collect(),
            centre: camera.centre(),
            radius: 0.0,
        };
        Self {
            cameras: maps.map(of).collect(),
            min_cameras: MIN_VIEWS,
        }
    }

    /// Returns whether a position lies in free space.
    pub(crate) fn contains(&self, place: Vec3) -> bool {
        let free = self.cameras.iter().filter(|free| free.contains(place));
        self.min_cameras > 0 && free.take(self.min_cameras).count() == self.min_cameras
    }
}

/// Returns the values in ascending order.
fn sorted(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let mut values: Vec<f32> = values.collect();
    values.sort_by(f32::total_cmp);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    fn camera(x: f32) -> Camera {
        Camera::look_at(
            "a",
            Vec3::new(x, 0.0, -4.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        )
    }

    fn point(position: Vec3, seen_by: &[u32]) -> SfmPoint {
        SfmPoint {
            position,
            color: [9; 3],
            seen_by: seen_by.to_vec(),
        }
    }

    #[test]
    fn space_between_a_camera_and_a_point_is_free() {
        // The second camera stands aside, the third looks away.
        let away = Camera::look_at(
            "b",
            Vec3::new(0.0, 0.0, -4.0),
            Vec3::new(0.0, 0.0, -8.0),
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let cameras = [camera(0.0), camera(3.0), away];
        let free = FreeSpace::of(
            &cameras,
            &[],
            &[
                point(Vec3::ZERO, &[0, 2, 7]),
                point(4.0 * Vec3::Z, &[1, 2, 7]),
            ],
        );
        assert!(
            free.contains(-Vec3::Z) && free.contains(-3.9 * Vec3::Z),
            "in front of the nearer point, seen from the first camera"
        );
        assert!(!free.contains(-0.5 * Vec3::Z), "too near to the point");
        assert!(
            !free.contains(Vec3::Z) && !free.contains(-5.0 * Vec3::Z),
            "behind the point, and behind the camera"
        );
        assert!(
            free.contains(Vec3::new(1.5, 0.0, 0.0)),
            "in front of the farther point, seen from the second camera"
        );
        for seen_by in [vec![], vec![0, 1]] {
            assert!(
                !FreeSpace::of(&cameras, &[], &[point(Vec3::ZERO, &seen_by)]).contains(-Vec3::Z),
                "too few cameras agree: {seen_by:?}"
            );
        }
        let many: Vec<Camera> = (0..FEW_VIEWS).map(|k| camera(0.01 * k as f32)).collect();
        assert!(
            !FreeSpace::of(&many, &[], &[point(Vec3::ZERO, &[0, 1, 2])]).contains(-Vec3::Z),
            "with many views no space is free"
        );
    }

    #[test]
    fn a_point_frees_near_pixels_and_limits_farther_ones() {
        // Twice as wide as the depth maps.
        let wide = Camera::look_at(
            "a",
            -4.0 * Vec3::Z,
            Vec3::ZERO,
            Vec3::Y,
            2 * DEPTH_MAP_SIDE,
            DEPTH_MAP_SIDE,
            0.8,
        );
        let sight = wide.shrunk_to(DEPTH_MAP_SIDE);
        let at = |column: f32, depth: f32| {
            let middle = Vec2::new(column + 0.5, (DEPTH_MAP_SIDE / 4) as f32 + 0.5);
            sight
                .world_to_camera
                .inverse()
                .transform_point3(sight.ray(middle) * depth)
        };
        let free = |points: &[(f32, f32)]| {
            let points: Vec<SfmPoint> = points
                .iter()
                .map(|(column, depth)| point(at(*column, *depth), &[0, 1, 2]))
                .collect();
            FreeSpace::of(std::slice::from_ref(&wide), &[], &points)
        };
        let one = free(&[(100.0, 4.0)]);
        let reach = FREE_RADIUS as f32;
        assert!(one.contains(at(100.0 - reach, 3.0)) && one.contains(at(100.0 + reach, 3.0)));
        assert!(
            !one.contains(at(99.0 - reach, 3.0)) && !one.contains(at(101.0 + reach, 3.0)),
            "no point is near these pixels"
        );
        let two = |apart: f32| free(&[(100.0, 4.0), (100.0 + apart, 2.0)]);
        let (near, far) = (two(LIMIT_RADIUS as f32), two((LIMIT_RADIUS + 1) as f32));
        assert!(
            !near.contains(at(100.0, 3.0)) && near.contains(at(100.0, 1.0)),
            "free only up to the nearer point beside it"
        );
        assert!(
            far.contains(at(100.0, 3.0)),
            "the nearer point is too far beside it"
        );
    }

    #[test]
    fn space_before_surfaces_of_two_cameras_is_free() {
        let cameras = [camera(0.0), camera(1.0), camera(-1.0)];
        let pixels = (cameras[0].width * cameras[0].height) as usize;
        let depths = [4.0, 4.0, 0.0].map(|depth| vec![depth; pixels]);
        let free = |views: std::ops::Range<usize>| {
            let maps = cameras[views.clone()].iter().zip(&depths[views]);
            let maps = maps.map(|(camera, depth)| (camera, depth.as_slice()));
            FreeSpace::before_surfaces(maps)
        };
        let both = free(0..3);
        assert!(both.contains(-Vec3::Z), "before both surfaces");
        assert!(!both.contains(-0.2 * Vec3::Z), "on the surfaces");
        assert!(!both.contains(-4.0 * Vec3::Z), "at a camera");
        assert!(!free(0..1).contains(-Vec3::Z), "one camera is not enough");
        assert!(
            !free(1..3).contains(-Vec3::Z),
            "an unknown surface does not count"
        );
        assert!(!FreeSpace::default().contains(-Vec3::Z));
    }

    #[test]
    fn space_near_a_camera_is_free() {
        let row = |count: usize, first: f32, z: f32| {
            (0..count).map(move |k| Vec3::new(0.01 * k as f32 + first, 0.0, z))
        };
        let mut means: Vec<Vec3> = row(100, -0.5, 0.0).collect();
        // One Gaussian is wrong.
        means.push(Vec3::new(0.0, 0.0, -3.9));
        let free = FreeSpace::of(&[camera(0.0), camera(0.3)], &means, &[]);
        assert!(
            free.contains(Vec3::new(0.0, 0.0, -3.3)) && free.contains(Vec3::new(0.3, 0.0, -3.5))
        );
        assert!(
            !free.contains(Vec3::new(0.0, 0.0, -1.0)),
            "far enough from the cameras"
        );
        assert!(
            free.contains(Vec3::new(-0.5, 0.0, -4.2)),
            "around the cameras"
        );
        assert!(
            !free.contains(Vec3::new(2.0, 0.0, -3.5)),
            "far beside the views of the cameras"
        );
        let free_before = |means: &[Vec3]| {
            FreeSpace::of(&[camera(0.0), camera(0.3)], means, &[])
                .contains(Vec3::new(-0.5, 0.0, -4.2))
        };
        let walled: Vec<Vec3> = means.iter().copied().chain(row(500, -2.5, -4.3)).collect();
        assert!(
            free_before(&means) && !free_before(&walled),
            "many Gaussians behind the cameras are a wall"
        );
        assert!(
            !FreeSpace::of(&[camera(0.0)], &means[..10], &[]).contains(Vec3::new(0.0, 0.0, -3.0)),
            "ten Gaussians are too few"
        );
        let near_point = [point(Vec3::new(0.0, 0.0, -3.9), &[0, 1, 2])];
        assert!(
            FreeSpace::of(&[camera(0.0)], &means, &near_point).contains(Vec3::new(0.0, 0.0, -3.3)),
            "a nearer point does not reduce free space"
        );
    }
}
