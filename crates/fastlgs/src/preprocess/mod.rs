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
use fastlgs_core::scene_folder::{Manifest, ModelFile, find_view};
use fastlgs_core::{Camera, SceneFolder, dataset, labels};
use fastlgs_grid::mask_pairs;
use fastlgs_sfm::keypoints::{self, Keypoints};
use fastlgs_sfm::pose_check::PoseCheckReport;
use fastlgs_sfm::tracks::PairMatches;
use fastlgs_sfm::video::is_video;
use fastlgs_sfm::{brightness, sweep, tracks};
use fastlgs_vision::{Encoder, Provider, Segmenter, import};
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
    check(config)?;
    let mut laps = Laps::default();
    let config = &extract_frames(config, &mut laps, run)?;
    let scene = SceneFolder::new(&config.output);
    let staged = StagedOutput::new(&scene, "preprocess")?;
    let (folder, cache) = (staged.folder.clone(), Cache::new(&scene));
    let mut stage = Stage {
        config,
        run,
        folder,
        cache,
        laps,
        warnings: Vec::new(),
    };
    let mut dataset = stage.read_dataset(&scene)?;
    // Load the models first, so that a missing one is reported before minutes of work.
    let models = Models::load(config, &dataset)?;
    let given: Vec<Camera> = dataset.photos.iter().map(|p| p.camera.clone()).collect();
    let holdout = held_out(config, &dataset, &given)?;
    let mut photos = stage.prepare_photos(&mut dataset)?;
    let placed = stage.place_photos(&mut photos)?;
    let manifest = stage.manifest(&models, holdout, &dataset, &placed);
    photos::color_points(&mut dataset, &photos, &stage.folder)?;
    let (kept, training) = training_photos(config, photos, &placed, &manifest)?;
    let (masks, masks_per_photo) = masks::segment(
        config,
        models.segmenter.as_ref(),
        &training,
        &stage.folder,
        &stage.cache,
        run,
    )?;
    drop(models.segmenter);
    stage.laps.end("masks");
    let found = stage.find_points(&kept, training, &placed, &dataset)?;
    if let Some(encoder) = models.import {
        let (folder, cameras) = (&stage.folder, &found.cameras);
        crate::masks::compute_descriptors(folder, cameras, encoder.as_ref(), None, run)?;
        stage.laps.end("embeddings");
    }
    stage.publish(staged, &scene, manifest, &found)?;
    Ok(PreprocessReport {
        masks,
        masks_per_photo,
        ..stage.report(placed, found)
    })
}

/// Refuses options that cannot work.
fn check(config: &PreprocessConfig) -> Result<()> {
    config.eyes.check()?;
    if config.max_side < 64 {
        bail!(
            "max_side {} is too small; it must be at least 64 pixels",
            config.max_side
        );
    }
    Ok(())
}

/// Returns the configuration with the frames of a video as photos, if the photos are a video.
fn extract_frames(
    config: &PreprocessConfig,
    laps: &mut Laps,
    run: &Run,
) -> Result<PreprocessConfig> {
    if !is_video(&config.photos) {
        return Ok(config.clone());
    }
    let photos = video::photos(&config.photos, &SceneFolder::new(&config.output), run)?;
    laps.end("frames");
    Ok(PreprocessConfig {
        photos,
        ..config.clone()
    })
}

/// Reports a warning, and keeps it for the report and the manifest.
fn warn(run: &Run, warnings: &mut Vec<String>, text: String) {
    run.warn(&text);
    warnings.push(text);
}

/// Seconds of each step.
struct Laps {
    started: Instant,
    step_started: Instant,
    seconds: BTreeMap<String, f64>,
}

impl Default for Laps {
    fn default() -> Self {
        let now = Instant::now();
        Self {
            started: now,
            step_started: now,
            seconds: BTreeMap::new(),
        }
    }
}

impl Laps {
    fn end(&mut self, step: &str) {
        let seconds = self.step_started.elapsed().as_secs_f64();
        self.seconds.insert(format!("preprocess.{step}"), seconds);
        self.step_started = Instant::now();
    }
}

/// Segmenter and encoder, and their files.
struct Models {
    segmenter: Box<dyn Segmenter>,
    /// Encoder of imported embeddings. Only these are stored by preprocessing, because their files
    /// may disappear later.
    import: Option<Box<dyn Encoder>>,
    files: BTreeMap<String, ModelFile>,
}

impl Models {
    fn load(config: &PreprocessConfig, dataset: &Dataset) -> Result<Self> {
        let lenses = import::lenses(dataset);
        let segmenter = config.eyes.segmenter(&config.photos, &lenses)?;
        let encoder = config.eyes.encoder(&config.photos, &lenses)?;
        Ok(Self {
            segmenter,
            import: Some(encoder).filter(|_| config.eyes.encoder == EncoderKind::Import),
            files: config.eyes.files()?,
        })
    }
}

/// All photos with their final cameras.
struct Placed {
    cameras: Vec<Camera>,
    checked: PoseCheckReport,
    adjusted: Option<Adjusted>,
    matches: Vec<PairMatches>,
}

/// Results that are computed from all training photos together.
struct TrainingData {
    /// Cameras of the training photos.
    cameras: Vec<Camera>,
    brightness: Brightness,
    points: usize,
    key_point_matches: usize,
}

/// Options and state that all steps share.
struct Stage<'a> {
    config: &'a PreprocessConfig,
    run: &'a Run<'a>,
    /// The staged output.
    folder: SceneFolder,
    cache: Cache,
    laps: Laps,
    warnings: Vec<String>,
}

impl Stage<'_> {
    /// Moves the staged output to the scene folder.
    fn publish(
        &self,
        staged: StagedOutput,
        scene: &SceneFolder,
        mut manifest: Manifest,
        found: &TrainingData,
    ) -> Result<()> {
        manifest.warnings.clone_from(&self.warnings);
        manifest.seconds = self.laps.seconds.clone();
        let notes = SceneNotes {
            brightness: Some(found.brightness.clone()),
            ..SceneNotes::default()
        };
        notes.store(&mut manifest)?;
        // Training writes the object maps in place, so the manifest lists them now.
        let cameras = found.cameras.iter();
        let maps = cameras.map(|camera| SceneFolder::objects_name(&camera.name));
        staged.publish(scene, &REPLACED, maps, &manifest)?;
        // Checkpoints of a training on other photos are invalid.
        checkpoints::remove_all(scene);
        self.cache.tidy();
        Ok(())
    }

    /// Returns the report, without the numbers of masks.
    fn report(self, placed: Placed, found: TrainingData) -> PreprocessReport {
        let cameras = &placed.cameras;
        let cached = self.cache.counts().into_iter();
        PreprocessReport {
            scene: self.config.output.clone(),
            photos: cameras.len(),
            training_photos: found.cameras.len(),
            held_out: cameras.len() - found.cameras.len(),
            size: format!("{}x{}", cameras[0].width, cameras[0].height),
            key_point_matches: found.key_point_matches,
            points: found.points,
            sift: keypoints::backend().to_owned(),
            onnx: Provider::used().map(|provider| provider.name().to_owned()),
            moved_cameras: placed.checked.moved.len(),
            adjusted: placed.adjusted,
            warnings: self.warnings,
            brightness_spread_stops: found.brightness.spread_stops,
            cached: cached
                .map(|(name, counts)| (name.to_owned(), counts))
                .collect(),
            seconds_total: self.laps.started.elapsed().as_secs_f64(),
            seconds: self.laps.seconds,
            ..PreprocessReport::default()
        }
    }

    /// Reads photos and poses. Missing poses are computed.
    fn read_dataset(&mut self, scene: &SceneFolder) -> Result<Dataset> {
        let photos = &self.config.photos;
        let lacks_poses = dataset::images_folder(photos).is_some() && !dataset::has_poses(photos);
        let mut dataset = if lacks_poses {
            let found =
                poses::compute_poses(photos, &self.folder, &self.cache, self.config.sfm, self.run)?;
            self.laps.end("poses");
            found
        } else {
            dataset::load(photos)?
        };
        dataset.earlier_frame = scene.manifest().ok().map(|earlier| earlier.frame);
        for warning in &dataset.warnings {
            self.run.warn(warning);
        }
        self.warnings.clone_from(&dataset.warnings);
        Ok(dataset)
    }

    /// Writes the prepared photos, and determines the convention of the poses.
    fn prepare_photos(&mut self, dataset: &mut Dataset) -> Result<Vec<PreparedPhoto>> {
        let (config, run) = (self.config, self.run);
        let mut photos = photos::load(dataset, config, &self.folder, &self.cache, run)?;
        self.laps.end("photos");
        photos::check_masks(&photos, run, &mut self.warnings)?;
        photos::warn_of_bad_photos(&photos, run, &mut self.warnings);
        let convention = config.pose_convention;
        poses::settle_convention(dataset, &mut photos, convention, run, &mut self.warnings)?;
        Ok(photos)
    }

    /// Checks the poses, matches key points, and refines the cameras.
    fn place_photos(&mut self, photos: &mut [PreparedPhoto]) -> Result<Placed> {
        let (config, run, warnings) = (self.config, self.run, &mut self.warnings);
        let mut checked = PoseCheckReport::default();
        if config.poses != Poses::Keep {
            checked = poses::check(photos, &self.folder, &self.cache, run, warnings)?;
            poses::mark_unsupported_outliers(photos, &self.cache, &mut checked)?;
        }
        self.laps.end("pose_check");
        let lost = &checked.contradictory;
        let matches = matches::match_photos(photos, lost, config.neighbours, &self.cache, run)?;
        self.laps.end("matches");
        poses::resect_contradictory(photos, &mut checked, &matches);
        poses::warn(photos, &checked, run, warnings);
        let adjusted = match config.poses {
            Poses::Keep => None,
            asked => poses::adjust(photos, &matches, asked, &self.folder, run, warnings)?,
        };
        self.laps.end("adjusting");
        let cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
        self.folder.save_cameras(&cameras)?;
        Ok(Placed {
            cameras,
            checked,
            adjusted,
            matches,
        })
    }

    fn manifest(
        &self,
        models: &Models,
        (holdout, held_out_views): (usize, Vec<String>),
        dataset: &Dataset,
        placed: &Placed,
    ) -> Manifest {
        let excluded = placed.checked.contradictory.iter();
        Manifest {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            photos: self.config.photos.clone(),
            holdout,
            held_out_views,
            segmenter: self.config.eyes.segmenter.name().to_owned(),
            encoder: self.config.eyes.encoder.name().to_owned(),
            crops: calibrations::background_name(self.config.eyes.background(&models.files)),
            models: models.files.clone(),
            seed: self.run.seed,
            warnings: Vec::new(),
            excluded: excluded.map(|&i| placed.cameras[i].name.clone()).collect(),
            frame: dataset.frame,
            files: BTreeSet::new(),
            seconds: BTreeMap::new(),
            notes: BTreeMap::new(),
        }
    }

    /// Writes the initial points and the key point matches between masks, and compares the
    /// brightness of the photos. `kept` has the index of each training photo among all photos.
    fn find_points(
        &mut self,
        kept: &[usize],
        training: Vec<PreparedPhoto>,
        placed: &Placed,
        dataset: &Dataset,
    ) -> Result<TrainingData> {
        let cameras: Vec<Camera> = training.iter().map(|p| p.camera.clone()).collect();
        let (keypoints, colors): (Vec<Keypoints>, Vec<_>) =
            training.into_iter().map(|p| (p.points, p.colors)).unzip();
        let matches = matches::consistent_matches(kept, &placed.matches, &cameras, &keypoints);
        if let Some(warning) = matches::gap_warning(&cameras, &matches) {
            self.run.warn(&warning);
            self.warnings.push(warning);
        }
        let compared = brightness::compare(&colors, &matches);
        let names = cameras.iter().map(|c| c.name.clone());
        let brightness = Brightness {
            spread_stops: compared.spread_stops,
            gains: names.zip(compared.gains).collect(),
        };
        let matches = matches::match_along_epipolar_lines(&matches, &cameras, &keypoints);
        let tracks = tracks::tracks(&cameras, &keypoints, &matches, tracks::TOLERANCE);
        // Given points are valid only for the given poses.
        let poses_are_given =
            placed.checked.moved.is_empty() && !placed.adjusted.is_some_and(|a| a.used);
        let mut points = if poses_are_given && dataset.points.len() > tracks.len() {
            dataset.points.clone()
        } else {
            tracks::points(&tracks, &colors)
        };
        self.laps.end("tracks");
        let folder = &self.folder;
        let work = self.run.work("depths", cameras.len() as u64);
        let photo = |camera: &Camera| Ok(folder.photo(&camera.name)?);
        points.extend(sweep::points(&cameras, &tracks, photo, || work.advance())?);
        drop(work);
        self.laps.end("depths");
        folder.save_points(&points)?;
        let pairs = matches::count_mask_pairs(folder, &cameras, &keypoints, &matches)?;
        mask_pairs::save_pairs(folder, &pairs)?;
        self.laps.end("points");
        Ok(TrainingData {
            cameras,
            brightness,
            points: points.len(),
            key_point_matches: matches.iter().map(|m| m.pairs.len()).sum(),
        })
    }
}

/// Returns the training photos, and their indices among all photos.
fn training_photos(
    config: &PreprocessConfig,
    photos: Vec<PreparedPhoto>,
    placed: &Placed,
    manifest: &Manifest,
) -> Result<(Vec<usize>, Vec<PreparedPhoto>)> {
    let is_usable = |i: usize| {
        !manifest.is_held_out(i, &placed.cameras[i].name)
            && !placed.checked.contradictory.contains(&i)
    };
    let (kept, training): (Vec<usize>, Vec<PreparedPhoto>) = photos
        .into_iter()
        .enumerate()
        .filter(|(i, _)| is_usable(*i))
        .unzip();
    if training.len() < 2 {
        bail!(
            "{}: only {} photos are left for training; at least 2 are needed",
            config.photos.display(),
            training.len()
        );
    }
    Ok((kept, training))
}

/// Returns which views are held out: N if every N-th view is (0 for none), and the names of further
/// views. The names come from `holdout_labels`, else from the data set if it marks views for
/// testing.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(name: &str) -> Camera {
        let (eye, target) = (glam::Vec3::NEG_Z, glam::Vec3::ZERO);
        Camera::look_at(name, eye, target, glam::Vec3::Y, 8, 8, 0.8)
    }

    #[test]
    fn the_data_sets_test_photos_are_held_out_unless_none_shall_be() {
        let cameras = ["a.png", "b.png"].map(camera);
        let mut dataset = Dataset::default();
        dataset.held_out.push("b.png".to_owned());
        let config = PreprocessConfig::default();
        let of = |config: &PreprocessConfig, dataset: &Dataset| {
            held_out(config, dataset, &cameras).unwrap()
        };
        assert_eq!(of(&config, &dataset), (0, vec!["b.png".to_owned()]));
        assert_eq!(of(&config, &Dataset::default()), (config.holdout, vec![]));
        let none = PreprocessConfig {
            holdout: 0,
            ..config
        };
        assert_eq!(of(&none, &dataset), (0, vec![]));
    }

    #[test]
    fn a_tiny_size_is_refused() {
        let config = PreprocessConfig {
            max_side: 63,
            ..PreprocessConfig::default()
        };
        assert!(check(&config).unwrap_err().to_string().contains("63"));
    }
}
