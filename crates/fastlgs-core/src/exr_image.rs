//! Float images as OpenEXR with named channels.

use crate::{Error, Result, fs};
use exr::prelude::*;
use std::path::Path;

/// A named channel with its `[h][w]` values.
pub type Channel = (String, Vec<f32>);

/// Writes planar float channels, atomically. `channels` pairs each name with `[h][w]` values.
///
/// # Errors
/// [`Error::Io`] with the path, or [`Error::Format`] when encoding fails.
pub fn write(path: &Path, width: usize, height: usize, channels: &[(&str, &[f32])]) -> Result<(), Error> {
    let list: Vec<_> = channels.iter().map(|(name, data)| AnyChannel::new(*name, FlatSamples::F32(data.to_vec()))).collect();
    let layer = Layer::new((width, height), LayerAttributes::named("fastlgs"), Encoding::FAST_LOSSLESS, AnyChannels::sort(list.into()));
    let mut data = Vec::new();
    let image = Image::from_layer(layer);
    // In parallel, blocks land in the file in the order in which threads finish.
    let write = image.write().non_parallel().to_buffered(std::io::Cursor::new(&mut data));
    write.map_err(|e| Error::format(path, format!("cannot encode EXR: {e}")))?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// Reads all channels of the first layer as (name, `[h][w]` values), with the size.
///
/// # Errors
/// [`Error::Format`] when the file is no float EXR.
pub fn read(path: &Path) -> Result<(usize, usize, Vec<Channel>), Error> {
    let image = read_first_flat_layer_from_file(path).map_err(|e| Error::format(path, format!("the EXR cannot be read: {e}")))?;
    let size = image.layer_data.size;
    let channels = image.layer_data.channel_data.list.iter().map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect()));
    Ok((size.0, size.1, channels.collect()))
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
