//! From objects to a mask: what a rendered view tells about objects (paper, querying features).

use crate::codes;
use crate::grid::Grid;
use crate::query::Hit;
use fastlgs_core::{LabelMap, Shares};
use glam::Vec3;
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
        /// Largest distance of a feature to its object's code, on the 0..255 scale (paper). Without it the nearest code decides, where a feature
        /// of zero is no object's: with few objects codes lie a hundred apart, and what blends with its surroundings is lost within 5.
        tau_ac: Option<f32>,
    },
}

impl Field {
    /// The smallest object that has most of each pixel; 0 for none.
    pub fn owners(&self, grid: &Grid) -> LabelMap {
        match self {
            Self::Shares(shares) => smallest_objects(shares, |id| grid.chain(id).nth(1).unwrap_or(0)),
            Self::Features { width, height, values, tau_ac } => {
                let nearest = |feature: Vec3| decided(grid, feature, *tau_ac);
                LabelMap { width: *width, height: *height, labels: features(values).map(nearest).collect() }
            }
        }
    }

    /// The mask of some objects. Each target's code is compared on its own, as in the paper.
    pub fn mask(&self, grid: &Grid, targets: &[Hit]) -> Vec<bool> {
        let ids: Vec<u16> = targets.iter().map(|t| t.id).collect();
        let members = grid.members(&ids);
        match self {
            Self::Shares(shares) => shares.mask(&members),
            Self::Features { values, tau_ac: None, .. } => features(values).map(|f| members[usize::from(decided(grid, f, None))]).collect(),
            Self::Features { values, tau_ac: Some(tau_ac), .. } => {
                let codes: Vec<Vec3> = grid.objects.iter().filter(|o| members[usize::from(o.id)]).map(|o| o.code).collect();
                features(values).map(|f| codes.iter().any(|c| codes::distance(f, *c) < *tau_ac)).collect()
            }
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

/// The object that a feature shows; 0 for none.
fn decided(grid: &Grid, feature: Vec3, tau_ac: Option<f32>) -> u16 {
    let least = tau_ac.unwrap_or_else(|| codes::distance(feature, Vec3::ZERO));
    grid.nearest(feature).filter(|(_, d)| *d < least).map_or(0, |(id, _)| id)
}

/// Pixels of a planar feature picture.
fn features(values: &[f32]) -> impl Iterator<Item = Vec3> {
    let n = values.len() / 3;
    (0..n).map(move |p| Vec3::new(values[p], values[n + p], values[2 * n + p]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::tests::grid;
    use fastlgs_core::shares::pack;

    #[test]
    fn masks_follow_tau_ac() {
        // Features: on code 1, within 5/255 of it, midway between codes 1 and 2, on code 3.
        let x = [0.25, 0.26, 0.375, 0.75];
        let values: Vec<f32> = x.iter().chain(&x).chain(&x).copied().collect();
        let field = Field::Features { width: 4, height: 1, values: values.clone(), tau_ac: Some(codes::TAU_AC) };
        assert_eq!(field.mask(&grid(), &[Hit { id: 1, score: 1.0 }]), [true, true, false, false]);
        assert_eq!(field.owners(&grid()).labels, [1, 1, 0, 3]);
        let nearest = Field::Features { width: 4, height: 1, values, tau_ac: None };
        assert_eq!(nearest.owners(&grid()).labels, [1, 1, 1, 3]);
        assert_eq!(nearest.mask(&grid(), &[Hit { id: 1, score: 1.0 }]), [true, true, true, false]);
        let nothing = Field::Features { width: 1, height: 1, values: vec![0.1; 3], tau_ac: None };
        assert_eq!(nothing.owners(&grid()).labels, [0]);
    }

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
