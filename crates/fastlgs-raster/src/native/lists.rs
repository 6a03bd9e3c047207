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
    footprints: Vec<Footprint>,
}

/// Tile rows are listed in so many parts, whatever the number of threads: sums then always have the same order.
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

    fn fill(&mut self, view: &View, order: &[u32]) {
        let rows = view.tiles[1] as usize;
        let part = |k: usize| (k * rows / PARTS) as u32..((k + 1) * rows / PARTS) as u32;
        let parts: Vec<Part> = (0..PARTS).into_par_iter().map(|k| Part::new(view, part(k), order, self)).collect();
        for (k, part_of) in parts.into_iter().enumerate() {
            let shift = self.gaussians.len() as u32;
            for (tile, range) in part_of.ranges.into_iter().enumerate() {
                self.ranges[(part(k).start * view.tiles[0]) as usize + tile] = range.map(|p| p + shift);
            }
            for (slot, place) in part_of.places {
                self.places[slot as usize] = place + shift;
            }
            self.gaussians.extend(part_of.gaussians);
        }
    }
}

/// Lists of some tile rows.
struct Part {
    ranges: Vec<[u32; 2]>,
    gaussians: Vec<u32>,
    /// (index in `Lists::places`, pair of the part).
    places: Vec<(u32, u32)>,
}

impl Part {
    fn new(view: &View, rows: std::ops::Range<u32>, order: &[u32], lists: &Lists) -> Self {
        let tiles_x = view.tiles[0];
        let tiles = (rows.len() as u32 * tiles_x) as usize;
        let mut found: Vec<(u32, u32, u32)> = Vec::new(); // tile of the part, Gaussian, slot
        let mut ends = vec![0u32; tiles + 1];
        for &g in order {
            let footprint = &lists.footprints[g as usize];
            let (top, bottom) = (footprint[1][2] as u32, footprint[1][3] as u32);
            if bottom <= rows.start || top >= rows.end {
                continue;
            }
            let above: usize = (top..rows.start).map(|row| span(footprint, row, tiles_x).len()).sum();
            let mut slot = lists.first[g as usize] + above as u32;
            for row in top.max(rows.start)..bottom.min(rows.end) {
                for x in span(footprint, row, tiles_x) {
                    let tile = (row - rows.start) * tiles_x + x;
                    ends[tile as usize + 1] += 1;
                    found.push((tile, g, slot));
                    slot += 1;
                }
            }
        }
        for tile in 0..tiles {
            ends[tile + 1] += ends[tile];
        }
        let ranges = (0..tiles).map(|t| [ends[t], ends[t + 1]]).collect();
        let mut next = ends;
        let mut gaussians = vec![0; found.len()];
        let places = found
            .into_iter()
            .map(|(tile, g, slot)| {
                let place = next[tile as usize];
                next[tile as usize] += 1;
                gaussians[place as usize] = g;
                (slot, place)
            })
            .collect();
        Self { ranges, gaussians, places }
    }
}

/// Drawn Gaussians by ascending depth; those of the same depth by their number.
fn in_depth_order(projected: &[Projected]) -> Vec<u32> {
    let mut keys: Vec<u64> =
        projected.iter().enumerate().filter(|(_, p)| p.touched > 0).map(|(i, p)| u64::from(p.depth) << 32 | i as u64).collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|k| k as u32).collect()
}
