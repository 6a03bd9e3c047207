//! Reads and writes float images as OpenEXR with named channels.
//!
//! It uses the block interface of the `exr` crate: the whole-image interface takes four times as
//! long to compile as the rest of this crate.

use crate::{Error, Result, fs};
use exr::block::UncompressedBlock;
use exr::block::reader::ChunksReader;
use exr::block::writer::ChunksWriter;
use exr::compression::Compression;
use exr::math::{RoundingMode, Vec2};
use exr::meta::attribute::{
    ChannelDescription, LevelMode, LineOrder, SampleType, Text, TileDescription,
};
use exr::meta::{BlockDescription, header::Header};
use std::io::Cursor;
use std::path::Path;

/// Name and `[h][w]` values of a channel.
pub type Channel = (String, Vec<f32>);

/// Side of a tile in pixels, chosen for run-length encoding.
const TILE: usize = 64;

/// Writes planar float channels atomically. `channels` pairs each name with `[h][w]` values.
///
/// # Errors
/// [`Error::Io`] with the path, or [`Error::Format`] when encoding fails.
pub fn write(path: &Path, width: usize, height: usize, channels: &[(&str, &[f32])]) -> Result<()> {
    let mut sorted = channels.to_vec();
    sorted.sort_by_key(|(name, _)| *name);
    let list = sorted
        .iter()
        .map(|(name, _)| ChannelDescription::new(*name, SampleType::F32, false))
        .collect();
    let tiles = TileDescription {
        tile_size: Vec2(TILE, TILE),
        level_mode: LevelMode::Singular,
        rounding_mode: RoundingMode::Down,
    };
    let header = Header::new(Text::from("fastlgs"), (width, height), list);
    let header = header.with_encoding(
        Compression::RLE,
        BlockDescription::Tiles(tiles),
        LineOrder::Increasing,
    );
    let mut data = Vec::new();
    // Parallel compression would order the blocks by thread timing, so that files would differ.
    let written = exr::block::write(
        Cursor::new(&mut data),
        [header].into_iter().collect(),
        true,
        |meta, chunks| {
            let blocks = meta.collect_ordered_blocks(|index| {
                UncompressedBlock::from_lines(&meta.headers[0].channels, index, |line| {
                    let start = line.location.position.1 * width + line.location.position.0;
                    let values = sorted[line.location.channel].1;
                    line.write_samples(|k| values[start + k])
                        .expect("a line holds its samples");
                })
            });
            let mut compressor = chunks.sequential_blocks_compressor(&meta);
            blocks
                .into_iter()
                .try_for_each(|(place, block)| compressor.compress_block(place, block))
        },
    );
    written.map_err(|e| Error::format(path, format!("cannot encode EXR: {e}")))?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// Reads all channels of the first layer. Returns width, height, and each channel's name and
/// `[h][w]` values.
///
/// # Errors
/// [`Error::Format`] when the file is not a readable EXR.
pub fn read(path: &Path) -> Result<(usize, usize, Vec<Channel>)> {
    let failed = |e: exr::error::Error| Error::format(path, format!("the EXR cannot be read: {e}"));
    let reader = exr::block::read(Cursor::new(fs::read(path)?), false).map_err(failed)?;
    let header = reader.headers()[0].clone();
    let (width, height) = (header.layer_size.0, header.layer_size.1);
    let mut channels: Vec<Channel> = header
        .channels
        .list
        .iter()
        .map(|c| (c.name.to_string(), vec![0.0; width * height]))
        .collect();
    let first = |_: &exr::meta::MetaData,
                 tile: exr::block::chunk::TileCoordinates,
                 block: exr::block::BlockIndex| {
        block.layer == 0 && tile.is_largest_resolution_level()
    };
    let mut blocks = reader
        .filter_chunks(false, first)
        .map_err(failed)?
        .sequential_decompressor(false);
    while let Some(block) = blocks.decompress_next_block() {
        let block = block.map_err(failed)?;
        for line in block.lines(&header.channels) {
            let (_, values) = &mut channels[line.location.channel];
            let start = line.location.position.1 * width + line.location.position.0;
            let row = &mut values[start..start + line.location.sample_count];
            match header.channels.list[line.location.channel].sample_type {
                SampleType::F32 => line.read_samples_into_slice(row).map_err(failed)?,
                SampleType::F16 => {
                    for (to, value) in row.iter_mut().zip(line.read_samples::<exr::prelude::f16>())
                    {
                        *to = value.map_err(failed)?.to_f32();
                    }
                }
                SampleType::U32 => {
                    for (to, value) in row.iter_mut().zip(line.read_samples::<u32>()) {
                        *to = value.map_err(failed)? as f32;
                    }
                }
            }
        }
    }
    Ok((width, height, channels))
}

#[cfg(test)]
mod tests {
    #[test]
    fn round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        let (depth, feature) = ([0.5, 1.25, -3.0, 1e6, 0.0, 7.0], [1.0f32; 6]);
        super::write(&path, 3, 2, &[("Z", &depth), ("feature.0", &feature)]).unwrap();
        let (w, h, channels) = super::read(&path).unwrap();
        assert_eq!((w, h, channels.len()), (3, 2, 2));
        assert_eq!(channels.iter().find(|c| c.0 == "Z").unwrap().1, depth);
    }
}
