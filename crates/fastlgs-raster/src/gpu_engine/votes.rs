//! Votes and saliency on the device.

use super::GpuEngine;
use super::lists::Lists;
use crate::channels::Channels;
use crate::engine::ExposedPhoto;
use crate::lift::{TileLabels, Vote, summed};
use crate::pass::Recorder;
use crate::shader::shaders::{BlendSaliencyBuffers, BlendVotesBuffers};
use crate::view::View;
use crate::{Error, Result};
use fastlgs_core::LabelMap;
use std::ops::Range;

/// Number of tiles that a workgroup processes; `shaders/shared/tile_part.wgsl`.
const TILES_PER_GROUP: u32 = 8;

/// Sums of `shaders/blend_votes.wgsl`: for each tile, its first sum and its number of labels.
struct TileVotes {
    of_tile: Vec<[u32; 2]>,
    /// Number of sums of all tiles.
    total: u64,
}

impl TileVotes {
    fn new(ranges: &[u32], tiles: &[TileLabels]) -> Result<Self> {
        let mut total = 0u64;
        let mut of_tile = Vec::with_capacity(tiles.len());
        for (range, tile) in ranges.chunks_exact(2).zip(tiles) {
            let first = u32::try_from(total).map_err(|_| {
                Error::TooLarge("a view has too many votes; lower the option size".to_owned())
            })?;
            of_tile.push([first, tile.labels.len() as u32]);
            total += u64::from(range[1] - range[0]) * tile.labels.len() as u64;
        }
        Ok(Self { of_tile, total })
    }

    /// Returns the sums of a run of tiles.
    fn sums(&self, tiles: &Range<usize>) -> Range<u64> {
        let first = |tile: usize| {
            self.of_tile
                .get(tile)
                .map_or(self.total, |own| u64::from(own[0]))
        };
        first(tiles.start)..first(tiles.end)
    }

    /// Divides the tiles into runs with at most `most` sums, but at least one tile.
    fn windows(&self, most: u64) -> Vec<Range<usize>> {
        let mut windows: Vec<Range<usize>> = Vec::new();
        for tile in 0..self.of_tile.len() {
            let fits = |window: &Range<usize>| {
                let sums = self.sums(&(window.start..tile + 1));
                sums.end - sums.start <= most
            };
            match windows.last_mut().filter(|window| fits(window)) {
                Some(window) => window.end = tile + 1,
                None => windows.push(tile..tile + 1),
            }
        }
        windows
    }
}

impl GpuEngine {
    /// Runs all passes before blending and `shaders/blend_votes.wgsl`.
    pub(super) fn votes_on_device(&mut self, view: View, map: &LabelMap) -> Result<Vec<Vote>> {
        let mut on_cpu = self.passes_on_cpu;
        let lists = self.prepare(view, Channels::Feature, None, &mut on_cpu)?;
        let view = lists.view;
        let tile_count = view.tile_count() as usize;
        let ranges: Vec<u32> = self.gpu.read(&lists.ranges, 2 * tile_count)?;
        let order: Vec<u32> = self.gpu.read(&lists.sorted_pairs, view.pairs as usize)?;
        let gaussians: Vec<u32> = self.gpu.read(&lists.pair_gaussians, view.pairs as usize)?;
        let tiles: Vec<TileLabels> = (0..tile_count)
            .map(|tile| TileLabels::of(map, &view, tile))
            .collect();
        let tile_votes = TileVotes::new(&ranges, &tiles)?;
        let label_words: Vec<u32> = tiles
            .iter()
            .flat_map(|tile| tile.of_pixel.map(u32::from))
            .collect();
        let labels = self.gpu.storage_with("labels of pixels", &label_words)?;
        let starts = self
            .gpu
            .storage_with("tiles of votes", tile_votes.of_tile.as_flattened())?;

        let mut of_tiles: Vec<Vec<Vote>> = Vec::with_capacity(tile_count);
        for window in tile_votes.windows(self.gpu.max_binding / 4) {
            let sums = tile_votes.sums(&window);
            let sums: Vec<f32> = self.sums_of_window(&lists, sums, &labels, &starts, on_cpu)?;
            let mut sums = sums.as_slice();
            for tile in window {
                let count = tiles[tile].labels.len();
                let pairs = &order[ranges[2 * tile] as usize..ranges[2 * tile + 1] as usize];
                let (own, rest) = sums.split_at(pairs.len() * count);
                sums = rest;
                let votes = pairs.iter().zip(own.chunks_exact(count));
                of_tiles.push(
                    votes
                        .flat_map(|(pair, sums)| tiles[tile].votes(gaussians[*pair as usize], sums))
                        .collect(),
                );
            }
        }
        Ok(summed(&of_tiles))
    }

    /// Returns a window of the sums of `shaders/blend_votes.wgsl`.
    fn sums_of_window(
        &self,
        lists: &Lists,
        sums: Range<u64>,
        labels: &wgpu::Buffer,
        tile_votes: &wgpu::Buffer,
        on_cpu: usize,
    ) -> Result<Vec<f32>> {
        let count = sums.end - sums.start;
        if count == 0 {
            return Ok(Vec::new());
        }
        let view = View {
            slot_first: sums.start as u32,
            slot_count: count as u32,
            ..lists.view
        };
        let votes = &self.gpu.storage("votes", 4 * count)?;
        let mut r = Recorder::new(&self.gpu, on_cpu);
        let buffers = BlendVotesBuffers {
            ranges: &lists.ranges,
            sorted_pairs: &lists.sorted_pairs,
            pair_gaussians: &lists.pair_gaussians,
            splats: &self.gaussians().splats,
            labels,
            tile_votes,
            votes,
        };
        r.run(
            &self.kernels.blend_votes,
            &view,
            buffers,
            view.tile_count().div_ceil(TILES_PER_GROUP),
        )?;
        r.submit();
        self.gpu.read(votes, count as usize)
    }

    /// Runs all passes up to blending and `shaders/blend_saliency.wgsl`.
    pub(super) fn saliency_on_device(
        &mut self,
        view: View,
        photo: Option<&ExposedPhoto>,
        scores: &mut [f32],
    ) -> Result<f64> {
        let mut on_cpu = self.passes_on_cpu;
        let lists = self.forward(view, Channels::Color, None, &mut on_cpu)?;
        let view = lists.view;
        let pixels = view.pixels();
        let mut factors = vec![1.0; 3 * pixels];
        let mut error = 0.0;
        if let Some(photo) = photo {
            let colors = self.read_frame(&view, Channels::Color)?;
            let colors = colors.color();
            for pixel in 0..pixels {
                for (c, factor) in photo.factors(pixel).into_iter().enumerate() {
                    factors[c * pixels + pixel] = factor;
                }
                error += photo.squared_error(pixel, [0, 1, 2].map(|c| colors[c * pixels + pixel]));
            }
        }
        let pairs = view.pairs as usize;
        if pairs == 0 {
            return Ok(error);
        }
        let factors = &self
            .gpu
            .storage_with("factors of saliency", &view.padded(&factors))?;
        let saliency = &self.gpu.storage("saliency", 4 * pairs as u64)?;
        let mut r = Recorder::new(&self.gpu, on_cpu);
        let buffers = BlendSaliencyBuffers {
            ranges: &lists.ranges,
            sorted_pairs: &lists.sorted_pairs,
            pair_gaussians: &lists.pair_gaussians,
            splats: &self.gaussians().splats,
            frame: &self.picture().frame,
            factors,
            saliency,
        };
        r.run(
            &self.kernels.blend_saliency,
            &view,
            buffers,
            view.tile_count().div_ceil(TILES_PER_GROUP),
        )?;
        r.submit();
        let order: Vec<u32> = self.gpu.read(&lists.sorted_pairs, pairs)?;
        let gaussians: Vec<u32> = self.gpu.read(&lists.pair_gaussians, pairs)?;
        let changes: Vec<f32> = self.gpu.read(saliency, pairs)?;
        for (pair, change) in order.iter().zip(changes) {
            scores[gaussians[*pair as usize] as usize] += change;
        }
        Ok(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_are_runs_of_tiles_with_few_enough_sums() {
        let tile = |labels: u16| TileLabels {
            labels: (0..labels).collect(),
            of_pixel: [0; 64],
        };
        // 10, 0, 20, 30 and 5 sums.
        let ranges = [0, 10, 10, 10, 10, 20, 20, 30, 30, 35];
        let tiles = [1, 1, 2, 3, 1].map(tile);
        let votes = TileVotes::new(&ranges, &tiles).unwrap();
        assert_eq!(votes.total, 65);
        assert_eq!(votes.windows(30), [0..3, 3..4, 4..5]);
        assert_eq!(votes.windows(1000), vec![0..5; 1]);
        assert_eq!(votes.sums(&(2..4)), 10..60);
        // A tile alone may exceed the limit; the device then refuses the buffer.
        assert_eq!(votes.windows(1).len(), 5);
    }
}
