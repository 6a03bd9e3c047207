//! Runs preprocessing and training, and skips finished work.

use crate::error::Context;
use crate::model_choice::{EncoderKind, SamPreset};
use crate::output::{SceneLock, check_apart};
use crate::preprocess::fingerprint;
use crate::{Result, Run, SceneNotes, checkpoints, preprocess, train};
use fastlgs_core::SceneFolder;
use fastlgs_vision::conse;
use fastlgs_vision::crops::Background;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Options of `make`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct MakeConfig {
    /// Options of `preprocess`: photos, scene folder and models.
    #[cfg_attr(feature = "clap", command(flatten))]
    pub preprocess: preprocess::PreprocessConfig,
    /// Length of training.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t = MakeConfig::default().effort))]
    pub effort: train::Preset,
}

impl Default for MakeConfig {
    fn default() -> Self {
        Self {
            preprocess: preprocess::PreprocessConfig::default(),
            effort: train::Preset::Quick,
        }
    }
}

/// Whether a scene was made, or existed already.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// The scene was made.
    Made,
    /// The scene existed already, made from the same photos with the same options.
    Kept,
}

/// Report of `make`.
#[derive(Clone, Debug, Serialize)]
pub struct MakeReport {
    /// Whether the scene was made, or existed already.
    pub state: State,
    /// Number of training photos, and number of held-out photos.
    pub photos: [usize; 2],
    /// Report of the training.
    pub train: train::TrainReport,
}

/// Makes the scene `config.preprocess.output`, and continues an interrupted run.
///
/// # Errors
/// Those of [`preprocess`](crate::preprocess()) and [`train`](crate::train()).
pub fn make(config: &MakeConfig, run: &Run) -> Result<MakeReport> {
    let train = train::TrainConfig {
        scene: config.preprocess.output.clone(),
        preset: config.effort,
        ..Default::default()
    };
    let preprocess = match config.effort {
        train::Preset::LikePaper => like_paper(config.preprocess.clone()),
        _ => config.preprocess.clone(),
    };
    let (state, train) = make_scene(&preprocess, &train, [run, run])?;
    let folder = SceneFolder::open(&config.preprocess.output)?;
    let (manifest, cameras) = (folder.manifest()?, folder.cameras()?);
    Ok(MakeReport {
        state,
        photos: [
            manifest.training(&cameras).len(),
            manifest.held_out(&cameras).len(),
        ],
        train,
    })
}

/// Returns the options of `preprocess` that the paper implies: LangSplat's masks, crops on black, and
/// key points of each photo matched with those of all others.
fn like_paper(mut config: preprocess::PreprocessConfig) -> preprocess::PreprocessConfig {
    config.eyes.sam_preset.get_or_insert(SamPreset::LangSplat);
    if config.eyes.encoder == EncoderKind::Clip {
        config.eyes.crops.get_or_insert(Background::Black);
    }
    config.neighbours = usize::MAX;
    config
}

/// Makes a scene with all options of both stages. `runs` holds the run of `preprocess` and that of
/// `train`. `train.scene` must be `preprocess.output`.
///
/// # Errors
/// Those of both stages.
pub fn make_scene(
    preprocess: &preprocess::PreprocessConfig,
    train: &train::TrainConfig,
    runs: [&Run; 2],
) -> Result<(State, train::TrainReport)> {
    let photos = &preprocess.photos;
    let photos = photos
        .canonicalize()
        .with_context(|| format!("{}: the photos cannot be opened", photos.display()))?;
    check_apart(&photos, &preprocess.output)?;
    let folder = SceneFolder::new(&preprocess.output);
    let made = made_from(&photos, preprocess, train, runs.map(|run| run.seed))?;
    // A scene that cannot be read is made again.
    let known = folder.manifest().ok();
    let known = known.and_then(|manifest| SceneNotes::read(&manifest, &folder.root).ok());
    let known = known.filter(|notes| notes.made.as_ref() == Some(&made));
    let is_complete = [folder.ply_path(), folder.root.join("grid.json")]
        .iter()
        .all(|file| file.is_file());
    if let Some(report) = known
        .as_ref()
        .filter(|_| is_complete)
        .and_then(|notes| notes.train.clone())
    {
        return Ok((State::Kept, report));
    }
    let lock = SceneLock::take(&preprocess.output, "make")?;
    // The cache continues an interrupted preprocessing. The checkpoint continues an interrupted
    // training.
    let can_resume = known.is_some() && checkpoints::can_resume(&folder);
    if !can_resume {
        checkpoints::remove_all(&folder);
        crate::preprocess::preprocess_locked(preprocess, &lock, runs[0])?;
        record(&folder, &made)?;
    }
    let train = train::TrainConfig {
        resume: can_resume || train.resume,
        ..train.clone()
    };
    let report = train::train_locked(&train, &lock, runs[1])?;
    // Record the photos as they were before training: later changes are not in the scene.
    record(&folder, &made)?;
    Ok((State::Made, report))
}

/// Returns what a scene is made from: version, seeds, options and photos. Paths of the scene are
/// left out, because a scene may be moved.
fn made_from(
    photos: &Path,
    preprocess: &preprocess::PreprocessConfig,
    train: &train::TrainConfig,
    seeds: [u64; 2],
) -> Result<serde_json::Value> {
    let preprocess = preprocess::PreprocessConfig {
        photos: photos.to_owned(),
        output: PathBuf::new(),
        ..preprocess.clone()
    };
    let train = train::TrainConfig {
        scene: PathBuf::new(),
        ..train.clone()
    };
    Ok(json!([
        env!("CARGO_PKG_VERSION"),
        conse::VERSION,
        seeds,
        [json!(preprocess), json!(train)],
        fingerprints(photos)?
    ]))
}

/// Records in the manifest the photos and options that the scene was made from.
fn record(folder: &SceneFolder, made: &Value) -> Result<()> {
    let mut manifest = folder.manifest()?;
    let mut notes = SceneNotes::read(&manifest, &folder.root)?;
    notes.made = Some(made.clone());
    notes.store(&mut manifest)?;
    Ok(folder.save_manifest(&manifest)?)
}

/// Returns the fingerprint of a video, or those of all files in a folder by name. Hidden files are
/// skipped.
fn fingerprints(folder: &Path) -> Result<Value> {
    if folder.is_file() {
        return fingerprint(folder);
    }
    let read_error = |error| fastlgs_core::Error::io(folder)(error);
    let mut found = serde_json::Map::new();
    for entry in std::fs::read_dir(folder).map_err(read_error)? {
        let entry = entry.map_err(read_error)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        // Follow links, which are common in folders of photos.
        let Some(about) = std::fs::metadata(entry.path())
            .ok()
            .filter(|_| !name.starts_with('.'))
        else {
            continue;
        };
        let value = if about.is_dir() {
            fingerprints(&entry.path())?
        } else {
            fingerprint(&entry.path())?
        };
        found.insert(name, value);
    }
    Ok(Value::Object(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn like_paper_implies_its_masks_crops_and_matches() {
        let mut config = preprocess::PreprocessConfig::default();
        config.eyes.encoder = EncoderKind::Clip;
        let resolved = like_paper(config.clone());
        assert_eq!(resolved.eyes.sam_preset, Some(SamPreset::LangSplat));
        assert_eq!(resolved.eyes.crops, Some(Background::Black));
        assert_eq!(resolved.neighbours, usize::MAX);
        config.eyes.crops = Some(Background::Grey);
        assert_eq!(like_paper(config).eyes.crops, Some(Background::Grey));
    }

    #[test]
    fn changed_photos_change_the_fingerprint() {
        let dir = tempfile::tempdir().unwrap();
        let images = dir.path().join("images");
        std::fs::create_dir(&images).unwrap();
        std::fs::write(images.join("a.jpg"), "1").unwrap();
        let before = fingerprints(dir.path()).unwrap();
        assert_eq!(before, fingerprints(dir.path()).unwrap());
        std::fs::write(images.join("b.jpg"), "1").unwrap();
        let more = fingerprints(dir.path()).unwrap();
        assert_ne!(before, more);
        std::fs::write(images.join("b.jpg"), "12").unwrap();
        assert_ne!(more, fingerprints(dir.path()).unwrap());
    }
}
