//! Segments the training photos.

use super::config::PreprocessConfig;
use super::photos::PreparedPhoto;
use crate::cache::{self, Cache};
use crate::error::{Context, bail};
use crate::model_choice::SegmenterKind;
use crate::{Result, Run};
use fastlgs_core::undistort::Distortion;
use fastlgs_core::{Level, MaskList, SceneFolder};
use fastlgs_vision::Segmenter;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Segments every training photo and writes its masks. Returns the number of masks, and the mean
/// number per photo by level.
///
/// # Errors
/// No training photo has a mask, the segmenter fails, or the run is cancelled.
pub(super) fn segment(
    config: &PreprocessConfig,
    segmenter: &dyn Segmenter,
    training: &[PreparedPhoto],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
) -> Result<(usize, BTreeMap<String, f64>)> {
    let work = run.work("masks", training.len() as u64);
    let identity = config.eyes.segmenter_identity()?;
    let of_photo = |photo: &PreparedPhoto| -> Result<[usize; 3]> {
        let make = || {
            let name = &photo.camera.name;
            segmenter
                .segment(name, &folder.photo(name)?)
                .with_context(|| format!("segmenting {name}"))
        };
        let list = match &identity {
            Some(identity) => cache.get("masks", &mask_key(photo, identity), make)?,
            None => make()?,
        };
        let list = kept_masks(config, photo, list);
        list.save(&folder.masks_path(&photo.camera.name))?;
        work.advance()?;
        Ok(Level::ALL.map(|level| list.count(level)))
    };
    let is_known = |photo: &&PreparedPhoto| {
        identity
            .as_ref()
            .is_some_and(|identity| cache.has("masks", &mask_key(photo, identity)))
    };
    let missing = training.len() - training.iter().filter(is_known).count();
    if missing > 0 {
        let first = folder.photo(&training[0].camera.name)?;
        if let Some(seconds) = segmenter.seconds_per_photo(&first)? {
            run.note(&estimate(seconds, missing));
        }
    }
    let counts: Vec<[usize; 3]> = if segmenter.is_parallel() {
        training.par_iter().map(of_photo).collect::<Result<_>>()?
    } else {
        training.iter().map(of_photo).collect::<Result<_>>()?
    };
    if counts.iter().flatten().all(|count| *count == 0) {
        bail!(
            "{}: no mask was found in any training photo; check the segmenter or the imported masks",
            config.photos.display()
        );
    }
    let photos_without_masks: Vec<&str> = training
        .iter()
        .zip(&counts)
        .filter(|(_, c)| c.iter().all(|n| *n == 0))
        .map(|(p, _)| p.camera.name.as_str())
        .collect();
    if !photos_without_masks.is_empty() && config.eyes.segmenter == SegmenterKind::Import {
        run.warn(&format!(
            "{} of {} photos have no mask, or only empty ones: {}",
            photos_without_masks.len(),
            training.len(),
            photos_without_masks.join(", ")
        ));
    }
    let mean = |k: usize| counts.iter().map(|c| c[k]).sum::<usize>() as f64 / training.len() as f64;
    let kept = Level::ALL.into_iter();
    let kept = kept.filter(|level| config.eyes.keeps(*level));
    let means = kept
        .map(|level| (level.name().to_owned(), mean(level as usize)))
        .collect();
    Ok((counts.iter().flatten().sum(), means))
}

/// Returns the cache key of the masks of a photo.
fn mask_key(photo: &PreparedPhoto, segmenter: &str) -> cache::Key {
    cache::key(&[b"list", &photo.key, segmenter.as_bytes()])
}

/// Returns a sentence with the time that segmenting some photos takes.
fn estimate(seconds_per_photo: f64, photos: usize) -> String {
    let minutes = seconds_per_photo * photos as f64 / 60.0;
    let time = match minutes {
        0.0..1.5 => "about a minute".to_owned(),
        1.5..100.0 => format!("about {minutes:.0} minutes"),
        _ => format!("about {:.1} hours", minutes / 60.0),
    };
    format!(
        "masks: {photos} photos at {seconds_per_photo:.0} s each take {time}; the masks of each photo are kept, so an \
         interrupted run continues"
    )
}

/// Returns the masks of a photo that are kept, in the pixels of the prepared photo.
fn kept_masks(config: &PreprocessConfig, photo: &PreparedPhoto, mut list: MaskList) -> MaskList {
    if photo.removed_k1 != 0.0 && config.eyes.segmenter == SegmenterKind::Import {
        // Imported masks show the photo before its additional distortion was removed.
        let distortion = Distortion {
            k1: photo.removed_k1,
            ..Distortion::default()
        };
        list = list.undistorted(&photo.camera, &distortion);
    }
    list.masks
        .retain(|mask| config.eyes.keeps(mask.level) && mask.runs.area() > 0);
    list
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn estimates_have_a_readable_unit() {
        assert!(estimate(0.4, 20).contains("about a minute"));
        assert!(estimate(38.0, 43).contains("43 photos at 38 s each take about 27 minutes"));
        assert!(estimate(190.0, 84).contains("about 4.4 hours"));
    }
}
