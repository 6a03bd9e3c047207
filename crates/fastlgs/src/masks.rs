//! Masks of a view, and what describes each: its embedding and colour distribution.

use crate::Result;
use fastlgs_core::{Camera, LabelMap, Level, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_vision::{Encoder, histogram};
use image::RgbImage;

/// Embedding and colour distribution of every mask of a photo, by label.
pub fn described(name: &str, photo: &RgbImage, view: usize, map: &LabelMap, encoder: &dyn Encoder) -> Result<Vec<Mask>> {
    let embeddings = encoder.embed_masks(name, photo, map)?;
    let histograms = histogram::histograms(photo, map);
    let areas = map.areas();
    let masks = embeddings.into_iter().zip(histograms).enumerate().map(|(k, (embedding, histogram))| {
        let area = areas[k + 1] as f32 / map.labels.len() as f32;
        Mask { view, label: k as u16 + 1, area, embedding, histogram }
    });
    Ok(masks.filter(|m| m.area > 0.0).collect())
}

/// The masks of the paper's *whole* level, one a pixel.
pub fn whole(folder: &SceneFolder, camera: &Camera) -> Result<LabelMap> {
    Ok(folder.masks(camera)?.painted(Level::Whole))
}
