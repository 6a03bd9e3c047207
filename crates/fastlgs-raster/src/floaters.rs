//! Floaters: Gaussians that show one photo to itself and are fog to all others. Where photos are few nothing in the loss speaks against them, but what
//! training starts from does: points that several photos agree on.
//!
//! From a camera that is known to see a point there is nothing up to it. Of 17 photos of the generated table runs of 1,000 steps gain 12 points of oracle
//! mIoU by it. Where a camera sees no point, what is nearer than a fifth of the points' median depth is none of the scene: a larger share takes the near
//! ends of bare surfaces. Nor is there anything around a camera, in what it does not see: a haze of the wall's colour that photos from the other side see
//! before that wall hides all from a view between two cameras (of 17 photos of the table 29 dB instead of 33).
//!
//! Where photos are many they speak for themselves. Things then stand near to some camera or other (of an office with 56 views free space took 1.2 dB),
//! and a wire is thinner than what photos are compared by, so that they agree on the wall behind it (thin, 35 views: 31.0 dB instead of 35.7).

use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::Vec3;

/// Fewer views than these are few: what one of them shows is not contradicted by others.
pub const FEW_VIEWS: usize = 25;
/// Share of the way to a point that is free.
const BEFORE: f32 = 0.85;
/// Longer side of the pictures of depth: as fine as photos are compared for points.
const SIDE: u32 = 240;
/// Pixels around a point's own where it tells that there is one.
const AROUND: usize = 1;
/// Pixels around a point's own in which nothing is free behind it: a wire has few points, and is seen as the wall behind it is between these. With none
/// around, half of the views of the generated wires lose 1.2 dB by free space; with 4 they lose 0.5, with 8 nothing.
const BESIDE: usize = 8;
/// Share of the median depth of a camera's points within which nothing is, unless more than a few of them are.
const NEAR: f32 = 0.2;
/// Each how-manieth of the points may be wrong.
const OUTLIER: usize = 50;
/// Fewest points by which a camera tells what is near.
const FEW: usize = 50;

/// The free space of a camera.
#[derive(Clone, Debug)]
struct Free {
    /// At most [`SIDE`] pixels wide and high.
    camera: Camera,
    /// How deep it is free before each pixel, row by row.
    depth: Vec<f32>,
    /// Where the camera stands, and how far around it is free.
    centre: Vec3,
    radius: f32,
}

impl Free {
    /// That of a camera which sees `seen` of the `points`.
    fn of(camera: &Camera, points: &[SfmPoint], seen: &[Vec3]) -> Self {
        let camera = camera.shrunk_to(SIDE);
        let depths = sorted(points.iter().filter_map(|p| look(&camera, p.position)).map(|(_, depth)| depth));
        let distances = sorted(points.iter().map(|p| p.position.distance(camera.centre())));
        let [mut near, mut radius] = [0.0; 2];
        if depths.len() >= FEW {
            let share = NEAR * depths[depths.len() / 2];
            near = share.min(depths[depths.len() / OUTLIER]);
            // What a camera does not see may be well known by others: few of these points can be wrong.
            radius = share.min(distances[(distances.len() / OUTLIER).min(FEW)]);
        }
        let pixels = (camera.width * camera.height) as usize;
        let (mut known, mut nearest) = (vec![false; pixels], vec![f32::INFINITY; pixels]);
        for (pixel, depth) in seen.iter().filter_map(|point| look(&camera, *point)) {
            around(&camera, pixel, AROUND).for_each(|at| known[at] = true);
            around(&camera, pixel, BESIDE).for_each(|at| nearest[at] = nearest[at].min(depth));
        }
        let depth = known.into_iter().zip(nearest).map(|(known, nearest)| if known { near.max(BEFORE * nearest) } else { near }).collect();
        Self { centre: camera.centre(), camera, depth, radius }
    }

    fn holds(&self, place: Vec3) -> bool {
        let before = || look(&self.camera, place).is_some_and(|(pixel, depth)| depth < self.depth[pixel]);
        self.centre.distance(place) < self.radius || before()
    }
}

/// Number of the pixel in which a camera sees a place, and how deep.
fn look(camera: &Camera, place: Vec3) -> Option<(usize, f32)> {
    let q = camera.world_to_camera.transform_point3(place);
    let pixel = camera.to_pixel(q);
    let inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < camera.width as f32 && pixel.y < camera.height as f32;
    (q.z > 0.0 && inside).then(|| (pixel.y as usize * camera.width as usize + pixel.x as usize, q.z))
}

/// Numbers of the pixels up to `reach` beside a pixel, itself included.
fn around(camera: &Camera, pixel: usize, reach: usize) -> impl Iterator<Item = usize> {
    let [width, height] = [camera.width, camera.height].map(|side| side as usize);
    let beside = |at: usize, side: usize| at.saturating_sub(reach)..(at + reach + 1).min(side);
    let (columns, rows) = (beside(pixel % width, width), beside(pixel / width, height));
    rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
}

/// The free space before and around cameras.
#[derive(Clone, Debug, Default)]
pub struct FreeSpace(Vec<Free>);

impl FreeSpace {
    /// What is free of `cameras` by the points that training starts from, whose [`SfmPoint::seen_by`] are numbers of these; nothing where cameras are many.
    pub fn of(cameras: &[Camera], points: &[SfmPoint]) -> Self {
        if cameras.len() >= FEW_VIEWS {
            return Self::default();
        }
        let mut seen = vec![Vec::new(); cameras.len()];
        for point in points {
            for view in &point.seen_by {
                if let Some(seen) = seen.get_mut(*view as usize) {
                    seen.push(point.position);
                }
            }
        }
        Self(cameras.iter().zip(&seen).map(|(camera, seen)| Free::of(camera, points, seen)).collect())
    }

    /// Whether a place lies in it.
    pub(crate) fn holds(&self, place: Vec3) -> bool {
        self.0.iter().any(|free| free.holds(place))
    }
}

/// From small to large.
fn sorted(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let mut values: Vec<f32> = values.collect();
    values.sort_by(f32::total_cmp);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(x: f32) -> Camera {
        Camera::look_at("a", Vec3::new(x, 0.0, -4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8)
    }

    fn point(position: Vec3, seen_by: &[u32]) -> SfmPoint {
        SfmPoint { position, color: [9; 3], seen_by: seen_by.to_vec() }
    }

    #[test]
    fn what_a_camera_sees_a_point_through_is_free() {
        let free = FreeSpace::of(&[camera(0.0), camera(3.0)], &[point(Vec3::ZERO, &[0]), point(4.0 * Vec3::Z, &[1, 7])]);
        assert!(free.holds(-Vec3::Z) && free.holds(-3.9 * Vec3::Z), "before the nearer point, as the first camera sees it");
        assert!(!free.holds(-0.5 * Vec3::Z), "too near to the point");
        assert!(!free.holds(Vec3::Z) && !free.holds(-5.0 * Vec3::Z), "behind the point, and behind the camera");
        assert!(!free.holds(Vec3::new(1.0, 0.0, -1.0)), "where no point is seen");
        assert!(free.holds(Vec3::new(1.5, 0.0, 0.0)), "the second camera sees the farther point over there");
        assert!(!FreeSpace::of(&[camera(0.0)], &[point(Vec3::ZERO, &[])]).holds(-Vec3::Z), "nobody is known to see it");
        let points = [0.0, -3.0, 0.0].map(|z| point(Vec3::Z * z, &[0]));
        let nearest = FreeSpace::of(&[camera(0.0)], &points);
        assert!(!nearest.holds(-Vec3::Z) && nearest.holds(-3.5 * Vec3::Z), "the nearest point counts");
        let many: Vec<Camera> = (0..FEW_VIEWS).map(|k| camera(0.01 * k as f32)).collect();
        assert!(!FreeSpace::of(&many, &points).holds(-3.5 * Vec3::Z), "many views speak for themselves");
    }

    #[test]
    fn what_hangs_before_a_camera_is_no_part_of_the_scene() {
        let row = |count: usize, first: f32, z: f32| (0..count).map(move |k| point(Vec3::new(0.01 * k as f32 + first, 0.0, z), &[]));
        let mut points: Vec<SfmPoint> = row(100, -0.5, 0.0).collect();
        // One point is wrong.
        points.push(point(Vec3::new(0.0, 0.0, -3.9), &[]));
        let free = FreeSpace::of(&[camera(0.0), camera(0.3)], &points);
        assert!(free.holds(Vec3::new(0.0, 0.0, -3.3)) && free.holds(Vec3::new(0.3, 0.0, -3.5)));
        assert!(!free.holds(Vec3::new(0.0, 0.0, -1.0)), "far enough");
        assert!(free.holds(Vec3::new(-0.5, 0.0, -4.2)), "around them, too");
        assert!(!free.holds(Vec3::new(2.0, 0.0, -3.5)), "far beside what they see");
        let free_before = |points: &[SfmPoint]| FreeSpace::of(&[camera(0.0), camera(0.3)], points).holds(Vec3::new(-0.5, 0.0, -4.2));
        let walled: Vec<SfmPoint> = points.iter().cloned().chain(row(500, -2.5, -4.3)).collect();
        assert!(free_before(&points) && !free_before(&walled), "a wall behind them is one");
        assert!(!FreeSpace::of(&[camera(0.0)], &points[..10]).holds(Vec3::new(0.0, 0.0, -3.0)), "ten points tell nothing");
    }
}
