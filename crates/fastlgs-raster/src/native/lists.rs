//! Projection, depth order and tile lists.

use crate::cpu::{self, Footprint, NOT_DRAWN, Projected, Splat, span};
use crate::view::View;
use rayon::prelude::*;

/// What blending walks through. Pairs are numbered by tile and, within a tile, front to back.
pub(crate) struct Lists {
    /// Projected Gaussians.
    pub splats: Vec<Splat>,
    /// First pair and the one after the last, of each tile.
    pub ranges: Vec<[u32; 2]>,
    /// Gaussian of each pair.
    pub gaussians: Vec<u32>,
    /// Places of each Gaussian's pairs: those of Gaussian g are `places[first[g]..first[g + 1]]`.
    pub places: Vec<u32>,
    /// See `places`.
    pub first: Vec<u32>,
    /// Pixels up and down from each Gaussian's mean within which it reaches the least alpha.
    pub reach: Vec<f32>,
    footprints: Vec<Footprint>,
}

/// Added to the reach: alphas are rounded.
const ROUNDING: f32 = 0.01;

/// Gaussians are listed in so many parts, whatever the number of threads.
const PARTS: usize = 16;

/// Projects the Gaussians, whose channels `param(i, channel)` gives.
fn project(view: &View, param: impl Fn(usize, usize) -> f32 + Sync) -> Vec<Projected> {
    let nothing = Projected { splat: [[0.0; 4]; 3], depth: NOT_DRAWN, footprint: [[0.0; 4]; 2], touched: 0 };
    (0..view.gaussians as usize).into_par_iter().map(|i| cpu::project_one(view, |c| param(i, c)).unwrap_or(nothing)).collect()
}

impl Lists {
    /// Lists of a view over the Gaussians whose channels `param(i, channel)` gives.
    pub fn new(view: &View, param: impl Fn(usize, usize) -> f32 + Sync) -> Self {
        let projected = project(view, param);
        let order = in_depth_order(&projected);
        let mut first = vec![0; projected.len() + 1];
        for (i, p) in projected.iter().enumerate() {
            first[i + 1] = first[i] + p.touched;
        }
        let mut lists = Self {
            splats: projected.iter().map(|p| p.splat).collect(),
            reach: projected.iter().map(|p| p.footprint[1][0].sqrt() + ROUNDING).collect(),
            footprints: projected.iter().map(|p| p.footprint).collect(),
            ranges: vec![[0; 2]; view.tile_count() as usize],
            gaussians: Vec::new(),
            places: vec![0; first[projected.len()] as usize],
            first,
        };
        lists.fill(view, &order);
        lists
    }

    /// Projects again where only what does not move geometry has changed.
    pub fn refresh(&mut self, view: &View, param: impl Fn(usize, usize) -> f32 + Sync) {
        self.splats = project(view, param).into_iter().map(|p| p.splat).collect();
    }

    /// Counting sort by tile of the tiles that each Gaussian touches, which keeps the order of depths within a tile.
    fn fill(&mut self, view: &View, order: &[u32]) {
        let (tiles_x, tiles) = (view.tiles[0], self.ranges.len());
        let footprints = &self.footprints;
        let touched = |gaussians: &[u32]| {
            let (mut found, mut counts) = (Vec::new(), vec![0u32; tiles]);
            for &g in gaussians {
                let footprint = &footprints[g as usize];
                for row in footprint[1][2] as u32..(footprint[1][3] as u32).min(view.tiles[1]) {
                    for tile in span(footprint, row, tiles_x).map(|x| row * tiles_x + x) {
                        counts[tile as usize] += 1;
                        found.push(tile);
                    }
                }
            }
            (found, counts)
        };
        let parts = order.par_chunks(order.len().div_ceil(PARTS).max(1));
        let (found, mut next): (Vec<Vec<u32>>, Vec<Vec<u32>>) = parts.map(touched).unzip();
        let mut end = 0;
        for (tile, range) in self.ranges.iter_mut().enumerate() {
            range[0] = end;
            for counts in &mut next {
                end += std::mem::replace(&mut counts[tile], end);
            }
            range[1] = end;
        }
        self.gaussians = vec![0; end as usize];
        let mut tiles = found.iter().zip(&mut next).flat_map(|(found, next)| {
            found.iter().map(move |tile| {
                let place = next[*tile as usize];
                next[*tile as usize] += 1;
                place
            })
        });
        for &g in order {
            let own = self.first[g as usize] as usize..self.first[g as usize + 1] as usize;
            for (slot, place) in self.places[own].iter_mut().zip(&mut tiles) {
                *slot = place;
                self.gaussians[place as usize] = g;
            }
        }
    }
}

/// Drawn Gaussians by ascending depth; those of the same depth by their number.
fn in_depth_order(projected: &[Projected]) -> Vec<u32> {
    let mut keys: Vec<u64> =
        projected.iter().enumerate().filter(|(_, p)| p.touched > 0).map(|(i, p)| u64::from(p.depth) << 32 | i as u64).collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|k| k as u32).collect()
}
