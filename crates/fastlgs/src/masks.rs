//! Masks of a view, and what describes each: its embedding and colour distribution.

use crate::cache::{self, Cache};
use crate::{Result, Run, eyes};
use fastlgs_core::{Camera, Error, LabelMap, Level, SceneFolder};
use fastlgs_grid::evidence;
use fastlgs_grid::mapping::Mask;
use fastlgs_vision::{Encoder, histogram};
use image::RgbImage;
use rayon::prelude::*;

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

/// What describes every mask of the training views, sorted by view and label; kept in the scene folder. Only Algorithm 1 and fields
/// without objects ask for it: global mapping embeds what it finds.
///
/// # Errors
/// Missing masks or models.
pub fn evidence(folder: &SceneFolder, training: &[Camera], run: &Run) -> Result<Vec<Mask>> {
    let manifest = folder.manifest()?;
    if evidence::masks_path(folder).is_file() {
        let (masks, encoder) = evidence::load_masks(folder)?;
        // An earlier version may have left them.
        if eyes::is_current(&manifest, &encoder, masks.iter().map(|mask| &mask.embedding)) {
            return Ok(masks);
        }
    }
    let encoder = eyes::encoder_of(folder, &manifest)?;
    describe(folder, training, encoder.as_ref(), Some(&eyes::identity_of(&manifest)), run)
}

/// The same anew. `identity` tells what made the embeddings; without it they come from files that may change unseen.
pub(crate) fn describe(
    folder: &SceneFolder,
    training: &[Camera],
    encoder: &dyn Encoder,
    identity: Option<&str>,
    run: &Run,
) -> Result<Vec<Mask>> {
    let (cache, work) = (Cache::new(folder), run.work("embeddings", training.len() as u64));
    let of_view = |(view, camera): (usize, &Camera)| -> Result<Vec<Mask>> {
        let labels = whole(folder, camera)?;
        let make = || described(&camera.name, &folder.photo(&camera.name)?, 0, &labels, encoder);
        let found = match identity {
            Some(identity) => {
                let path = folder.photo_path(&camera.name);
                let photo = std::fs::read(&path).map_err(|e| Error::io(&path)(e))?;
                let inputs = [photo.as_slice(), bytemuck::cast_slice(&labels.labels), identity.as_bytes()];
                cache.get("embeddings", &cache::key(&inputs), make)?
            }
            None => make()?,
        };
        work.advance()?;
        // A photo keeps what is known of it when others come or go before it.
        Ok(found.into_iter().map(|mask| Mask { view, ..mask }).collect())
    };
    let found: Vec<Mask> = training.par_iter().enumerate().map(of_view).collect::<Result<Vec<_>>>()?.concat();
    evidence::save_masks(folder, &found, identity.unwrap_or_default())?;
    Ok(found)
}
