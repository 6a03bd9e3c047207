//! Floaters: Gaussians that show one photo to itself and are fog to all others. Where photos are few nothing in the loss speaks against them, but what
//! training starts from does.
//!
//! From a camera to a point that it and two others agree on there is nothing: two choices of 17 photos of the generated table, 1,000 steps, gain 12 points of
//! oracle mIoU by it. Also where a camera knows no point, what is nearer than a fifth of the median depth of the first Gaussians is none of the scene: a larger
//! share takes the near ends of bare surfaces. Nor is there anything around a camera, in what it does not see: a haze of the wall's colour that photos from
//! the other side see before that wall hides all from a view between two cameras (of 17 photos of the table 29 dB instead of 33).
//!
//! Where photos are many they speak for themselves. Things then stand near to some camera or other: of an office with 56 views nearness and surroundings
//! took 1.2 dB. And a wire is thinner than what photos are compared by, so that they agree on the wall behind it (thin, 35 views: points alone, without
//! `BESIDE`, left 31.0 dB of 35.7).

use fastlgs_core::Camera;
use fastlgs_core::dataset::SfmPoint;
use glam::Vec3;
use rayon::prelude::*;

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
/// Cameras that have to agree on a point: two lines of sight meet wherever both look.
const AGREE: usize = 3;
/// Share of the median depth of the first Gaussians before a camera within which nothing is, unless more than a few of them are.
const NEAR: f32 = 0.2;
/// Each how-manieth of these may be wrong.
const OUTLIER: usize = 50;
/// Fewest of these by which a camera tells what is near.
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
    /// That of a camera which is known to see `seen`, where training starts from Gaussians at `means`.
    fn of(camera: &Camera, means: &[Vec3], seen: &[Vec3]) -> Self {
        let camera = camera.shrunk_to(SIDE);
        let depths = sorted(means.iter().filter_map(|mean| camera.see(*mean)).map(|(_, depth)| depth));
        let distances = sorted(means.iter().map(|mean| mean.distance(camera.centre())));
        let [mut near, mut radius] = [0.0; 2];
        if depths.len() >= FEW {
            let share = NEAR * depths[depths.len() / 2];
            near = share.min(depths[depths.len() / OUTLIER]);
            // What a camera does not see may be well known by others: few of these Gaussians can be wrong.
            radius = share.min(distances[(distances.len() / OUTLIER).min(FEW)]);
        }
        let pixels = (camera.width * camera.height) as usize;
        let (mut known, mut nearest) = (vec![false; pixels], vec![f32::INFINITY; pixels]);
        for (pixel, depth) in seen.iter().filter_map(|point| camera.see(*point)) {
            around(&camera, pixel, AROUND).for_each(|at| known[at] = true);
            around(&camera, pixel, BESIDE).for_each(|at| nearest[at] = nearest[at].min(depth));
        }
        let depth = known.into_iter().zip(nearest).map(|(known, nearest)| if known { near.max(BEFORE * nearest) } else { near }).collect();
        Self { centre: camera.centre(), camera, depth, radius }
    }

    fn holds(&self, place: Vec3) -> bool {
        let before = || self.camera.see(place).is_some_and(|(pixel, depth)| depth < self.depth[pixel]);
        self.centre.distance(place) < self.radius || before()
    }
}

/// Numbers of the pixels up to `reach` beside a pixel, itself included.
pub(crate) fn around(camera: &Camera, pixel: usize, reach: usize) -> impl Iterator<Item = usize> {
    let [width, height] = [camera.width, camera.height].map(|side| side as usize);
    let beside = |at: usize, side: usize| at.saturating_sub(reach)..(at + reach + 1).min(side);
    let (columns, rows) = (beside(pixel % width, width), beside(pixel / width, height));
    rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
}

/// The free space before and around cameras.
#[derive(Clone, Debug, Default)]
pub struct FreeSpace(Vec<Free>);

impl FreeSpace {
    /// What is free of `cameras` by the means of the first Gaussians, and by points whose [`SfmPoint::seen_by`] are numbers of these cameras; nothing where
    /// cameras are many.
    pub fn of(cameras: &[Camera], means: &[Vec3], points: &[SfmPoint]) -> Self {
        if cameras.len() >= FEW_VIEWS {
            return Self::default();
        }
        let mut seen = vec![Vec::new(); cameras.len()];
        for point in points.iter().filter(|point| point.seen_by.len() >= AGREE) {
            for view in &point.seen_by {
                if let Some(seen) = seen.get_mut(*view as usize) {
                    seen.push(point.position);
                }
            }
        }
        Self(cameras.par_iter().zip(&seen).map(|(camera, seen)| Free::of(camera, means, seen)).collect())
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
    use glam::Vec2;

    fn camera(x: f32) -> Camera {
        Camera::look_at("a", Vec3::new(x, 0.0, -4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8)
    }

    fn point(position: Vec3, seen_by: &[u32]) -> SfmPoint {
        SfmPoint { position, color: [9; 3], seen_by: seen_by.to_vec() }
    }

    #[test]
    fn what_a_camera_sees_a_point_through_is_free() {
        // A second camera aside, and one that looks away.
        let away = Camera::look_at("b", Vec3::new(0.0, 0.0, -4.0), Vec3::new(0.0, 0.0, -8.0), Vec3::Y, 64, 48, 0.8);
        let cameras = [camera(0.0), camera(3.0), away];
        let free = FreeSpace::of(&cameras, &[], &[point(Vec3::ZERO, &[0, 2, 7]), point(4.0 * Vec3::Z, &[1, 2, 7])]);
        assert!(free.holds(-Vec3::Z) && free.holds(-3.9 * Vec3::Z), "before the nearer point, as the first camera sees it");
        assert!(!free.holds(-0.5 * Vec3::Z), "too near to the point");
        assert!(!free.holds(Vec3::Z) && !free.holds(-5.0 * Vec3::Z), "behind the point, and behind the camera");
        assert!(free.holds(Vec3::new(1.5, 0.0, 0.0)), "the second camera sees the farther point over there");
        for seen_by in [vec![], vec![0, 1]] {
            assert!(!FreeSpace::of(&cameras, &[], &[point(Vec3::ZERO, &seen_by)]).holds(-Vec3::Z), "too few agree: {seen_by:?}");
        }
        let many: Vec<Camera> = (0..FEW_VIEWS).map(|k| camera(0.01 * k as f32)).collect();
        assert!(!FreeSpace::of(&many, &[], &[point(Vec3::ZERO, &[0, 1, 2])]).holds(-Vec3::Z), "many views speak for themselves");
    }

    #[test]
    fn a_point_speaks_for_few_pixels_and_limits_more() {
        // Twice as wide as the pictures of depth.
        let wide = Camera::look_at("a", -4.0 * Vec3::Z, Vec3::ZERO, Vec3::Y, 2 * SIDE, SIDE, 0.8);
        let sight = wide.shrunk_to(SIDE);
        let at = |column: f32, depth: f32| {
            let middle = Vec2::new(column + 0.5, (SIDE / 4) as f32 + 0.5);
            sight.world_to_camera.inverse().transform_point3(sight.ray(middle) * depth)
        };
        let free = |points: &[(f32, f32)]| {
            let points: Vec<SfmPoint> = points.iter().map(|(column, depth)| point(at(*column, *depth), &[0, 1, 2])).collect();
            FreeSpace::of(std::slice::from_ref(&wide), &[], &points)
        };
        let one = free(&[(100.0, 4.0)]);
        let reach = AROUND as f32;
        assert!(one.holds(at(100.0 - reach, 3.0)) && one.holds(at(100.0 + reach, 3.0)));
        assert!(!one.holds(at(99.0 - reach, 3.0)) && !one.holds(at(101.0 + reach, 3.0)), "nothing is known there");
        let two = |apart: f32| free(&[(100.0, 4.0), (100.0 + apart, 2.0)]);
        let (near, far) = (two(BESIDE as f32), two((BESIDE + 1) as f32));
        assert!(!near.holds(at(100.0, 3.0)) && near.holds(at(100.0, 1.0)), "as far as what is nearer beside it");
        assert!(far.holds(at(100.0, 3.0)), "that is too far beside");
    }

    #[test]
    fn what_hangs_before_a_camera_is_no_part_of_the_scene() {
        let row = |count: usize, first: f32, z: f32| (0..count).map(move |k| Vec3::new(0.01 * k as f32 + first, 0.0, z));
        let mut means: Vec<Vec3> = row(100, -0.5, 0.0).collect();
        // One is wrong.
        means.push(Vec3::new(0.0, 0.0, -3.9));
        let free = FreeSpace::of(&[camera(0.0), camera(0.3)], &means, &[]);
        assert!(free.holds(Vec3::new(0.0, 0.0, -3.3)) && free.holds(Vec3::new(0.3, 0.0, -3.5)));
        assert!(!free.holds(Vec3::new(0.0, 0.0, -1.0)), "far enough");
        assert!(free.holds(Vec3::new(-0.5, 0.0, -4.2)), "around them, too");
        assert!(!free.holds(Vec3::new(2.0, 0.0, -3.5)), "far beside what they see");
        let free_before = |means: &[Vec3]| FreeSpace::of(&[camera(0.0), camera(0.3)], means, &[]).holds(Vec3::new(-0.5, 0.0, -4.2));
        let walled: Vec<Vec3> = means.iter().copied().chain(row(500, -2.5, -4.3)).collect();
        assert!(free_before(&means) && !free_before(&walled), "a wall behind them is one");
        assert!(!FreeSpace::of(&[camera(0.0)], &means[..10], &[]).holds(Vec3::new(0.0, 0.0, -3.0)), "ten tell nothing");
        let near_point = [point(Vec3::new(0.0, 0.0, -3.9), &[0, 1, 2])];
        assert!(
            FreeSpace::of(&[camera(0.0)], &means, &near_point).holds(Vec3::new(0.0, 0.0, -3.3)),
            "a point that is nearer frees no less"
        );
    }
}
