//! Masks of the training photos, and what describes each.

use super::config::Config;
use super::photos::Known;
use crate::cache::{self, Cache};
use crate::error::Context;
use crate::{Result, Run, masks};
use fastlgs_core::{LabelMap, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_vision::{Encoder, Level, Segmenter};
use std::collections::BTreeMap;

/// Writes the masks of every training photo; returns the mean number of masks a photo by level.
pub(super) fn segment(
    config: &Config,
    segmenter: &dyn Segmenter,
    training: &[Known],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
) -> Result<BTreeMap<String, f64>> {
    let work = run.work("masks", training.len() as u64);
    let mut counts = BTreeMap::new();
    let identity = config.eyes.segmenter_identity()?;
    for photo in training {
        let name = &photo.camera.name;
        let make = || -> Result<[LabelMap; 3]> {
            Ok(segmenter.segment(name, &folder.photo(name)?).with_context(|| format!("segmenting {name}"))?.levels)
        };
        let levels = match &identity {
            Some(identity) => cache.get("masks", &cache::key(&[&photo.key, identity.as_bytes()]), make)?,
            None => make()?,
        };
        for (level, map) in Level::ALL.into_iter().zip(&levels) {
            let path = folder.masks_path(level.name(), name);
            if config.eyes.keeps(level) {
                let masks = map.areas().iter().skip(1).filter(|a| **a > 0).count();
                *counts.entry(level.name().to_owned()).or_default() += masks as f64 / training.len() as f64;
                map.save(&path)?;
            } else if path.is_file() {
                std::fs::remove_file(&path).with_context(|| path.display().to_string())?;
            }
        }
        work.advance()?;
    }
    Ok(counts)
}

/// Embedding and colour distribution of every mask, sorted by view and label.
pub(super) fn describe(
    config: &Config,
    encoder: &dyn Encoder,
    training: &[Known],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
) -> Result<Vec<Mask>> {
    let work = run.work("embeddings", training.len() as u64);
    let mut found = Vec::new();
    let identity = config.eyes.encoder_identity()?;
    for (view, photo) in training.iter().enumerate() {
        let name = &photo.camera.name;
        let labels = masks::whole(folder, &photo.camera)?;
        let make = || masks::described(name, &folder.photo(name)?, 0, &labels, encoder);
        let of_view: Vec<Mask> = match &identity {
            Some(identity) => {
                let inputs = [&photo.key, bytemuck::cast_slice(&labels.labels), identity.as_bytes()];
                cache.get("embeddings", &cache::key(&inputs), make)?
            }
            None => make()?,
        };
        // A photo keeps what is known of it when others come or go before it.
        found.extend(of_view.into_iter().map(|mask| Mask { view, ..mask }));
        work.advance()?;
    }
    Ok(found)
}
