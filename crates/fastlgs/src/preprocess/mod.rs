//! Preprocessing: turns photos into masks, poses, key point matches and points.

mod config;
mod masks;
mod matches;
mod photos;
mod poses;
mod video;

use crate::SceneNotes;
use crate::cache::Cache;
use crate::error::{Context, bail};
use crate::model_choice::EncoderKind;
use crate::output::{SceneLock, check_apart};
use crate::staged::StagedOutput;
use crate::{Result, Run, calibrations, checkpoints};
pub use config::{Adjusted, Brightness, Poses, PreprocessConfig, PreprocessReport, Sfm};
use fastlgs_core::dataset::Dataset;
use fastlgs_core::scene_folder::{Manifest, find_view};
use fastlgs_core::{Camera, SceneFolder, dataset, labels};
use fastlgs_grid::evidence;
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::video::is_video;
use fastlgs_vision::{brightness, import, sweep, tracks};
use photos::PreparedPhoto;
pub use photos::{Photo, load_photo};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;
pub(crate) use video::fingerprint;

/// Files and folders of the scene that preprocessing replaces, besides the manifest.
const REPLACED: [&str; 9] = [
    "photos",
    "alpha",
    "ignore",
    "sparse",
    "cameras",
    "masks",
    "points.safetensors",
    "pairs.safetensors",
    "embeddings.safetensors",
];

/// Preprocesses photos: writes masks, cameras, points and key point matches into the scene folder
/// `config.output`. Imported embeddings are written, too.
///
/// # Errors
/// Photos that cannot be read, poses that fit no photo, fewer than two training photos, missing
/// models, or a cancelled run. The earlier scene then stays unchanged, and the next run reuses
/// finished results.
pub fn preprocess(config: &PreprocessConfig, run: &Run) -> Result<PreprocessReport> {
    check_apart(&config.photos, &config.output)?;
    preprocess_locked(config, &SceneLock::take(&config.output, "preprocess")?, run)
}

/// Preprocesses into a scene that the caller has locked.
pub(crate) fn preprocess_locked(
    config: &PreprocessConfig,
    _lock: &SceneLock,
    run: &Run,
) -> Result<PreprocessReport> {
    let started = Instant::now();
    let mut seconds = BTreeMap::new();
    let mut clock = Instant::now();
    let mut lap = |stage: &str| {
        seconds.insert(format!("preprocess.{stage}"), clock.elapsed().as_secs_f64());
        clock = Instant::now();
    };
    config.eyes.check()?;
    if config.max_side < 64 {
        bail!(
            "max_side {} is too small; it must be at least 64 pixels",
            config.max_side
        );
    }
    let of_video = |video| {
        Ok::<_, crate::Error>(PreprocessConfig {
            photos: video::photos(video, &SceneFolder::new(&config.output), run)?,
            ..config.clone()
        })
    };
    let of_video = Some(&config.photos)
        .filter(|photos| is_video(photos))
        .map(|video| of_video(video))
        .transpose()?;
    let config = of_video.as_ref().unwrap_or(config);
    if of_video.is_some() {
        lap("frames");
    }
    let scene = SceneFolder::new(&config.output);
    let cache = Cache::new(&scene);
    let staged = StagedOutput::new(&scene, "preprocess")?;
    let folder = staged.folder.clone();
    let mut dataset = if dataset::images_folder(&config.photos).is_some()
        && !dataset::has_poses(&config.photos)
    {
        let found = poses::find(&config.photos, &folder, &cache, config.sfm, run)?;
        lap("poses");
        found
    } else {
        dataset::load(&config.photos)?
    };
    dataset.earlier_frame = scene.manifest().ok().map(|earlier| earlier.frame);
    let lenses = import::lenses(&dataset);
    // Load the models first, so that a missing one is reported before minutes of work.
    let segmenter = config.eyes.segmenter(&config.photos, &lenses)?;
    let encoder = config.eyes.encoder(&config.photos, &lenses)?;
    // Only imported embeddings are stored here, because their files may disappear later.
    let imported = Some(encoder).filter(|_| config.eyes.encoder == EncoderKind::Import);
    dataset
        .warnings
        .iter()
        .for_each(|warning| run.warn(warning));
    let given: Vec<Camera> = dataset
        .photos
        .iter()
        .map(|photo| photo.camera.clone())
        .collect();
    let (holdout, held_out_views) = held_out(config, &dataset, &given)?;
    let models = config.eyes.files()?;
    let mut known = photos::load(&dataset, config, &folder, &cache, run)?;
    lap("photos");
    let mut warnings = dataset.warnings.clone();
    photos::check_masks(&known, run, &mut warnings)?;
    photos::warn_of_bad_photos(&known, run, &mut warnings);
    poses::settle_convention(
        &mut dataset,
        &mut known,
        config.pose_convention,
        run,
        &mut warnings,
    )?;
    let mut checked = match config.poses {
        Poses::Keep => Default::default(),
        Poses::Check | Poses::Refine => {
            poses::check(&mut known, &folder, &cache, run, &mut warnings)?
        }
    };
    if config.poses != Poses::Keep {
        poses::leave_out_lost(&known, &cache, &mut checked)?;
    }
    lap("pose_check");
    let matches = matches::match_photos(
        &known,
        &checked.contradictory,
        config.neighbours,
        &cache,
        run,
    )?;
    lap("matches");
    poses::place(&mut known, &mut checked, &matches);
    poses::warn(&known, &checked, run, &mut warnings);
    let adjusted = match config.poses {
        Poses::Keep => None,
        asked => poses::adjust(&mut known, &matches, asked, &folder, run, &mut warnings)?,
    };
    lap("adjusting");
    let cameras: Vec<Camera> = known.iter().map(|p| p.camera.clone()).collect();
    folder.save_cameras(&cameras)?;
    let excluded: Vec<String> = checked
        .contradictory
        .iter()
        .map(|&i| cameras[i].name.clone())
        .collect();
    let mut manifest = Manifest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        photos: config.photos.clone(),
        holdout,
        held_out_views,
        segmenter: config.eyes.segmenter.name().to_owned(),
        encoder: config.eyes.encoder.name().to_owned(),
        crops: calibrations::word_of(calibrations::best_background(&models)),
        models,
        seed: run.seed,
        warnings: warnings.clone(),
        excluded,
        frame: dataset.frame,
        files: BTreeSet::new(),
        seconds: BTreeMap::new(),
        notes: BTreeMap::new(),
    };
    photos::color_points(&mut dataset, &known, &folder)?;
    let usable = |i: usize| {
        !manifest.is_held_out(i, &cameras[i].name) && !checked.contradictory.contains(&i)
    };
    let kept: Vec<usize> = (0..known.len()).filter(|&i| usable(i)).collect();
    let training: Vec<PreparedPhoto> = known
        .into_iter()
        .enumerate()
        .filter(|(i, _)| usable(*i))
        .map(|p| p.1)
        .collect();
    if training.len() < 2 {
        bail!(
            "{}: only {} photos are left for training; at least 2 are needed",
            config.photos.display(),
            training.len()
        );
    }

    let (mask_count, masks_per_photo) =
        masks::segment(config, segmenter.as_ref(), &training, &folder, &cache, run)?;
    drop(segmenter);
    lap("masks");
    let poses: Vec<Camera> = training.iter().map(|p| p.camera.clone()).collect();
    let (keypoints, colors): (Vec<Keypoints>, Vec<_>) =
        training.into_iter().map(|p| (p.points, p.colors)).unzip();
    let matches = matches::consistent_matches(&kept, &matches, &poses, &keypoints);
    if let Some(warning) = matches::warn_of_gaps(&poses, &matches) {
        run.warn(&warning);
        warnings.push(warning);
        manifest.warnings.clone_from(&warnings);
    }
    let compared = brightness::compare(&colors, &matches);
    let gains = poses
        .iter()
        .map(|c| c.name.clone())
        .zip(compared.gains)
        .collect();
    let light = Brightness {
        spread_stops: compared.spread_stops,
        gains,
    };

    let matches = matches::guided(&matches, &poses, &keypoints);
    let tracks = tracks::tracks(&poses, &keypoints, &matches, tracks::TOLERANCE);
    // Given points are valid only for the given poses.
    let poses_are_given = checked.moved.is_empty() && !adjusted.is_some_and(|a| a.used);
    let mut points = if poses_are_given && dataset.points.len() > tracks.len() {
        dataset.points.clone()
    } else {
        tracks::points(&tracks, &colors)
    };
    lap("tracks");
    let work = run.work("depths", poses.len() as u64);
    points.extend(sweep::points(
        &poses,
        &tracks,
        |camera| Ok(folder.photo(&camera.name)?),
        || work.advance(),
    )?);
    drop(work);
    lap("depths");
    folder.save_points(&points)?;
    evidence::save_pairs(
        &folder,
        &matches::between_masks(&folder, &poses, &keypoints, &matches)?,
    )?;
    lap("points");
    if let Some(encoder) = imported {
        crate::masks::compute_descriptors(&folder, &poses, encoder.as_ref(), None, run)?;
        lap("embeddings");
    }
    manifest.seconds = seconds.clone();
    SceneNotes {
        brightness: Some(light.clone()),
        ..SceneNotes::default()
    }
    .store(&mut manifest)?;
    // Training writes the object maps in place, so the manifest lists them now.
    let maps = poses
        .iter()
        .map(|camera| SceneFolder::objects_name(&camera.name));
    staged.publish(&scene, &REPLACED, maps, &manifest)?;
    // Checkpoints of a training on other photos are invalid.
    checkpoints::forget(&scene);
    cache.tidy();
    Ok(PreprocessReport {
        scene: config.output.clone(),
        photos: cameras.len(),
        training_photos: poses.len(),
        held_out: cameras.len() - poses.len(),
        size: format!("{}x{}", cameras[0].width, cameras[0].height),
        masks: mask_count,
        masks_per_photo,
        key_point_matches: matches.iter().map(|m| m.pairs.len()).sum(),
        points: points.len(),
        sift: keypoints::backend().to_owned(),
        moved_cameras: checked.moved.len(),
        adjusted,
        warnings,
        brightness_spread_stops: light.spread_stops,
        cached: cache
            .counts()
            .into_iter()
            .map(|(stage, counts)| (stage.to_owned(), counts))
            .collect(),
        seconds,
        seconds_total: started.elapsed().as_secs_f64(),
    })
}

/// Returns which views are held out: N for every N-th (0 for none), and names of views. Names come
/// from `holdout_labels`, else from the data set if it marks views for testing.
///
/// # Errors
/// A labelled view is not among the photos.
fn held_out(
    config: &PreprocessConfig,
    dataset: &Dataset,
    cameras: &[Camera],
) -> Result<(usize, Vec<String>)> {
    if config.holdout_labels.is_none() && config.holdout > 0 && !dataset.held_out.is_empty() {
        return Ok((0, dataset.held_out.clone()));
    }
    let Some(folder) = &config.holdout_labels else {
        return Ok((config.holdout, Vec::new()));
    };
    let index = |name: &str| {
        let index = find_view(cameras.iter().map(|c| c.name.as_str()), name);
        index.with_context(|| {
            format!(
                "{}: the labelled view '{name}' matches none of the photos",
                folder.display()
            )
        })
    };
    let names: Result<Vec<String>> = labels::load(folder, None)?
        .iter()
        .map(|view| Ok(cameras[index(&view.name)?].name.clone()))
        .collect();
    Ok((0, names?))
}
