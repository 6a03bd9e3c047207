//! Lifting: sums the blending weights of Gaussians by the labels of label maps
//! ([`Engine::votes`](crate::Engine::votes)).
//!
//! This takes one pass over the views instead of thousands of gradient steps.

use crate::view::{TILE, View};
use crate::{Error, Result};
use fastlgs_core::LabelMap;
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
const MIN_VOTE_WEIGHT: f32 = 0.02;

/// Labels of the pixels of a tile.
pub(crate) struct TileLabels {
    /// The different labels, in the order of their first pixels.
    pub labels: Vec<u16>,
    /// For each pixel of the tile, row by row, the index of its label in `labels`. Padding pixels
    /// repeat the border.
    pub of_pixel: [u8; (TILE * TILE) as usize],
}

impl TileLabels {
    /// Returns the labels of a tile of a view.
    pub fn of(map: &LabelMap, view: &View, tile: usize) -> Self {
        let (column, row) = (tile as u32 % view.tiles[0], tile as u32 / view.tiles[0]);
        let mut labels: Vec<u16> = Vec::new();
        let of_pixel = std::array::from_fn(|p| {
            let x = (column * TILE + p as u32 % TILE).min(map.width - 1);
            let y = (row * TILE + p as u32 / TILE).min(map.height - 1);
            let label = map.at(x, y);
            let known = labels.iter().position(|known| *known == label);
            known.unwrap_or_else(|| {
                labels.push(label);
                labels.len() - 1
            }) as u8
        });
        Self { labels, of_pixel }
    }

    /// Returns the votes of a Gaussian from its sum for each label.
    pub fn votes(&self, gaussian: u32, sums: &[f32]) -> impl Iterator<Item = Vote> {
        let pairs = self.labels.iter().zip(sums);
        let votes = pairs.map(move |(&label, &weight)| Vote {
            gaussian,
            label,
            weight,
        });
        votes.filter(|vote| vote.weight > 0.0)
    }
}

/// Checks that label map and view have the same size.
pub(crate) fn check_labels(view: &View, labels: &LabelMap) -> Result<()> {
    if view.size == [labels.width, labels.height] {
        return Ok(());
    }
    Err(Error::Invalid(format!(
        "the label map has {}x{} pixels, but the view has {}x{}",
        labels.width, labels.height, view.size[0], view.size[1]
    )))
}

/// Sums the votes of the tiles by Gaussian and label. Tiles come in the order of their numbers, and
/// the sort is stable, so that the sums are the same in every run.
pub(crate) fn summed(tiles: &[Vec<Vote>]) -> Vec<Vote> {
    let mut all = tiles.concat();
    all.par_sort_by_key(|v| (v.gaussian, v.label));
    all.dedup_by(|next, kept| {
        let same = (next.gaussian, next.label) == (kept.gaussian, kept.label);
        kept.weight += if same { next.weight } else { 0.0 };
        same
    });
    all.retain(|v| v.weight >= MIN_VOTE_WEIGHT);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::State;
    use crate::{CpuEngine, Engine};
    use fastlgs_core::{Camera, Gaussians};
    use glam::Vec3;

    #[test]
    fn votes_are_blending_weights_by_label() {
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
        let mut engine = CpuEngine::new();
        engine.set_state(&State::of(&scene)).unwrap();
        let votes = engine.votes(View::new(&camera, 2, 0), &labels).unwrap();
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
