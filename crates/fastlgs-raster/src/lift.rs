//! Lifting: sums the blending weights of Gaussians by the labels of label maps.
//!
//! This takes one pass over the views instead of thousands of gradient steps.

use crate::native::blend::{self, Job, Tile};
use crate::native::{self, Lists};
use crate::view::{TILE, View};
use fastlgs_core::{Gaussians, LabelMap};
use rayon::prelude::*;

/// Contribution of one Gaussian to one label of one view: the sum of its blending weights
/// w = alpha * transmittance over the pixels of the label.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vote {
    /// Index of the Gaussian.
    pub gaussian: u32,
    /// Label; 0 means pixels that no mask covers.
    pub label: u16,
    /// Sum of blending weights.
    pub weight: f32,
}

/// Votes with less weight are dropped to save memory.
const MIN_WEIGHT: f32 = 0.02;

/// Returns the votes of all Gaussians for the labels of a view, sorted by Gaussian and label.
///
/// # Panics
/// If map and view differ in size.
pub fn votes(scene: &Gaussians, view: &View, labels: &LabelMap) -> Vec<Vote> {
    assert_eq!(
        view.size,
        [labels.width, labels.height],
        "the label map must have the view's size"
    );
    let view = View {
        sh_degree: 0,
        ..*view
    };
    let lists = lists_of(scene, &view);
    let of_tile = |sums: &mut Vec<f32>, tile: usize| {
        let job = Job::new(&view, tile, &lists);
        let mut shown = blend::inside_image(&view, &job);
        let (names, masks) = masks_of(labels, &job);
        blend::by_mask(&job, &masks, &mut shown, sums);
        let rows = job.gaussians().zip(sums.chunks_exact(names.len()));
        let votes = rows.flat_map(|(gaussian, row)| {
            names.iter().zip(row).map(move |(&label, &weight)| Vote {
                gaussian,
                label,
                weight,
            })
        });
        votes.filter(|v| v.weight > 0.0).collect::<Vec<_>>()
    };
    let tiles: Vec<Vec<Vote>> = (0..view.tile_count() as usize)
        .into_par_iter()
        .map_init(Vec::new, of_tile)
        .collect();
    let mut all = tiles.concat();
    // A stable sort keeps the order of the tiles, so the sums are the same in every run.
    all.par_sort_by_key(|v| (v.gaussian, v.label));
    all.dedup_by(|next, kept| {
        let same = (next.gaussian, next.label) == (kept.gaussian, kept.label);
        kept.weight += if same { next.weight } else { 0.0 };
        same
    });
    all.retain(|v| v.weight >= MIN_WEIGHT);
    all
}

/// Returns the labels of a tile's pixels, and a mask of each (1 inside). Padding pixels repeat the
/// border.
fn masks_of(labels: &LabelMap, job: &Job) -> (Vec<u16>, Vec<Tile>) {
    let (mut names, mut masks): (Vec<u16>, Vec<Tile>) = Default::default();
    for p in 0..blend::EMPTY.len() {
        let (x, y) = (
            job.x as u32 + p as u32 % TILE,
            job.y as u32 + p as u32 / TILE,
        );
        let label = labels.at(x.min(labels.width - 1), y.min(labels.height - 1));
        let place = names.iter().position(|n| *n == label).unwrap_or_else(|| {
            names.push(label);
            masks.push(blend::EMPTY);
            names.len() - 1
        });
        masks[place][p] = 1.0;
    }
    (names, masks)
}

/// Returns the tile lists of a view.
fn lists_of(scene: &Gaussians, view: &View) -> Lists {
    Lists::new(view, &native::transposed(&scene.to_channels(), scene.len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Camera;
    use glam::Vec3;

    #[test]
    fn a_gaussian_votes_for_what_it_covers() {
        let camera = Camera::look_at(
            "a",
            Vec3::new(0.0, 0.0, -4.0),
            Vec3::ZERO,
            Vec3::Y,
            64,
            48,
            0.8,
        );
        let mut scene = Gaussians::default();
        scene.push_sphere(Vec3::ZERO, 0.2, 0.95, [0.5; 3]);
        scene.push_sphere(Vec3::new(0.0, 0.0, 2.0), 0.2, 0.95, [0.5; 3]); // mostly hidden behind the first
        let mut labels = LabelMap::new(64, 48);
        labels
            .labels
            .iter_mut()
            .enumerate()
            .for_each(|(p, l)| *l = if p % 64 < 32 { 1 } else { 2 });
        let votes = votes(&scene, &View::new(&camera, 2, 0), &labels);
        let of = |g: u32, l: u16| {
            votes
                .iter()
                .find(|v| (v.gaussian, v.label) == (g, l))
                .map_or(0.0, |v| v.weight)
        };
        assert!(
            (of(0, 1) - of(0, 2)).abs() < 0.01 * of(0, 1),
            "the border cuts it in halves"
        );
        assert!(
            of(0, 1) > 4.0 * of(1, 1),
            "the hidden Gaussian has little weight"
        );
    }
}
