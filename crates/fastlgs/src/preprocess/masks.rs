//! Masks of the training photos, and what describes each.

use super::config::Config;
use super::photos::Known;
use crate::cache::{self, Cache};
use crate::error::Context;
use crate::{Result, Run, masks};
use fastlgs_core::{Level, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_vision::{Encoder, Segmenter};
use rayon::prelude::*;
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
    let identity = config.eyes.segmenter_identity()?;
    let of_photo = |photo: &Known| -> Result<[usize; 3]> {
        let name = &photo.camera.name;
        let make = || segmenter.segment(name, &folder.photo(name)?).with_context(|| format!("segmenting {name}"));
        let mut list = match &identity {
            Some(identity) => cache.get("masks", &cache::key(&[b"list", &photo.key, identity.as_bytes()]), make)?,
            None => make()?,
        };
        list.masks.retain(|mask| config.eyes.keeps(mask.level));
        list.save(&folder.masks_path(name))?;
        work.advance()?;
        Ok(Level::ALL.map(|level| list.count(level)))
    };
    let counts = training.par_iter().map(of_photo).collect::<Result<Vec<_>>>()?;
    let mean = |k: usize| counts.iter().map(|c| c[k]).sum::<usize>() as f64 / training.len() as f64;
    let kept = Level::ALL.into_iter().filter(|level| config.eyes.keeps(*level));
    Ok(kept.map(|level| (level.name().to_owned(), mean(level as usize))).collect())
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
    let identity = config.eyes.encoder_identity()?;
    let of_photo = |(view, photo): (usize, &Known)| -> Result<Vec<Mask>> {
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
        work.advance()?;
        // A photo keeps what is known of it when others come or go before it.
        Ok(of_view.into_iter().map(|mask| Mask { view, ..mask }).collect())
    };
    let found = training.par_iter().enumerate().map(of_photo).collect::<Result<Vec<_>>>()?;
    Ok(found.into_iter().flatten().collect())
}
