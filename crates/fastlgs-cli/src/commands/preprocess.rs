//! `fastlgs preprocess`: everything that is done once, before training.

use super::objects;
use crate::cache::{self, Cache, Key};
use crate::eyes::Eyes;
use crate::{Outcome, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::dataset::{self, Dataset, PosedPhoto};
use fastlgs_core::scene_folder::{Manifest, view_of};
use fastlgs_core::undistort::{undistort, undistort_gray};
use fastlgs_core::{Camera, LabelMap, SceneFolder, image_io, labels};
use fastlgs_grid::mapping::{Correspondences, Mask, PaperConfig};
use fastlgs_grid::{Grid, evidence};
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::photo_quality::{self, Impression};
use fastlgs_vision::triangulate::{self, PairMatches};
use fastlgs_vision::{Encoder, Level, Segmenter, brightness, import};
use fastlgs_vision::{pose_check, structure};
use glam::Vec2;
use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs preprocess photos/fox -o scenes/fox --max-side 480")]
pub struct Args {
    /// Folder with images/ and poses: sparse/0 (COLMAP), transforms.json or poses_bounds.npy; without poses COLMAP finds them.
    photos: PathBuf,
    /// Scene folder to write.
    #[arg(short, long)]
    output: PathBuf,
    /// Longer side of the working photos in pixels.
    #[arg(long, default_value_t = 960)]
    max_side: u32,
    /// Every N-th photo (by sorted name) is kept out of training and mapping; 0 for none.
    #[arg(long, default_value_t = 8)]
    holdout: usize,
    /// Keep out the photos that these labels name instead (of LERF-OVS, 3D-OVS or SPIn-NeRF).
    #[arg(long, value_name = "DIR", conflicts_with = "holdout")]
    holdout_labels: Option<PathBuf>,
    #[command(flatten)]
    eyes: Eyes,
    /// Photos that each photo's key points are matched with.
    #[arg(long, default_value_t = 10)]
    neighbours: usize,
    /// How much memory photos may take while they are read, such as 500M or 4G.
    #[arg(long, default_value = "4G", value_name = "BYTES", value_parser = parse_bytes)]
    memory: u64,
}

/// The manifest's note of how much the photos' brightness varies, in stops.
pub const BRIGHTNESS_SPREAD: &str = "brightness_spread_stops";

/// Parses `500M`.
fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = text.split_at(text.trim_end_matches(char::is_alphabetic).len());
    let factor = match unit.to_uppercase().as_str() {
        "" => 1.0,
        "K" | "KB" => 1e3,
        "M" | "MB" => 1e6,
        "G" | "GB" => 1e9,
        _ => return Err(format!("'{unit}' is none of K, M and G")),
    };
    let bytes = number.parse::<f64>().ok().filter(|n| *n > 0.0).ok_or_else(|| format!("'{text}' is not a size like 4G"))?;
    Ok((bytes * factor) as u64)
}

/// A working photo: undistorted and scaled.
pub struct Photo {
    pub camera: Camera,
    pub pixels: RgbImage,
    /// Coverage of photos with an alpha channel.
    alpha: Option<GrayImage>,
    /// Black where nothing counts.
    ignore: Option<GrayImage>,
}

/// What is kept in memory of a photo; its pixels lie in the scene folder, so that thousands of photos fit.
struct Known {
    camera: Camera,
    /// Fingerprint of the pixels.
    key: Key,
    impression: Impression,
    points: Keypoints,
    /// Colour at each key point.
    colors: Vec<[u8; 3]>,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let started = Instant::now();
    let mut seconds = BTreeMap::new();
    let mut clock = Instant::now();
    let mut lap = |stage: &str| {
        seconds.insert(format!("preprocess.{stage}"), clock.elapsed().as_secs_f64());
        clock = Instant::now();
    };
    if args.max_side < 64 {
        bail!("--max-side {} is too small: 64 pixels are the least", args.max_side);
    }
    if args.photos.join("images").is_dir() && !dataset::has_poses(&args.photos) {
        find_poses(&args.photos, common)?;
        lap("poses");
    }
    let dataset = dataset::load(&args.photos)?;
    let lenses = import::lenses(&dataset);
    // Opened first: a missing model should not cost the minutes before.
    let segmenter = args.eyes.segmenter(&args.photos, &lenses)?;
    let encoder = args.eyes.encoder(&args.photos, &lenses)?;
    for warning in &dataset.warnings {
        tracing::warn!("{warning}");
    }
    let folder = SceneFolder::new(&args.output);
    let cache = Cache::new(&folder);
    let mut photos = load_photos(&dataset, args, &folder, &cache, common)?;
    lap("photos");
    let mut warnings = dataset.warnings.clone();
    warn_of_bad_photos(&photos, &mut warnings);
    let checked = check_poses(&mut photos, &folder, &cache, common, &mut warnings)?;
    let cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    folder.save_cameras(&cameras)?;
    let excluded: Vec<String> = checked.contradictory.iter().map(|&i| cameras[i].name.clone()).collect();
    let held_out_views = labelled_views(args, &cameras)?;
    let mut manifest = Manifest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        photos: args.photos.clone(),
        holdout: if args.holdout_labels.is_some() { 0 } else { args.holdout },
        held_out_views,
        segmenter: args.eyes.segmenter.clone(),
        encoder: args.eyes.encoder.clone(),
        models: args.eyes.files()?,
        seed: common.seed,
        warnings: warnings.clone(),
        excluded,
        seconds: BTreeMap::new(),
        notes: BTreeMap::new(),
    };
    let usable = |i: usize| !manifest.is_held_out(i, &cameras[i].name) && !checked.contradictory.contains(&i);
    let training: Vec<Known> = photos.into_iter().enumerate().filter(|(i, _)| usable(*i)).map(|p| p.1).collect();
    if training.len() < 2 {
        bail!("{}: only {} photos are left for training; at least 2 are needed", args.photos.display(), training.len());
    }
    lap("pose_check");

    let mask_counts = segment(args, segmenter.as_ref(), &training, &folder, &cache, common)?;
    drop(segmenter);
    lap("masks");
    let masks = describe(args, encoder.as_ref(), &training, &folder, &cache, common)?;
    drop(encoder);
    lap("embeddings");
    let poses: Vec<Camera> = training.iter().map(|p| p.camera.clone()).collect();
    let matches = match_photos(&training, &poses, args.neighbours, &cache, common)?;
    lap("matches");
    let (keypoints, colors): (Vec<Keypoints>, Vec<_>) = training.into_iter().map(|p| (p.points, p.colors)).unzip();
    let spread = brightness::spread(&colors, &matches);

    // Points of moved cameras lie where those cameras were.
    let points = if dataset.points.is_empty() || !checked.moved.is_empty() {
        triangulate::triangulate(&poses, &keypoints, &colors, &matches)
    } else {
        dataset.points.clone()
    };
    folder.save_points(&points)?;
    let pairs = correspondences(&masks, &folder, &poses, &keypoints, &matches)?;
    evidence::save(&folder, &masks, &pairs)?;
    lap("points");
    // Without Gaussians only Algorithm 1 can map the masks; `train` maps again with what it learns, or with its options.
    let mapped = match objects::by_algorithm_1(&folder, &poses, &PaperConfig::default(), common.seed) {
        // The default mapping needs none of this.
        Err(error) if matches!(error.downcast_ref(), Some(fastlgs_grid::Error::TooManyObjects)) => {
            tracing::warn!("Algorithm 1: {error}");
            warnings.push(format!("Algorithm 1: {error}"));
            Grid::default()
        }
        other => other?,
    };
    mapped.save(&folder)?;
    lap("mapping");

    let matched: usize = matches.iter().map(|m| m.pairs.len()).sum();
    manifest.seconds = seconds.clone();
    manifest.notes.insert(BRIGHTNESS_SPREAD.to_owned(), spread.into());
    folder.save_manifest(&manifest)?;
    cache.tidy();
    let value = serde_json::json!({
        "scene": args.output,
        "photos": cameras.len(),
        "training_photos": poses.len(),
        "held_out": cameras.len() - poses.len(),
        "size": format!("{}x{}", cameras[0].width, cameras[0].height),
        "masks": masks.len(),
        "masks_per_photo": mask_counts,
        "objects_by_algorithm_1": mapped.objects.len(),
        "key_point_matches": matched,
        "points": points.len(),
        "sift": keypoints::backend(),
        "moved_cameras": checked.moved.len(),
        "warnings": warnings,
        "brightness_spread_stops": spread,
        "cached": cache.counts(),
        "seconds": seconds,
        "seconds_total": started.elapsed().as_secs_f64(),
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}

/// Names of the views that `--holdout-labels` keeps out.
fn labelled_views(args: &Args, cameras: &[Camera]) -> Result<Vec<String>> {
    let Some(folder) = &args.holdout_labels else { return Ok(Vec::new()) };
    let index = |name: &str| {
        let index = view_of(cameras.iter().map(|c| c.name.as_str()), name);
        index.with_context(|| format!("{}: the labelled view '{name}' is none of the photos", folder.display()))
    };
    labels::load(folder, None)?.iter().map(|view| Ok(cameras[index(&view.name)?].name.clone())).collect()
}

/// Structure from motion for photos without poses.
fn find_poses(photos: &Path, common: &ui::Common) -> Result<()> {
    let tool = structure::Tool::find()?;
    let bar = ui::bar(common, 0, "poses");
    tracing::warn!("{}: no poses; COLMAP looks for them, which takes minutes", photos.display());
    structure::reconstruct(&tool, photos, |stage, line| {
        bar.set_message(format!("{stage}: {line}"));
        bar.tick();
        tracing::debug!(stage, line, "COLMAP");
    })?;
    bar.finish_and_clear();
    Ok(())
}

/// Blurred and repeated photos are used all the same, but the user hears of them.
fn warn_of_bad_photos(photos: &[Known], warnings: &mut Vec<String>) {
    let seen: Vec<Impression> = photos.iter().map(|p| p.impression.clone()).collect();
    for (list, what) in
        [(photo_quality::blurred(&seen), "are blurred"), (photo_quality::repeated(&seen), "show the same as the photo before them")]
    {
        if !list.is_empty() {
            let names: Vec<&str> = list.iter().map(|&i| photos[i].camera.name.as_str()).collect();
            let warning = format!("{} of {} photos {what}: {}", list.len(), photos.len(), names.join(", "));
            tracing::warn!("{warning}");
            warnings.push(warning);
        }
    }
}

/// Bytes that a photo takes while it is read, for each of its file's pixels: decoded, shrunk, undistorted, encoded again.
const BYTES_A_PIXEL: u64 = 12;

/// Reads the photos, writes them into the scene folder, and looks at each once.
fn load_photos(dataset: &Dataset, args: &Args, folder: &SceneFolder, cache: &Cache, common: &ui::Common) -> Result<Vec<Known>> {
    let bar = ui::bar(common, dataset.photos.len() as u64, "photos");
    let largest = dataset.photos.iter().map(|p| u64::from(p.camera.width) * u64::from(p.camera.height)).max().unwrap_or(1);
    let together = (args.memory / (BYTES_A_PIXEL * largest.max(1))).clamp(1, 256) as usize;
    let mut photos = Vec::with_capacity(dataset.photos.len());
    for some in dataset.photos.chunks(together) {
        let loaded: Vec<Result<Known>> = some
            .par_iter()
            .map(|posed| {
                let photo = load_photo(posed, args.max_side)?;
                save_photo(&photo, folder)?;
                bar.inc(1);
                known(photo, cache)
            })
            .collect();
        for photo in loaded {
            photos.push(photo?);
        }
    }
    bar.finish_and_clear();
    Ok(photos)
}

/// What stays in memory of a photo.
fn known(Photo { camera, pixels, .. }: Photo, cache: &Cache) -> Result<Known> {
    let key = cache::key(&[&camera.width.to_le_bytes(), pixels.as_raw()]);
    let inputs = cache::key(&[&key, keypoints::backend().as_bytes()]);
    let points = cache.get("key points", &inputs, || Ok(keypoints::detect(&image::imageops::grayscale(&pixels))?))?;
    let color = |p: &Vec2| pixels.get_pixel((p.x as u32).min(pixels.width() - 1), (p.y as u32).min(pixels.height() - 1)).0;
    let colors = points.positions.iter().map(color).collect();
    Ok(Known { impression: Impression::of(&pixels), camera, key, points, colors })
}

/// Writes a working photo with its masks into the scene folder.
fn save_photo(photo: &Photo, folder: &SceneFolder) -> Result<()> {
    let name = &photo.camera.name;
    image_io::save_png(&folder.photo_path(name), photo.pixels.clone())?;
    for (mask, path) in [(&photo.alpha, folder.alpha_path(name)), (&photo.ignore, folder.ignore_path(name))] {
        match mask {
            Some(mask) => image_io::save_png(&path, mask.clone())?,
            // A mask that an earlier run left would now be wrong.
            None if path.is_file() => std::fs::remove_file(&path).with_context(|| path.display().to_string())?,
            None => {}
        }
    }
    Ok(())
}

/// Reads, shrinks and undistorts; undistorting last keeps the work small, and distortion does not depend on scale.
pub fn load_photo(posed: &PosedPhoto, max_side: u32) -> Result<Photo> {
    let image_io::Photo { pixels: raw, alpha } = image_io::load_photo(&posed.path)?;
    // The file decides the true size; some tools scale photos and leave the poses' file as it was.
    let camera = posed.camera.resized(raw.width(), raw.height()).shrunk_to(max_side);
    let aspect = f64::from(posed.camera.width) / f64::from(posed.camera.height) * f64::from(raw.height()) / f64::from(raw.width());
    if (aspect - 1.0).abs() > 0.02 {
        bail!(
            "{}: the photo is {}x{}, but its camera is {}x{}; was it rotated or cropped after the poses were made?",
            posed.path.display(),
            raw.width(),
            raw.height(),
            posed.camera.width,
            posed.camera.height
        );
    }
    let small = image_io::resize(&raw, camera.width, camera.height);
    let pixels = if posed.distortion.is_none() { small } else { undistort(&small, &camera, &posed.distortion) };
    let mask = |mask: GrayImage| undistort_gray(&image_io::resize_gray(&mask, camera.width, camera.height), &camera, &posed.distortion);
    let ignore = posed.ignore.as_ref().map(|path| image_io::load_gray(path).map(mask)).transpose()?;
    Ok(Photo { pixels, alpha: alpha.map(mask), ignore, camera })
}

/// Writes the masks of every training photo; returns the mean number of masks a photo by level.
fn segment(
    args: &Args,
    segmenter: &dyn Segmenter,
    training: &[Known],
    folder: &SceneFolder,
    cache: &Cache,
    common: &ui::Common,
) -> Result<BTreeMap<&'static str, f64>> {
    let bar = ui::bar(common, training.len() as u64, "masks");
    let mut counts = BTreeMap::new();
    let identity = args.eyes.segmenter_identity()?;
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
            if args.eyes.keeps(level) {
                let masks = map.areas().iter().skip(1).filter(|a| **a > 0).count();
                *counts.entry(level.name()).or_default() += masks as f64 / training.len() as f64;
                map.save(&path)?;
            } else if path.is_file() {
                std::fs::remove_file(&path).with_context(|| path.display().to_string())?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(counts)
}

/// Embedding and colour distribution of every mask, sorted by view and label.
fn describe(
    args: &Args,
    encoder: &dyn Encoder,
    training: &[Known],
    folder: &SceneFolder,
    cache: &Cache,
    common: &ui::Common,
) -> Result<Vec<Mask>> {
    let bar = ui::bar(common, training.len() as u64, "embeddings");
    let mut masks = Vec::new();
    let identity = args.eyes.encoder_identity()?;
    for (view, photo) in training.iter().enumerate() {
        let name = &photo.camera.name;
        let labels = objects::whole_masks(folder, &photo.camera)?;
        let make = || objects::masks_of(name, &folder.photo(name)?, 0, &labels, encoder);
        let of_view: Vec<Mask> = match &identity {
            Some(identity) => {
                let inputs = [&photo.key, bytemuck::cast_slice(&labels.labels), identity.as_bytes()];
                cache.get("embeddings", &cache::key(&inputs), make)?
            }
            None => make()?,
        };
        // A photo keeps what is known of it when others come or go before it.
        masks.extend(of_view.into_iter().map(|mask| Mask { view, ..mask }));
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(masks)
}

/// Longer side of the pictures on which poses are checked. Its tolerances are pixels, and the coarser key points of small
/// pictures are those that wide baselines share.
const CHECK_SIDE: u32 = 480;

/// Moves misplaced cameras and warns about them. Poses come from all photos, held out or not, as in structure from motion.
fn check_poses(
    photos: &mut [Known],
    folder: &SceneFolder,
    cache: &Cache,
    common: &ui::Common,
    warnings: &mut Vec<String>,
) -> Result<pose_check::Report> {
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.shrunk_to(CHECK_SIDE)).collect();
    let given = serde_json::to_vec(&cameras)?;
    let mut inputs: Vec<&[u8]> = photos.iter().map(|p| p.key.as_slice()).collect();
    let seed = common.seed.to_le_bytes();
    inputs.extend([given.as_slice(), &seed, keypoints::backend().as_bytes()]);
    let (report, poses) = cache.get("poses", &cache::key(&inputs), || {
        let small = photos.iter().zip(&cameras).any(|(p, c)| p.camera.width != c.width);
        let points = if small { detect_small(folder, &cameras, common)? } else { photos.iter().map(|p| p.points.clone()).collect() };
        let report = pose_check::repair(&mut cameras, &points, common.seed);
        Ok((report, cameras.iter().map(|c| c.world_to_camera).collect::<Vec<_>>()))
    })?;
    let names = |list: &[usize]| list.iter().map(|&i| photos[i].camera.name.as_str()).collect::<Vec<_>>().join(", ");
    for (list, what) in [
        (&report.moved, "contradicted the photos and were moved to where the key points match"),
        (&report.contradictory, "contradict the photos and could not be mended; these views are not trained on"),
    ] {
        if !list.is_empty() {
            let warning = format!("the poses of {} of {} photos {what}: {}", list.len(), photos.len(), names(list));
            tracing::warn!("{warning}");
            warnings.push(warning);
        }
    }
    photos.iter_mut().zip(poses).for_each(|(photo, pose)| photo.camera.world_to_camera = pose);
    Ok(report)
}

/// Key points of the photos at the sizes of `cameras`.
fn detect_small(folder: &SceneFolder, cameras: &[Camera], common: &ui::Common) -> Result<Vec<Keypoints>> {
    let bar = ui::bar(common, cameras.len() as u64, "key points for the pose check");
    let mut points = Vec::new();
    for camera in cameras {
        let small = image_io::resize(&folder.photo(&camera.name)?, camera.width, camera.height);
        points.push(keypoints::detect(&image::imageops::grayscale(&small))?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(points)
}

fn match_photos(training: &[Known], cameras: &[Camera], neighbours: usize, cache: &Cache, common: &ui::Common) -> Result<Vec<PairMatches>> {
    let described = cameras.iter().map(serde_json::to_vec).collect::<Result<Vec<_>, _>>()?;
    let chosen = triangulate::overlapping_pairs(cameras, neighbours);
    let bar = ui::bar(common, chosen.len() as u64, "matches");
    let match_pair = |(a, b): (usize, usize)| {
        let inputs = [&training[a].key, &training[b].key, described[a].as_slice(), &described[b], keypoints::backend().as_bytes()];
        let pairs = cache.get("matches", &cache::key(&inputs), || {
            let [pa, pb] = [a, b].map(|k| &training[k].points);
            let pairs = keypoints::matches(pa, pb);
            Ok(triangulate::epipolar_filter((&cameras[a], pa), (&cameras[b], pb), &pairs))
        })?;
        bar.inc(1);
        Ok(PairMatches { a, b, pairs })
    };
    let matches = chosen.into_par_iter().map(match_pair).collect();
    bar.finish_and_clear();
    matches
}

/// Counts the key-point pairs between the masks of matched photos.
fn correspondences(
    masks: &[Mask],
    folder: &SceneFolder,
    cameras: &[Camera],
    points: &[Keypoints],
    matches: &[PairMatches],
) -> Result<Correspondences> {
    let index: BTreeMap<(usize, u16), usize> = masks.iter().enumerate().map(|(i, m)| ((m.view, m.label), i)).collect();
    let of_view = |(view, camera): (usize, &Camera)| -> Result<Vec<Option<usize>>> {
        let map = objects::whole_masks(folder, camera)?;
        let label = |p: &Vec2| map.at((p.x as u32).min(map.width - 1), (p.y as u32).min(map.height - 1));
        Ok(points[view].positions.iter().map(|p| index.get(&(view, label(p))).copied()).collect())
    };
    let mask_at: Vec<Vec<Option<usize>>> = cameras.iter().enumerate().map(of_view).collect::<Result<_>>()?;
    let mut out = Correspondences::new();
    for m in matches {
        for &(i, j) in &m.pairs {
            if let (Some(a), Some(b)) = (mask_at[m.a][i], mask_at[m.b][j]) {
                *out.entry((b, a)).or_default() += 1;
            }
        }
    }
    Ok(out)
}
