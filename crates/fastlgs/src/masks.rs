//! Masks of a view with their descriptors: embedding and colour histogram.

use crate::cache::{self, Cache};
use crate::{Result, Run, model_choice};
use fastlgs_core::{Camera, Error, LabelMap, Level, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_grid::mask_pairs;
use fastlgs_vision::{Encoder, histogram};
use image::RgbImage;
use rayon::prelude::*;

/// Computes embedding and colour histogram of every mask of a photo, sorted by label. `map` holds
/// the label of each pixel. `view` is the view index that the masks get.
pub fn descriptors(
    name: &str,
    photo: &RgbImage,
    view: usize,
    map: &LabelMap,
    encoder: &dyn Encoder,
) -> Result<Vec<Mask>> {
    let embeddings = encoder.embed_masks(name, photo, map)?;
    let histograms = histogram::histograms(photo, map);
    let areas = map.areas();
    let masks =
        embeddings
            .into_iter()
            .zip(histograms)
            .enumerate()
            .map(|(k, (embedding, histogram))| {
                let area = areas[k + 1] as f32 / map.labels.len() as f32;
                Mask {
                    view,
                    label: k as u16 + 1,
                    area,
                    embedding,
                    histogram,
                }
            });
    Ok(masks.filter(|m| m.area > 0.0).collect())
}

/// Returns the label map of the masks of level whole.
pub fn whole_masks(folder: &SceneFolder, camera: &Camera) -> Result<LabelMap> {
    Ok(folder.masks(camera)?.painted(Level::Whole))
}

/// Returns the descriptors of all masks of the training views, sorted by view and label. Computes
/// and stores them if the scene folder has none for its encoder. Only Algorithm 1 and
/// `fastlgs-bench baseline` need them. Global mapping embeds objects instead of masks.
///
/// # Errors
/// Missing masks or models.
pub fn training_descriptors(
    folder: &SceneFolder,
    training: &[Camera],
    run: &Run,
) -> Result<Vec<Mask>> {
    let manifest = folder.manifest()?;
    if mask_pairs::masks_path(folder).is_file() {
        let (masks, encoder) = mask_pairs::load_masks(folder)?;
        // Stored descriptors may come from another encoder.
        if model_choice::is_current(
            &manifest,
            &encoder,
            masks.iter().map(|mask| &mask.embedding),
        ) {
            return Ok(masks);
        }
    }
    let encoder = model_choice::encoder_of(folder, &manifest)?;
    compute_descriptors(
        folder,
        training,
        encoder.as_ref(),
        Some(&model_choice::identity_of(&manifest)),
        run,
    )
}

/// Computes and stores the descriptors of all masks. `identity` is that of the encoder, for the
/// cache. It is `None` for imported embeddings, which are not cached because their files can
/// change.
pub(crate) fn compute_descriptors(
    folder: &SceneFolder,
    training: &[Camera],
    encoder: &dyn Encoder,
    identity: Option<&str>,
    run: &Run,
) -> Result<Vec<Mask>> {
    let (cache, work) = (
        Cache::new(folder),
        run.work("embeddings", training.len() as u64),
    );
    let of_view = |(view, camera): (usize, &Camera)| -> Result<Vec<Mask>> {
        let labels = whole_masks(folder, camera)?;
        let make = || {
            descriptors(
                &camera.name,
                &folder.photo(&camera.name)?,
                0,
                &labels,
                encoder,
            )
        };
        let found = match identity {
            Some(identity) => {
                let path = folder.photo_path(&camera.name);
                let photo = std::fs::read(&path).map_err(|e| Error::io(&path)(e))?;
                let inputs = [
                    photo.as_slice(),
                    bytemuck::cast_slice(&labels.labels),
                    identity.as_bytes(),
                ];
                cache.get("embeddings", &cache::key(&inputs), make)?
            }
            None => make()?,
        };
        work.advance()?;
        // Cached descriptors have view 0, so that they stay valid when photos are added or removed.
        Ok(found
            .into_iter()
            .map(|mask| Mask { view, ..mask })
            .collect())
    };
    let found: Vec<Mask> = training
        .par_iter()
        .enumerate()
        .map(of_view)
        .collect::<Result<Vec<_>>>()?
        .concat();
    mask_pairs::save_masks(folder, &found, identity.unwrap_or_default())?;
    Ok(found)
}
