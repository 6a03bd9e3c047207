//! From objects to a mask: what a rendered view tells about objects (paper, querying features).

use crate::decision::decide;
use crate::grid::Grid;
use crate::query::Hit;
use fastlgs_core::{LabelMap, Shares};
use std::cmp::Reverse;

/// At each pixel the smallest object that has most of its weight; 0 for none. What contains an object, its `parent`, has a lower number.
pub fn smallest_objects(shares: &Shares, parent: impl Fn(u16) -> u16) -> LabelMap {
    let object = |id: u16| Some(Reverse(id)).filter(|_| id > 0);
    // A damaged file might go in circles.
    let above = |id: Reverse<u16>| object(parent(id.0)).filter(|above| *above > id);
    let labels = shares.smallest(object, above).map(|id| id.map_or(0, |id| id.0)).collect();
    LabelMap { width: shares.width, height: shares.height, labels }
}

/// What a rendered view tells about objects.
pub enum Field {
    /// Blending weights by id, of lifted scenes.
    Shares(Shares),
    /// Blended codes, of scenes whose features were trained (the paper's way).
    Features {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
        /// `[3][h][w]`.
        values: Vec<f32>,
        /// Largest distance of a feature to its object's code, on the 0..255 scale (paper); see [`decide`].
        tau_ac: Option<f32>,
    },
}

impl Field {
    /// The smallest object that has most of each pixel; 0 for none.
    pub fn owners(&self, grid: &Grid) -> LabelMap {
        match self {
            Self::Shares(shares) => smallest_objects(shares, |id| grid.chain(id).nth(1).unwrap_or(0)),
            Self::Features { width, height, values, tau_ac } => decide(grid, *width, *height, values, *tau_ac),
        }
    }

    /// The mask of some objects.
    pub fn mask(&self, grid: &Grid, targets: &[Hit]) -> Vec<bool> {
        let ids: Vec<u16> = targets.iter().map(|t| t.id).collect();
        let members = grid.members(&ids);
        match self {
            Self::Shares(shares) => shares.mask(&members),
            Self::Features { .. } => self.owners(grid).labels.iter().map(|id| members[usize::from(*id)]).collect(),
        }
    }

    /// Relevancy of each pixel: the highest of the objects that it belongs to.
    pub fn relevancy(&self, grid: &Grid, ranked: &[Hit]) -> Vec<f32> {
        let mut own = vec![0.0f32; grid.objects.len() + 1];
        ranked.iter().for_each(|h| own[usize::from(h.id)] = h.score);
        let highest = |id| grid.chain(id).fold(0.0, |score: f32, above| score.max(own[usize::from(above)]));
        let score: Vec<f32> = (0..=grid.objects.len() as u16).map(highest).collect();
        self.owners(grid).labels.iter().map(|id| score.get(usize::from(*id)).copied().unwrap_or(0.0)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::tests::grid;
    use fastlgs_core::shares::pack;

    #[test]
    fn an_object_is_shown_by_its_parts_as_well() {
        let pixels = vec![[pack(1, 0.4), pack(2, 0.2), pack(3, 0.4), 0], [pack(2, 0.9), 0, 0, 0], [pack(3, 1.0), 0, 0, 0]];
        let field = Field::Shares(Shares { width: 3, height: 1, pixels });
        let mask = |id| field.mask(&grid(), &[Hit { id, score: 1.0 }]);
        assert_eq!((mask(1), mask(2)), (vec![true, true, false], vec![false, true, false]));
        let ranked = [Hit { id: 1, score: 0.8 }, Hit { id: 2, score: 0.5 }, Hit { id: 3, score: 0.1 }];
        assert_eq!(field.relevancy(&grid(), &ranked), [0.8, 0.8, 0.1]);
    }
}
