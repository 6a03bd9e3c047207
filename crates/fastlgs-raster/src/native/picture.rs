//! What is rendered and its gradient, as rows of tiles are written and read.

use super::blend::{self, Job, Tile};
use crate::view::{TILE, View};
use rayon::prelude::*;

/// Planes padded to whole tiles, `[row][C][padded width]`, so that a row of tiles is one piece of memory.
#[derive(Default)]
pub struct Picture<const C: usize> {
    /// Padded pixels along x.
    pub width: usize,
    /// The values.
    pub data: Vec<f32>,
}

impl<const C: usize> Picture<C> {
    /// Takes the size of a view.
    pub fn prepare(&mut self, view: &View) {
        self.width = (view.tiles[0] * TILE) as usize;
        self.data.resize(C * view.padded_pixels(), 0.0);
    }

    /// A row of pixels of a channel.
    pub fn row(&self, channel: usize, y: usize) -> &[f32] {
        &self.data[(y * C + channel) * self.width..][..self.width]
    }

    /// Rows of pixels, all channels of each.
    pub fn rows_mut(&mut self) -> rayon::slice::ChunksExactMut<'_, f32> {
        self.data.par_chunks_exact_mut(C * self.width)
    }

    /// The pixels of a tile.
    pub fn tile(&self, channel: usize, job: &Job) -> Tile {
        let mut tile = blend::EMPTY;
        for (y, row) in tile.chunks_exact_mut(TILE as usize).enumerate() {
            row.copy_from_slice(&self.row(channel, job.y as usize + y)[job.x as usize..][..TILE as usize]);
        }
        tile
    }
}
