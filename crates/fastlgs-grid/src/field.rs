//! Masks and heat maps of objects in a rendered view (paper, querying features).

use crate::decision::decide;
use crate::grid::Grid;
use crate::overlaps::representative_id;
use crate::query::Hit;
use fastlgs_core::id_weights::{IDS_PER_PIXEL, unpack};
use fastlgs_core::{IdWeights, LabelMap};

/// Returns for each pixel the id that represents its objects. `lists`: the objects of each id,
/// smallest first.
pub fn ids(shares: &IdWeights, lists: &[Vec<u16>]) -> LabelMap {
    let found = |pixel: &[u32; IDS_PER_PIXEL]| {
        pixel
            .map(unpack)
            .into_iter()
            .filter(|s| s.1 > 0)
            .map(|(id, weight)| (id, weight as f32))
    };
    let labels = shares
        .majority_sets(lists)
        .zip(&shares.pixels)
        .map(|(objects, pixel)| representative_id(&objects, found(pixel), lists))
        .collect();
    LabelMap {
        width: shares.width,
        height: shares.height,
        labels,
    }
}

/// The rendered object data of a view.
pub enum Field {
    /// Id weights, for scenes with lifted object ids.
    IdWeights(IdWeights),
    /// Rendered codes, for scenes with trained features (paper).
    Features {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
        /// Values as `[3][h][w]`.
        values: Vec<f32>,
        /// Largest distance between a feature and the code of its object, on the 0..255 scale
        /// (paper); see [`decide`].
        tau_ac: Option<f32>,
    },
}

impl Field {
    /// Calls `visit` for each pixel, row by row, with the objects that have most of its weight,
    /// smallest first.
    pub fn for_each_pixel(&self, grid: &Grid, mut visit: impl FnMut(&[u16])) {
        let lists = grid.lists();
        match self {
            Self::IdWeights(shares) => shares
                .majority_sets(&lists)
                .for_each(|objects| visit(&objects)),
            Self::Features {
                width,
                height,
                values,
                tau_ac,
            } => {
                decide(grid, *width, *height, values, *tau_ac)
                    .labels
                    .iter()
                    .for_each(|id| visit(&lists[usize::from(*id)]));
            }
        }
    }

    /// Returns for each of these pixels (x, y) the objects that have most of its weight, smallest
    /// first.
    pub fn at(&self, grid: &Grid, pixels: &[(u32, u32)]) -> Vec<Vec<u16>> {
        let width = self.size().0;
        let mut asked: Vec<(u32, usize)> = pixels
            .iter()
            .enumerate()
            .map(|(k, (x, y))| (y * width + x, k))
            .collect();
        asked.sort_unstable_by(|a, b| b.cmp(a));
        let (mut place, mut found) = (0, vec![Vec::new(); pixels.len()]);
        self.for_each_pixel(grid, |objects| {
            while let Some((_, k)) = asked.pop_if(|(wanted, _)| *wanted == place) {
                found[k] = objects.to_vec();
            }
            place += 1;
        });
        found
    }

    /// Returns for each pixel the id that represents its objects; 0 for none.
    pub fn ids(&self, grid: &Grid) -> LabelMap {
        match self {
            Self::IdWeights(shares) => ids(shares, &grid.lists()),
            Self::Features {
                width,
                height,
                values,
                tau_ac,
            } => decide(grid, *width, *height, values, *tau_ac),
        }
    }

    /// Returns for each pixel the smallest object that has most of its weight; 0 for none.
    pub fn owners(&self, grid: &Grid) -> LabelMap {
        let (width, height) = self.size();
        let mut labels = Vec::with_capacity((width * height) as usize);
        self.for_each_pixel(grid, |objects| {
            labels.push(objects.first().copied().unwrap_or(0))
        });
        LabelMap {
            width,
            height,
            labels,
        }
    }

    /// Returns width and height in pixels.
    fn size(&self) -> (u32, u32) {
        match self {
            Self::IdWeights(shares) => (shares.width, shares.height),
            Self::Features { width, height, .. } => (*width, *height),
        }
    }

    /// Returns whether each pixel belongs to one of the targets, row by row.
    pub fn mask(&self, grid: &Grid, targets: &[Hit]) -> Vec<bool> {
        let ids: Vec<u16> = targets.iter().map(|t| t.id).collect();
        let members = grid.members(&ids);
        match self {
            Self::IdWeights(shares) => shares.mask(&members),
            Self::Features { .. } => self
                .owners(grid)
                .labels
                .iter()
                .map(|id| members[usize::from(*id)])
                .collect(),
        }
    }

    /// Returns the relevancy of each pixel: the highest score of its objects; 0 without objects.
    pub fn relevancy(&self, grid: &Grid, ranked: &[Hit]) -> Vec<f32> {
        let mut own = vec![0.0f32; grid.objects.len() + 1];
        ranked.iter().for_each(|h| own[usize::from(h.id)] = h.score);
        let mut relevancy = Vec::new();
        self.for_each_pixel(grid, |objects| {
            relevancy.push(
                objects
                    .iter()
                    .map(|id| own[usize::from(*id)])
                    .fold(0.0, f32::max),
            )
        });
        relevancy
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::tests::grid;
    use fastlgs_core::id_weights::pack;

    #[test]
    fn mask_and_relevancy_of_an_object_include_its_parts() {
        let pixels = vec![
            [pack(1, 0.4), pack(2, 0.2), pack(3, 0.4), 0],
            [pack(2, 0.9), 0, 0, 0],
            [pack(3, 1.0), 0, 0, 0],
        ];
        let field = Field::IdWeights(IdWeights {
            width: 3,
            height: 1,
            pixels,
        });
        let mask = |id| field.mask(&grid(), &[Hit { id, score: 1.0 }]);
        assert_eq!(
            (mask(1), mask(2)),
            (vec![true, true, false], vec![false, true, false])
        );
        let ranked = [
            Hit { id: 1, score: 0.8 },
            Hit { id: 2, score: 0.5 },
            Hit { id: 3, score: 0.1 },
        ];
        assert_eq!(field.relevancy(&grid(), &ranked), [0.8, 0.8, 0.1]);
    }
}
