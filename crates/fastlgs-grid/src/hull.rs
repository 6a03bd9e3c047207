//! Visual hulls of transparent objects.
//!
//! Photos show what lies behind glass, so training places no Gaussians there. Masks still outline
//! the object from many sides. The intersection of these outlines is its visual hull (Laurentini
//! 1994).

use fastlgs_core::mask_list::Atoms;
use fastlgs_core::stats;
use fastlgs_core::{Camera, LabelMap};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Depth and unexplained masks of a view.
pub struct Outline {
    /// Camera of the view.
    pub camera: Camera,
    /// For each pixel: depth of the visible surface; infinite where there is none. Such pixels
    /// cannot lie in a hull.
    pub depth: Vec<f32>,
    /// For each pixel: whether masks lie there and no object explains any of them.
    pub inside: Vec<bool>,
}

/// Points that cover a transparent object.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Hull {
    /// Points about evenly spaced, midway between front and back of the object.
    pub points: Vec<Vec3>,
    /// Distance between neighbouring points, in world units.
    pub spacing: f32,
}

/// Distance between sampled pixels, along rows and columns.
const STRIDE: u32 = 6;
/// Number of points tested along a ray, evenly spaced in 1/depth.
const RAY_STEPS: u32 = 1024;
/// Largest share of the views in which a point of the hull may lie outside the masks. Masks may be
/// missing or too narrow.
const MAX_MISSED_SHARE: f32 = 0.1;
/// Smallest ratio between the depth of the surface behind a transparent object and the object's
/// depth. Also the tolerance of the occlusion test.
const MIN_DEPTH_RATIO: f32 = 1.05;
/// Smallest depth at which a view searches: 0.5 times the 1/20 quantile of its depths. The quantile
/// skips outliers.
const NEAREST_DEPTH: (usize, f32) = (20, 0.5);
/// Largest cell distance between neighbouring points of one hull.
const MAX_CELL_DISTANCE: i32 = 2;
/// Smallest number of points of a hull.
const MIN_HULL_POINTS: usize = 16;

/// Returns for each pixel whether masks lie there and no object explains any of them.
///
/// An object explains a mask if their IoU is at least `min_support`. `rendered_ids`: rendered id of
/// each pixel; `lists`: the objects of each id.
pub fn unexplained(
    atoms: &Atoms,
    rendered_ids: &LabelMap,
    lists: &[Vec<u16>],
    min_support: f32,
) -> Vec<bool> {
    let mut pixels: BTreeMap<(u16, u16), f32> = BTreeMap::new();
    for (atom, id) in atoms.map.labels.iter().zip(&rendered_ids.labels) {
        *pixels.entry((*atom, *id)).or_default() += 1.0;
    }
    let (mut of_mask, mut of_object) = (
        vec![0.0f32; atoms.table.areas.len()],
        BTreeMap::<u16, f32>::new(),
    );
    let mut common: BTreeMap<(u16, u16), f32> = BTreeMap::new();
    for ((atom, id), pixels) in pixels {
        let (masks, objects) = (atoms.table.masks(atom), &lists[usize::from(id)]);
        masks
            .iter()
            .for_each(|mask| of_mask[usize::from(*mask)] += pixels);
        objects
            .iter()
            .for_each(|object| *of_object.entry(*object).or_default() += pixels);
        let pairs = masks
            .iter()
            .flat_map(|mask| objects.iter().map(move |object| (*mask, *object)));
        pairs.for_each(|pair| *common.entry(pair).or_default() += pixels);
    }
    let mut explained = vec![false; of_mask.len()];
    for ((mask, object), common) in common {
        let either = of_mask[usize::from(mask)] + of_object[&object] - common;
        explained[usize::from(mask)] |= common >= min_support * either;
    }
    let none = |masks: &[u16]| {
        !masks.is_empty() && masks.iter().all(|mask| !explained[usize::from(*mask)])
    };
    let of_atom: Vec<bool> = (0..atoms.table.count())
        .map(|atom| none(atoms.table.masks(atom as u16)))
        .collect();
    atoms
        .map
        .labels
        .iter()
        .map(|atom| of_atom[usize::from(*atom)])
        .collect()
}

/// Returns the hulls of the outlines, one for each connected group of points. At least `min_views`
/// views must see each point.
pub fn hulls(views: &[Outline], min_views: usize) -> Vec<Hull> {
    let of_view = |(view, outline): (usize, &Outline)| {
        let [width, height] = [outline.camera.width, outline.camera.height];
        let lines = |side: u32| (STRIDE / 2..side).step_by(STRIDE as usize);
        let near = near(outline);
        let pixels = lines(height).flat_map(move |y| lines(width).map(move |x| (x, y)));
        let inside = pixels.filter(|(x, y)| outline.inside[(y * width + x) as usize]);
        inside
            .filter_map(|pixel| hull_on_ray(views, view, pixel, near, min_views))
            .collect::<Vec<_>>()
    };
    group_points(
        &views
            .par_iter()
            .enumerate()
            .map(of_view)
            .collect::<Vec<_>>()
            .concat(),
    )
}

/// Returns the smallest depth at which a view searches for hulls; infinite without a visible
/// surface.
fn near(view: &Outline) -> f32 {
    let mut depths: Vec<f32> = view
        .depth
        .iter()
        .copied()
        .filter(|depth| depth.is_finite())
        .collect();
    depths.sort_by(f32::total_cmp);
    depths
        .get(depths.len() / NEAREST_DEPTH.0)
        .map_or(f32::INFINITY, |depth| NEAREST_DEPTH.1 * depth)
}

/// Returns the middle of the hull on the ray of pixel (x, y), and the distance between rays there.
/// Returns `None` unless the visible surface lies behind the hull.
fn hull_on_ray(
    views: &[Outline],
    view: usize,
    (x, y): (u32, u32),
    near: f32,
    min_views: usize,
) -> Option<(Vec3, f32)> {
    let Outline { camera, depth, .. } = &views[view];
    let far = depth[(y * camera.width + x) as usize];
    if far <= near || far.is_infinite() {
        return None;
    }
    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    let to_world = camera.world_to_camera.inverse();
    let place = |depth: f32| to_world.transform_point3(ray * depth);
    let depth = |step: u32| {
        let share = step as f32 / (RAY_STEPS - 1) as f32;
        1.0 / ((1.0 - share) / near + share / far)
    };
    let holds = |step: &u32| is_in_hull(views, view, place(depth(*step)), min_views);
    let first = (0..RAY_STEPS).find(holds)?;
    let last = (first..RAY_STEPS).take_while(holds).last()?;
    let middle = 0.5 * (depth(first) + depth(last));
    (MIN_DEPTH_RATIO * depth(last) < far)
        .then(|| (place(middle), STRIDE as f32 * middle / camera.fx))
}

/// Returns whether a point on a ray of view `own` lies in the hull.
///
/// Nearly all other views that see the point must have it in an unexplained mask. Most of the views
/// whose picture contains it must see it without occlusion.
fn is_in_hull(views: &[Outline], own: usize, place: Vec3, min_views: usize) -> bool {
    let [mut within, mut open, mut missed] = [0usize; 3];
    // Start with views a third of the sequence away: they reject wrong points soonest.
    for k in 0..views.len() {
        let number = (own + views.len() / 3 + k) % views.len();
        let view = &views[number];
        let Some((pixel, depth)) = view.camera.pixel_and_depth(place).filter(|_| number != own)
        else {
            continue;
        };
        within += 1;
        if depth > MIN_DEPTH_RATIO * view.depth[pixel] {
            continue;
        }
        open += 1;
        missed += usize::from(!view.inside[pixel] || view.depth[pixel].is_infinite());
        if missed as f32 > MAX_MISSED_SHARE * views.len() as f32 {
            return false;
        }
    }
    open + 1 >= min_views && 2 * open >= within && missed as f32 <= MAX_MISSED_SHARE * open as f32
}

/// Keeps one point in each cell of the median spacing, and groups cells that are at most
/// [`MAX_CELL_DISTANCE`] cells apart.
fn group_points(found: &[(Vec3, f32)]) -> Vec<Hull> {
    let Some(spacing) = stats::median(found.iter().map(|(_, spacing)| *spacing)) else {
        return Vec::new();
    };
    let mut cells: BTreeMap<[i32; 3], Vec3> = BTreeMap::new();
    for (place, _) in found {
        cells
            .entry((place / spacing).floor().as_ivec3().to_array())
            .or_insert(*place);
    }
    let mut left: BTreeSet<[i32; 3]> = cells.keys().copied().collect();
    let mut hulls = Vec::new();
    while let Some(first) = left.pop_first() {
        let (mut edge, mut places) = (vec![first], Vec::new());
        while let Some(cell) = edge.pop() {
            places.push(cells[&cell]);
            edge.extend(around(cell).filter(|beside| left.remove(beside)));
        }
        if places.len() >= MIN_HULL_POINTS {
            hulls.push(Hull {
                points: places,
                spacing,
            });
        }
    }
    hulls
}

/// Iterates over the cells at most [`MAX_CELL_DISTANCE`] cells from a cell, itself included.
fn around([x, y, z]: [i32; 3]) -> impl Iterator<Item = [i32; 3]> {
    let side = 2 * MAX_CELL_DISTANCE + 1;
    (0..side.pow(3)).map(move |k| {
        [
            x + k % side - MAX_CELL_DISTANCE,
            y + k / side % side - MAX_CELL_DISTANCE,
            z + k / side / side - MAX_CELL_DISTANCE,
        ]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    /// Twelve cameras around a pane of 1 x 1 x 0.05 at the origin, with a wall at depth 6 behind
    /// it. The pane is solid or transparent; the first `missing` views have no mask of it.
    fn views(solid: bool, missing: usize) -> Vec<Outline> {
        let outline = |k: usize| {
            let around = 3.0 * Vec2::from_angle(std::f32::consts::TAU * k as f32 / 12.0);
            let camera = Camera::look_at(
                "a",
                Vec3::new(around.x, 0.4, around.y),
                Vec3::ZERO,
                Vec3::Y,
                160,
                120,
                0.8,
            );
            let to_world = camera.world_to_camera.inverse();
            let (mut inside, mut depth) = (Vec::new(), Vec::new());
            for pixel in 0..160 * 120 {
                let ray = camera.ray(Vec2::new(
                    (pixel % 160) as f32 + 0.5,
                    (pixel / 160) as f32 + 0.5,
                ));
                let [a, b] = [-HALF, HALF]
                    .map(|corner| (corner - camera.centre()) / to_world.transform_vector3(ray));
                let (first, last) = (a.min(b).max_element(), a.max(b).min_element());
                inside.push(k >= missing && first < last);
                depth.push(if solid && first < last { first } else { 6.0 });
            }
            Outline {
                camera,
                inside,
                depth,
            }
        };
        (0..12).map(outline).collect()
    }

    const HALF: Vec3 = Vec3::new(0.5, 0.5, 0.025);

    #[test]
    fn hull_of_a_transparent_pane_is_found() {
        let found = hulls(&views(false, 0), 3);
        let [hull] = found.as_slice() else {
            panic!("{} hulls", found.len())
        };
        let off = hull
            .points
            .iter()
            .map(|place| (place.abs() - HALF).max_element())
            .fold(f32::MIN, f32::max);
        assert!(off < 0.05, "{off}");
        // One layer of points covers the pane at the spacing of the rays, not both of its sides.
        let cells = hull.spacing.powi(-2);
        assert!(
            (0.6 * cells..2.5 * cells).contains(&(hull.points.len() as f32)),
            "{} of {cells}",
            hull.points.len()
        );
    }

    #[test]
    fn a_hull_tolerates_one_missing_mask_of_twelve_but_not_three() {
        assert_eq!(hulls(&views(false, 1), 3).len(), 1);
        assert!(hulls(&views(false, 3), 3).is_empty());
    }

    #[test]
    fn opaque_objects_and_sky_give_no_hull() {
        assert!(hulls(&views(true, 0), 3).is_empty());
        let sky = |mut view: Outline| {
            let pixels = view.inside.iter_mut().zip(&mut view.depth);
            pixels.for_each(|(inside, depth)| {
                (*inside, *depth) = if *inside {
                    (false, 3.0)
                } else {
                    (true, f32::INFINITY)
                }
            });
            view
        };
        assert!(hulls(&views(false, 0).into_iter().map(sky).collect::<Vec<_>>(), 3).is_empty());
    }

    #[test]
    fn pixels_of_masks_that_an_object_explains_are_explained() {
        // Masks of 0..6, 0..2 and 8..12 on a row of 14 pixels. Object 1 covers 0..5, object 2 only
        // pixel 9.
        let mask = |from, to| {
            Mask::new(
                Level::Whole,
                RunLengths::from_fn(14, 1, |x, _| (from..to).contains(&x)),
            )
        };
        let atoms = MaskList {
            masks: vec![mask(0, 6), mask(0, 2), mask(8, 12)],
            ..MaskList::new(14, 1)
        }
        .atoms();
        let labels = (0..14)
            .map(|x| if x < 5 { 1 } else { 2 * u16::from(x == 9) })
            .collect();
        let shown = LabelMap {
            width: 14,
            height: 1,
            labels,
        };
        let found = unexplained(&atoms, &shown, &[vec![], vec![1], vec![2]], 0.5);
        assert_eq!(
            found,
            (0..14).map(|x| (8..12).contains(&x)).collect::<Vec<_>>()
        );
    }
}
