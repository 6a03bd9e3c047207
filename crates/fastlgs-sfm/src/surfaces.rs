//! Surfaces where photos have no texture: planes through the points that a mask shows.
//!
//! Plane sweep stereo finds no depth on bare walls, floors and ceilings, but it finds their edges,
//! and what hangs on them. If most points of a mask lie on a plane, the whole mask is assumed to
//! show that plane (as in PlanarGS, 2025). The other views verify each pixel: at least one must see
//! a surface at the same depth, and not more of them may look through it.

use crate::depth_map::DepthMap;
use crate::plane::Plane;
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, LabelMap};
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;
use std::collections::{BTreeMap, VecDeque};

/// Longer side of the depth maps, in pixels.
const SIDE: u32 = 128;
/// Factor by which a plane may extend beyond the nearest and farthest points of its view.
const RANGE_FACTOR: f64 = 1.5;
/// Share of the nearest and farthest points that is ignored.
const OUTLIERS: f64 = 0.01;
/// Largest number of other views that verify a view.
const WITNESSES: usize = 24;
/// Relative depth difference up to which two views see the same surface.
const SAME_DEPTH: f32 = 0.05;
/// Factor of depth from which another view looks through a surface.
const LOOKS_THROUGH: f32 = 1.1;
/// Spacing of new points in pixels of the depth maps.
const SPACING: usize = 3;

/// Depth maps of the surfaces that all views show.
pub struct Surfaces {
    /// One map for each camera; 0 where no surface is known.
    pub maps: Vec<DepthMap>,
    /// Depths of the points themselves, with the same sizes.
    points: Vec<DepthMap>,
    /// For each view, the views that share points with it, most first.
    witnesses: Vec<Vec<usize>>,
}

impl Surfaces {
    /// Fits planes to `points`, whose [`SfmPoint::seen_by`] are indices of `cameras`. `masks`
    /// returns the label map of a view: 0 where there is no mask.
    ///
    /// # Errors
    /// Errors of `masks`.
    pub fn new<E: Send>(
        cameras: &[Camera],
        points: &[SfmPoint],
        masks: impl Fn(usize) -> Result<LabelMap, E> + Sync,
    ) -> Result<Self, E> {
        let seen = points_by_view(cameras.len(), points);
        let witnesses = witnesses(&seen, points);
        let views = (0..cameras.len()).into_par_iter().map(|view| {
            let camera = cameras[view].shrunk_to(SIDE);
            let labels = masks(view)?.resized(camera.width, camera.height).labels;
            let seen: Vec<Vec3> = seen[view].iter().map(|p| points[*p].position).collect();
            let mut known = DepthMap::empty(camera.clone());
            seen.iter().for_each(|position| known.add(*position));
            let map = planes(view, DepthMap::empty(camera), &labels, &seen, &[]);
            Ok((map, (known, (labels, seen))))
        });
        let views: Vec<_> = views.collect::<Result<_, E>>()?;
        let (maps, (known, views)): (_, (_, Vec<_>)) = views.into_iter().unzip();
        let first = Self {
            maps,
            points: known,
            witnesses,
        }
        .verified();
        // Points on the surfaces of other views support planes of which a view sees few points.
        let others = first.new_points(|_, _| [0; 3]);
        let extended = views.par_iter().enumerate().map(|(view, (labels, seen))| {
            let visible = others.iter().map(|point| point.position);
            let visible: Vec<Vec3> = visible.filter(|p| first.is_open(view, *p)).collect();
            planes(view, first.maps[view].clone(), labels, seen, &visible)
        });
        let maps = extended.collect();
        Ok(Self { maps, ..first }.verified())
    }

    /// Returns whether a view may see `place`: no surface and no nearer point is known at its
    /// pixel.
    fn is_open(&self, view: usize, place: Vec3) -> bool {
        let seen = self.maps[view].camera.pixel_and_depth(place);
        seen.is_some_and(|(pixel, depth)| {
            let point = self.points[view].depth[pixel];
            let is_hidden = point > 0.0 && point < depth * (1.0 - SAME_DEPTH);
            self.maps[view].depth[pixel] <= 0.0 && !is_hidden
        })
    }

    /// Returns the surfaces without the pixels that other views do not confirm.
    fn verified(self) -> Self {
        let maps = (0..self.maps.len()).into_par_iter().map(|view| {
            let map = &self.maps[view];
            let confirm = |pixel: usize| {
                let depth = map.depth[pixel];
                if depth > 0.0 && self.is_confirmed(view, map.point(pixel)) {
                    depth
                } else {
                    0.0
                }
            };
            DepthMap {
                camera: map.camera.clone(),
                depth: (0..map.depth.len()).map(confirm).collect(),
            }
        });
        Self {
            maps: maps.collect(),
            ..self
        }
    }

    /// Returns whether at least one other view sees a surface at `place`, and not more of them look
    /// through it.
    fn is_confirmed(&self, view: usize, place: Vec3) -> bool {
        let [mut same, mut through] = [0; 2];
        for &other in &self.witnesses[view] {
            let Some((pixel, depth)) = self.maps[other].camera.pixel_and_depth(place) else {
                continue;
            };
            let surface = self.maps[other].depth[pixel];
            let point = self.points[other].depth[pixel];
            if surface > 0.0 && (surface / depth - 1.0).abs() < SAME_DEPTH {
                same += 1;
            }
            if surface.max(point) > LOOKS_THROUGH * depth {
                through += 1;
            }
        }
        same >= 1 && through <= same
    }

    /// Returns new points on the surfaces where no point is known, one for each pixel of a grid
    /// that no other view has covered. `color` returns the colour at a position (0 to 1 of width
    /// and height) of a view's photo.
    pub fn new_points(&self, color: impl Fn(usize, Vec2) -> [u8; 3]) -> Vec<SfmPoint> {
        let is_known = |map: &DepthMap| map.depth.iter().map(|d| *d > 0.0).collect();
        let mut covered: Vec<Vec<bool>> = self.points.iter().map(is_known).collect();
        let mut out = Vec::new();
        for (view, map) in self.maps.iter().enumerate() {
            let [width, height] = [map.camera.width, map.camera.height].map(|s| s as usize);
            let grid = (SPACING / 2..height)
                .step_by(SPACING)
                .flat_map(|y| (SPACING / 2..width).step_by(SPACING).map(move |x| (x, y)));
            for (x, y) in grid {
                let pixel = y * width + x;
                if map.depth[pixel] <= 0.0 || covered[view][pixel] {
                    continue;
                }
                let position = map.point(pixel);
                let place = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                out.push(SfmPoint {
                    position,
                    color: color(view, place / Vec2::new(width as f32, height as f32)),
                    seen_by: vec![view as u32],
                });
                for &other in &self.witnesses[view] {
                    self.cover(other, position, &mut covered[other]);
                }
            }
        }
        out
    }

    /// Marks the pixels of a view around a new point on the same surface.
    fn cover(&self, view: usize, position: Vec3, covered: &mut [bool]) {
        let map = &self.maps[view];
        let Some((pixel, depth)) = map.camera.pixel_and_depth(position) else {
            return;
        };
        let [width, height] = [map.camera.width, map.camera.height].map(|s| s as usize);
        let reach = SPACING / 2;
        let around = |at: usize, side: usize| at.saturating_sub(reach)..(at + reach + 1).min(side);
        for y in around(pixel / width, height) {
            for x in around(pixel % width, width) {
                let at = y * width + x;
                covered[at] |= (map.depth[at] / depth - 1.0).abs() < SAME_DEPTH;
            }
        }
    }
}

/// Returns the indices of the points that each view sees.
fn points_by_view(views: usize, points: &[SfmPoint]) -> Vec<Vec<usize>> {
    let mut seen = vec![Vec::new(); views];
    for (k, point) in points.iter().enumerate() {
        for view in &point.seen_by {
            if let Some(seen) = seen.get_mut(*view as usize) {
                seen.push(k);
            }
        }
    }
    seen
}

/// Returns for each view the other views that see the same points, at most [`WITNESSES`], those
/// with most common points first.
fn witnesses(seen: &[Vec<usize>], points: &[SfmPoint]) -> Vec<Vec<usize>> {
    let of = |(view, seen): (usize, &Vec<usize>)| {
        let mut common: BTreeMap<usize, usize> = BTreeMap::new();
        for other in seen.iter().flat_map(|p| &points[*p].seen_by) {
            if *other as usize != view {
                *common.entry(*other as usize).or_default() += 1;
            }
        }
        let mut views: Vec<(usize, usize)> = common.into_iter().collect();
        views.sort_by_key(|(view, count)| (std::cmp::Reverse(*count), *view));
        views.into_iter().take(WITNESSES).map(|v| v.0).collect()
    };
    seen.iter().enumerate().map(of).collect()
}

/// Points of a mask: camera-space positions, and pixels of the depth map.
#[derive(Default)]
struct MaskPoints {
    positions: Vec<DVec3>,
    pixels: Vec<usize>,
    /// Number of points that the view itself sees; they come first.
    own: usize,
}

/// Adds the depth of the planes of a view's masks to `map`, where it is unknown. `seen` are the
/// points that the view sees, `others` further points that it may see.
///
/// Each pixel takes the plane of the nearest point within its mask, and none if that point lies on
/// no plane. A mask may show several planes, such as the walls of a room.
fn planes(
    view: usize,
    mut map: DepthMap,
    labels: &[u16],
    seen: &[Vec3],
    others: &[Vec3],
) -> DepthMap {
    let mut masks: BTreeMap<u16, MaskPoints> = BTreeMap::new();
    let mut depths = Vec::new();
    let projected = |point: &Vec3| {
        let (pixel, depth) = map.camera.pixel_and_depth(*point)?;
        let position = map.camera.world_to_camera.transform_point3(*point);
        Some((pixel, f64::from(depth), position.as_dvec3()))
    };
    let seen: Vec<_> = seen.iter().filter_map(projected).collect();
    for (pixel, depth, position) in &seen {
        depths.push(*depth);
        let mask = masks.entry(labels[*pixel]).or_default();
        mask.positions.push(*position);
        mask.pixels.push(*pixel);
        mask.own += 1;
    }
    for (pixel, depth, position) in others.iter().filter_map(projected) {
        depths.push(depth);
        if let Some(mask) = masks.get_mut(&labels[pixel]) {
            mask.positions.push(position);
            mask.pixels.push(pixel);
        }
    }
    masks.remove(&0);
    let Some(range) = depth_range(depths) else {
        return map;
    };
    let mut rng = Rng::new(view as u64, "planes");
    let mut all_planes = Vec::new();
    let mut seeds = Vec::new();
    for points in masks.values() {
        let (planes, plane_of_point) = Plane::fit_all(&points.positions, points.own, &mut rng);
        let first = all_planes.len();
        let number = |plane: Option<usize>| plane.map(|plane| first + plane);
        let numbers = plane_of_point.into_iter().map(number);
        let inside = points.pixels.iter().copied().zip(numbers);
        seeds.extend(inside);
        all_planes.extend(planes);
    }
    let width = map.camera.width as usize;
    let plane_of_pixel = spread(labels, width, &seeds);
    for (pixel, plane) in plane_of_pixel.into_iter().enumerate() {
        if map.depth[pixel] > 0.0 {
            continue;
        }
        let ray = map.camera.ray(map.camera.pixel_centre(pixel)).as_dvec3();
        let depth = plane.and_then(|plane| all_planes[plane].depth(ray));
        let depth = depth.filter(|depth| range.contains(depth));
        map.depth[pixel] = depth.unwrap_or_default() as f32;
    }
    map
}

/// Spreads the values of seeds over the pixels of their labels, in the order of distance. Returns
/// the value of each pixel.
fn spread(labels: &[u16], width: usize, seeds: &[(usize, Option<usize>)]) -> Vec<Option<usize>> {
    let mut values: Vec<Option<Option<usize>>> = vec![None; labels.len()];
    let mut queue = VecDeque::new();
    for (pixel, value) in seeds {
        if values[*pixel].is_none() {
            values[*pixel] = Some(*value);
            queue.push_back(*pixel);
        }
    }
    while let Some(pixel) = queue.pop_front() {
        let x = pixel % width;
        let neighbours = [
            (x > 0).then(|| pixel - 1),
            (x + 1 < width).then_some(pixel + 1),
            pixel.checked_sub(width),
            Some(pixel + width).filter(|below| *below < labels.len()),
        ];
        for next in neighbours.into_iter().flatten() {
            if values[next].is_none() && labels[next] == labels[pixel] {
                values[next] = values[pixel];
                queue.push_back(next);
            }
        }
    }
    values.into_iter().map(Option::flatten).collect()
}

/// Returns the range of depths that planes of a view may have.
fn depth_range(mut depths: Vec<f64>) -> Option<std::ops::Range<f64>> {
    depths.sort_by(f64::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let cut = (OUTLIERS * last as f64) as usize;
    Some(depths[cut] / RANGE_FACTOR..depths[last - cut] * RANGE_FACTOR)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Corner of a room: the wall z = 4 where x < 1, and the wall x = 1 where z < 4.
    fn walls() -> impl Iterator<Item = Vec3> {
        let grid = |from: f32, to: f32| (0..12).map(move |k| from + (to - from) * k as f32 / 11.0);
        let back = grid(-1.5, 1.0).flat_map(move |x| grid(-1.0, 1.0).map(move |y| (x, y)));
        let side = grid(2.0, 4.0).flat_map(move |z| grid(-1.0, 1.0).map(move |y| (z, y)));
        let back = back.map(|(x, y)| Vec3::new(x, y, 4.0));
        back.chain(side.map(|(z, y)| Vec3::new(1.0, y, z)))
    }

    fn true_depth(camera: &Camera, pixel: usize) -> f32 {
        let width = camera.width as usize;
        let middle = Vec2::new((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
        let inverse = camera.world_to_camera.inverse();
        let ray = inverse.transform_vector3(camera.ray(middle));
        let eye = camera.centre();
        let back = (4.0 - eye.z) / ray.z;
        let side = (1.0 - eye.x) / ray.x;
        if side > 0.0 { back.min(side) } else { back }
    }

    fn cameras() -> Vec<Camera> {
        let camera = |k: usize| {
            let eye = Vec3::new(-0.3 + 0.2 * k as f32, 0.0, 0.0);
            let target = Vec3::new(0.3, 0.0, 4.0);
            Camera::look_at(&k.to_string(), eye, target, Vec3::Y, 256, 192, 0.6)
        };
        (0..4).map(camera).collect()
    }

    fn points(seen_by: &[u32]) -> Vec<SfmPoint> {
        let point = |position: Vec3| SfmPoint {
            position,
            color: [0; 3],
            seen_by: seen_by.to_vec(),
        };
        walls().map(point).collect()
    }

    fn one_mask() -> LabelMap {
        let mut map = LabelMap::new(256, 192);
        map.labels.fill(1);
        map
    }

    #[test]
    fn two_walls_of_one_mask() {
        let cameras = cameras();
        // The last camera shares few points with the others.
        let mut points = points(&[0, 1, 2]);
        points
            .iter_mut()
            .step_by(20)
            .for_each(|p| p.seen_by.push(3));
        let surfaces = Surfaces::new(&cameras, &points, |_| Ok::<_, ()>(one_mask())).unwrap();
        for map in &surfaces.maps {
            let known: Vec<usize> = (0..map.depth.len())
                .filter(|p| map.depth[*p] > 0.0)
                .collect();
            assert!(known.len() * 10 > map.depth.len() * 6, "{}", known.len());
            let is_near =
                |p: &&usize| (map.depth[**p] / true_depth(&map.camera, **p) - 1.0).abs() < 0.02;
            let right = known.iter().filter(is_near).count();
            assert!(
                right * 100 >= known.len() * 97,
                "{right} of {}",
                known.len()
            );
        }
        let new = surfaces.new_points(|view, place| {
            assert!(place.x > 0.0 && place.x < 1.0 && place.y > 0.0 && place.y < 1.0);
            [view as u8; 3]
        });
        assert!(new.len() > 300, "{}", new.len());
        let of_first = new.iter().filter(|p| p.color == [0; 3]).count();
        assert!(
            of_first * 2 > new.len(),
            "views do not repeat each other's points"
        );
    }

    #[test]
    fn a_plane_that_no_other_view_confirms_is_dropped() {
        let cameras = cameras();
        let known = |points: &[SfmPoint]| {
            let surfaces = Surfaces::new(&cameras, points, |_| Ok::<_, ()>(one_mask())).unwrap();
            let known = |map: &DepthMap| map.depth.iter().filter(|d| **d > 0.0).count();
            surfaces.maps.iter().map(known).sum::<usize>()
        };
        assert_eq!(known(&points(&[1])), 0, "one view alone");
        assert!(known(&points(&[1, 2])) > 0, "two views");
        assert_eq!(known(&[]), 0, "no points");
        let without_masks = |_| Ok::<_, ()>(LabelMap::new(256, 192));
        let bare = Surfaces::new(&cameras, &points(&[0, 1, 2]), without_masks).unwrap();
        assert!(
            bare.maps
                .iter()
                .all(|map| map.depth.iter().all(|d| *d == 0.0))
        );
    }

    #[test]
    fn values_spread_within_their_label() {
        let labels = [1, 1, 2, 1, 1, 1];
        let spread = spread(&labels, 6, &[(0, Some(5)), (2, None), (5, Some(7))]);
        assert_eq!(spread, [Some(5), Some(5), None, Some(7), Some(7), Some(7)]);
    }
}
