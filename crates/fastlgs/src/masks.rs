//! Masks of a view: reading them, and describing each by its embedding and colour distribution.

use crate::Result;
use crate::error::{Context, bail};
use fastlgs_core::{Camera, LabelMap, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_vision::{Encoder, Level, histogram};
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

/// The masks of a level, which must fit the view's camera; nothing where the level was not kept.
pub fn of_level(folder: &SceneFolder, camera: &Camera, level: Level) -> Result<Option<LabelMap>> {
    let path = folder.masks_path(level.name(), &camera.name);
    if !path.is_file() {
        return Ok(None);
    }
    let map = LabelMap::load(&path)?;
    if (map.width, map.height) != (camera.width, camera.height) {
        bail!("{}: it does not fit the view's camera; run 'fastlgs preprocess' again", path.display());
    }
    Ok(Some(map))
}

/// The masks from which objects are made.
pub fn whole(folder: &SceneFolder, camera: &Camera) -> Result<LabelMap> {
    let path = folder.masks_path(Level::Whole.name(), &camera.name);
    of_level(folder, camera, Level::Whole)?.with_context(|| format!("{} is missing; run 'fastlgs preprocess' again", path.display()))
}
