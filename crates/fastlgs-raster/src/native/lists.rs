//! Projection, depth order and tile lists.

use super::simd::{AHEAD, prefetch, vectorised};
use crate::cpu::{self, Footprint, NOT_DRAWN, Splat, span};
use crate::view::View;
use rayon::prelude::*;

/// Projected Gaussians of a view and its tile lists: the input of blending.
pub(crate) struct Lists {
    /// Projected Gaussians.
    pub splats: Vec<Splat>,
    /// Half height in pixels of the ellipse on which alpha equals the minimum, for each Gaussian.
    pub reach: Vec<f32>,
    /// One band for each row of tiles.
    pub bands: Vec<Band>,
    /// Positions of each Gaussian in the concatenated `gaussians` of all bands. Those of Gaussian
    /// `g` are `positions[first[g]..first[g + 1]]`.
    pub positions: Vec<u32>,
    /// Start of each Gaussian's range in `positions`, and the end of the last range.
    pub first: Vec<u32>,
}

/// A row of tiles. Gradients are summed for each row, so that the sums stay in the cache while its
/// tiles are processed.
pub(crate) struct Band {
    /// Gaussians that touch the row, front to back.
    pub gaussians: Vec<u32>,
    /// Concatenated lists of the row's tiles: indices into `gaussians`, front to back.
    pairs: Vec<u32>,
    /// End of each tile's list in `pairs`.
    ends: Vec<u32>,
}

/// The columns that one Gaussian touches in a row of tiles.
struct Touch {
    gaussian: u32,
    columns: std::ops::Range<u32>,
}

/// Pixels added to `reach`, because alphas are rounded.
const ROUNDING: f32 = 0.01;

/// Number of parts in which Gaussians are assigned to rows of tiles, independent of the number of
/// threads.
const PARTS: usize = 16;

impl Lists {
    /// Builds the lists of a view from trained values `[n][channels]`.
    pub fn new(view: &View, params: &[f32]) -> Self {
        let projection = Projection::new(view, params);
        let bands = bands(view, &projection);
        let (first, positions) = positions(&bands, projection.splats.len());
        let reach = projection
            .footprints
            .par_iter()
            .map(|footprint| footprint[1][0].sqrt() + ROUNDING)
            .collect();
        Self {
            splats: projection.splats,
            reach,
            bands,
            positions,
            first,
        }
    }

    /// Projects the Gaussians again and keeps the lists. Only values that do not move geometry may
    /// have changed.
    pub fn refresh(&mut self, view: &View, params: &[f32]) {
        self.splats = Projection::new(view, params).splats;
    }

    /// Returns the size of the lists in bytes.
    pub fn bytes(&self) -> usize {
        let words = |band: &Band| band.gaussians.len() + band.pairs.len() + band.ends.len();
        let words: usize = self.bands.iter().map(words).sum();
        size_of_val(self.splats.as_slice())
            + 4 * (words + self.reach.len() + self.positions.len() + self.first.len())
    }

    /// Returns the positions of a Gaussian, or an empty slice beyond the last Gaussian.
    pub fn positions_of(&self, gaussian: usize) -> &[u32] {
        match self.first.get(gaussian..gaussian + 2) {
            Some([first, end]) => &self.positions[*first as usize..*end as usize],
            _ => &[],
        }
    }

    /// Returns the number of (tile, Gaussian) pairs.
    pub fn pairs(&self) -> usize {
        self.bands.iter().map(|band| band.pairs.len()).sum()
    }
}

impl Band {
    /// Builds the lists of a row from `touches`, which are sorted front to back. The counting sort
    /// by column is stable and keeps that order.
    fn new<'a>(columns: u32, touches: impl Iterator<Item = &'a Touch> + Clone) -> Self {
        let mut next = vec![0; columns as usize + 1];
        for column in touches.clone().flat_map(|t| t.columns.clone()) {
            next[column as usize + 1] += 1;
        }
        for column in 0..columns as usize {
            next[column + 1] += next[column];
        }
        let mut pairs = vec![0; next[columns as usize] as usize];
        for (place, touch) in touches.clone().enumerate() {
            for next in &mut next[touch.columns.start as usize..touch.columns.end as usize] {
                pairs[*next as usize] = place as u32;
                *next += 1;
            }
        }
        next.pop();
        Self {
            gaussians: touches.map(|t| t.gaussian).collect(),
            pairs,
            ends: next,
        }
    }

    /// Returns the list of a tile: indices into `gaussians`, front to back.
    pub fn tile(&self, column: usize) -> &[u32] {
        let start = if column == 0 {
            0
        } else {
            self.ends[column - 1]
        };
        &self.pairs[start as usize..self.ends[column] as usize]
    }
}

/// Number of Gaussians that one task projects.
const BLOCK: usize = 256;

/// All Gaussians of a view, projected. One vector for each purpose, because a step reads each of
/// them alone.
struct Projection {
    splats: Vec<Splat>,
    /// Depth keys; [`NOT_DRAWN`] for Gaussians that are not drawn.
    depths: Vec<u32>,
    footprints: Vec<Footprint>,
}

impl Projection {
    /// Projects all Gaussians from trained values `[n][channels]`.
    fn new(view: &View, params: &[f32]) -> Self {
        let n = view.gaussians as usize;
        let mut all = Self {
            splats: vec![[[0.0; 4]; 3]; n],
            depths: vec![NOT_DRAWN; n],
            footprints: vec![[[0.0; 4]; 2]; n],
        };
        let width = (params.len() / n.max(1)).max(1);
        let splats = all.splats.par_chunks_mut(BLOCK);
        let depths = all.depths.par_chunks_mut(BLOCK);
        let footprints = all.footprints.par_chunks_mut(BLOCK);
        let blocks = splats.zip(depths).zip(footprints).enumerate();
        blocks.zip(params.par_chunks(BLOCK * width)).for_each(
            |((block, ((splats, depths), footprints)), params)| {
                let out = ProjectedBlock {
                    first: (block * BLOCK) as u32,
                    splats,
                    depths,
                    footprints,
                };
                project_block(view, width, params, out)
            },
        );
        all
    }
}

/// Neighbouring Gaussians of a [`Projection`] that one task projects.
struct ProjectedBlock<'a> {
    /// Index of the first one.
    first: u32,
    splats: &'a mut [Splat],
    depths: &'a mut [u32],
    footprints: &'a mut [Footprint],
}

vectorised! {
    /// Projects the Gaussians of a block. On entry all of them are marked as not drawn.
    fn project_block(view: &View, width: usize, params: &[f32], out: ProjectedBlock) = project_block_body
}

#[inline(always)]
fn project_block_body<const FMA: bool>(
    view: &View,
    width: usize,
    params: &[f32],
    out: ProjectedBlock,
) {
    for (k, params) in params.chunks_exact(width).enumerate() {
        if let Some(drawn) = cpu::project_one(view, out.first + k as u32, |c| params[c]) {
            out.splats[k] = drawn.splat;
            out.depths[k] = drawn.depth;
            out.footprints[k] = drawn.footprint;
        }
    }
}

/// Returns the drawn Gaussians by ascending depth. Equal depths are ordered by index.
fn in_depth_order(depths: &[u32]) -> Vec<u32> {
    let drawn = (0..)
        .zip(depths)
        .filter(|(_, depth)| **depth != NOT_DRAWN)
        .map(|(g, _)| g)
        .collect();
    // Radix sort: the lower digit first, as the stable sort by the higher digit keeps its order.
    [0, DIGIT].into_iter().fold(drawn, |order, shift| {
        by_digit(&order, |g| {
            (depths[g as usize] >> shift) as usize % (1 << DIGIT)
        })
    })
}

/// Bits of a radix digit. A depth key has two digits.
const DIGIT: u32 = 12;
const _: () = assert!(NOT_DRAWN < 1 << (2 * DIGIT));

/// Sorts stably by one digit (counting sort).
fn by_digit(order: &[u32], digit: impl Fn(u32) -> usize) -> Vec<u32> {
    let mut next = vec![0; (1 << DIGIT) + 1];
    order.iter().for_each(|g| next[digit(*g) + 1] += 1);
    for digit in 0..1 << DIGIT {
        next[digit + 1] += next[digit];
    }
    let mut sorted = vec![0; order.len()];
    for g in order {
        let place: &mut usize = &mut next[digit(*g)];
        sorted[*place] = *g;
        *place += 1;
    }
    sorted
}

/// Builds the rows of tiles, each with its Gaussians in depth order.
fn bands(view: &View, projection: &Projection) -> Vec<Band> {
    let order = in_depth_order(&projection.depths);
    let touched = |gaussians: &[u32]| {
        let mut rows: Vec<Vec<Touch>> = (0..view.tiles[1]).map(|_| Vec::new()).collect();
        touches(view, &projection.footprints, gaussians, &mut rows);
        rows
    };
    let parts: Vec<Vec<Vec<Touch>>> = order
        .par_chunks(order.len().div_ceil(PARTS).max(1))
        .map(touched)
        .collect();
    let band = |row: usize| Band::new(view.tiles[0], parts.iter().flat_map(|rows| &rows[row]));
    (0..view.tiles[1] as usize)
        .into_par_iter()
        .map(band)
        .collect()
}

/// Number of rows of tiles whose spans are computed together, so that the loop vectorises.
const ROWS: usize = 8;

vectorised! {
    /// Appends each Gaussian to the rows of tiles that it touches, in the order of `gaussians`.
    fn touches(view: &View, footprints: &[Footprint], gaussians: &[u32], rows: &mut [Vec<Touch>]) = touches_body
}

#[inline(always)]
fn touches_body<const FMA: bool>(
    view: &View,
    footprints: &[Footprint],
    gaussians: &[u32],
    rows: &mut [Vec<Touch>],
) {
    for (k, &gaussian) in gaussians.iter().enumerate() {
        if let Some(later) = gaussians.get(k + AHEAD) {
            prefetch(&footprints[*later as usize]);
        }
        let footprint = &footprints[gaussian as usize];
        let end = (footprint[1][3] as u32).min(view.tiles[1]);
        for first in (footprint[1][2] as u32..end).step_by(ROWS) {
            let (mut starts, mut ends) = ([0; ROWS], [0; ROWS]);
            for k in 0..ROWS {
                let columns = span(footprint, first + k as u32, view.tiles[0]);
                (starts[k], ends[k]) = (columns.start, columns.end);
            }
            for (row, (start, end)) in (first..end)
                .zip(starts.into_iter().zip(ends))
                .filter(|(_, (start, end))| start < end)
            {
                rows[row as usize].push(Touch {
                    gaussian,
                    columns: start..end,
                });
            }
        }
    }
}

/// Returns `first` and `positions` of `Lists`.
fn positions(bands: &[Band], count: usize) -> (Vec<u32>, Vec<u32>) {
    let all = || {
        bands
            .iter()
            .flat_map(|band| &band.gaussians)
            .map(|g| *g as usize)
    };
    let mut first = vec![0; count + 1];
    all().for_each(|g| first[g + 1] += 1);
    for g in 0..count {
        first[g + 1] += first[g];
    }
    let (mut next, mut places) = (first.clone(), vec![0; first[count] as usize]);
    for (place, g) in all().enumerate() {
        places[next[g] as usize] = place as u32;
        next[g] += 1;
    }
    (first, places)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    #[test]
    fn depths_are_sorted_and_ties_keep_their_order() {
        let mut rng = Rng::new(3, "depths");
        let mut depths = vec![0, NOT_DRAWN, 0xfff, 0x1000, NOT_DRAWN - 1, 0xfff, 0, 0x1001];
        depths.extend((0..500).map(|_| (rng.uniform() * 300.0) as u32 * 0x777));
        let mut expected: Vec<u32> = (0..depths.len() as u32)
            .filter(|g| depths[*g as usize] != NOT_DRAWN)
            .collect();
        expected.sort_by_key(|g| depths[*g as usize]);
        assert_eq!(in_depth_order(&depths), expected);
        assert!(in_depth_order(&[]).is_empty());
    }

    #[test]
    fn tile_lists_contain_exactly_the_gaussians_that_touch_the_tile() {
        // 19 rows of tiles. The ellipses cover from less than one row to more than all rows.
        let view = View::new(&crate::tests::camera(90, 150), 4, 0);
        let round = |x: f32, y: f32, r: f32| {
            let rows = |y: f32| (y / 8.0).floor().clamp(0.0, 19.0);
            [
                [x, y, 0.0, 1.0],
                [r * r, 0.0, rows(y - r), rows(y + r) + 1.0],
            ]
        };
        let footprints = [
            round(40.0, 70.0, 65.0),
            round(3.0, 3.0, 1.5),
            round(88.0, 148.0, 30.0),
            round(45.0, 75.0, 300.0),
        ];
        let projection = Projection {
            splats: vec![[[0.0; 4]; 3]; 4],
            depths: vec![4, 3, 2, 1],
            footprints: footprints.to_vec(),
        };
        let bands = bands(&view, &projection);
        assert_eq!(bands.len(), 19);
        for (row, band) in (0..).zip(&bands) {
            let [first, end] = [2, 3].map(|k| footprints.map(|f| f[1][k] as u32));
            let within = |g: &u32| (first[*g as usize]..end[*g as usize]).contains(&row);
            for column in 0..view.tiles[0] {
                let there = |g: &u32| {
                    within(g)
                        && span(&footprints[*g as usize], row, view.tiles[0]).contains(&column)
                };
                let wanted: Vec<u32> = [3, 2, 1, 0].into_iter().filter(there).collect();
                let found: Vec<u32> = band
                    .tile(column as usize)
                    .iter()
                    .map(|place| band.gaussians[*place as usize])
                    .collect();
                assert_eq!(found, wanted, "row {row}, column {column}");
            }
        }
        assert!(bands[18].tile(11).len() == 2 && bands[0].tile(0).len() == 2);
    }
}
