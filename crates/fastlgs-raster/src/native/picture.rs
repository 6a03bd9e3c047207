//! Image planes of the CPU engine, laid out so that a row of tiles is contiguous.

use super::blend::{self, Job, Tile};
use crate::view::{TILE, View};
use rayon::prelude::*;

/// Planes padded to whole tiles, `[row][C][padded width]`. A row of tiles is contiguous in memory.
#[derive(Default)]
pub struct TiledPlanes<const C: usize> {
    /// Padded width in pixels.
    pub width: usize,
    /// Values of all planes.
    pub data: Vec<f32>,
}

impl<const C: usize> TiledPlanes<C> {
    /// Resizes the planes for a view.
    pub fn prepare(&mut self, view: &View) {
        self.width = (view.tiles[0] * TILE) as usize;
        self.data.resize(C * view.padded_pixels(), 0.0);
    }

    /// Returns a row of pixels of one channel.
    pub fn row(&self, channel: usize, y: usize) -> &[f32] {
        &self.data[(y * C + channel) * self.width..][..self.width]
    }

    /// Iterates in parallel over the rows of pixels, each with all channels.
    pub fn rows_mut(&mut self) -> rayon::slice::ChunksExactMut<'_, f32> {
        self.data.par_chunks_exact_mut(C * self.width)
    }

    /// Returns the pixels of a tile of one channel.
    pub fn tile(&self, channel: usize, job: &Job) -> Tile {
        let mut tile = blend::EMPTY;
        for (y, row) in tile.chunks_exact_mut(TILE as usize).enumerate() {
            row.copy_from_slice(
                &self.row(channel, job.y as usize + y)[job.x as usize..][..TILE as usize],
            );
        }
        tile
    }
}
