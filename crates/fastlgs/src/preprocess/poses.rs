//! Poses: computes missing ones, and verifies and corrects given ones.

use super::config::{Adjusted, Poses, Sfm};
use super::photos::PreparedPhoto;
use crate::cache::{self, Cache};
use crate::error::bail;
use crate::progress::Work;
use crate::{Error, Result, Run};
use fastlgs_core::dataset::{Dataset, PoseConvention, PosedPhoto};
use fastlgs_core::{Camera, SceneFolder, camera, dataset, fs, image_io};
use fastlgs_sfm::keypoints::{self, Keypoints};
use fastlgs_sfm::pose_convention::{self, Verdict};
use fastlgs_sfm::structure::Tool;
use fastlgs_sfm::tracks::PairMatches;
use fastlgs_sfm::{bundle, frame, pose_check, resection, structure, tracks};
use fastlgs_vision::model_paths;
use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Returns the installed program that computes poses.
fn pose_tool(sfm: Sfm) -> Result<Tool> {
    Ok(match sfm {
        Sfm::Auto => Tool::find(model_paths::poses_python())?,
        Sfm::Colmap => Tool::find_colmap()?,
    })
}

/// Computes poses by structure from motion, and writes the COLMAP model to `sparse/0` of the scene
/// folder. The result is cached by the names and contents of the photos.
///
/// # Errors
/// No tool is installed, it fails or places no photo, or the run is cancelled.
pub(super) fn compute_poses(
    photos: &Path,
    folder: &SceneFolder,
    cache: &Cache,
    sfm: Sfm,
    run: &Run,
) -> Result<Dataset> {
    let images = structure::photos_in(
        &dataset::images_folder(photos).unwrap_or_else(|| photos.join("images")),
    )?;
    let mut inputs = vec![format!("{sfm:?} {} {}", run.seed, keypoints::version()).into_bytes()];
    for image in &images {
        inputs.extend([
            image
                .file_name()
                .unwrap_or_default()
                .as_encoded_bytes()
                .to_vec(),
            cache::key(&[&fs::read(image)?]).to_vec(),
        ]);
    }
    let key = cache::key(&inputs.iter().map(Vec::as_slice).collect::<Vec<_>>());
    let model = folder.root.join("sparse/0");
    let (upright, files) = cache.get("structure", &key, || {
        let tool = pose_tool(sfm)?;
        // `colmap` counts pixels as stored in the file; our key points are in the upright photo
        // (EXIF).
        Ok((
            matches!(tool, Tool::Pycolmap(_)),
            reconstruct(&tool, photos, &images, folder, run)?,
        ))
    })?;
    for (name, bytes) in files {
        fs::write_atomic(&model.join(name), |file| {
            std::io::Write::write_all(file, &bytes)
        })?;
    }
    let mut dataset = dataset::load_model(photos, &model)?;
    dataset
        .photos
        .iter_mut()
        .for_each(|photo| photo.upright = upright);
    // The convention of a computed model is known.
    dataset.conventions.truncate(1);
    Ok(dataset)
}

/// Reads the poses in the convention `asked`. Without it, the usual convention applies, unless the
/// key points clearly fit another one.
///
/// # Errors
/// The file cannot have the convention `asked`; or the key points fit several other conventions
/// equally well, but not the usual one.
pub(super) fn settle_convention(
    dataset: &mut Dataset,
    photos: &mut [PreparedPhoto],
    asked: Option<PoseConvention>,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let standard = dataset.conventions[0];
    let names =
        |list: &[PoseConvention]| list.iter().map(|c| c.name()).collect::<Vec<_>>().join(", ");
    let chosen = match asked {
        Some(asked) if !dataset.conventions.contains(&asked) => {
            let all = names(&dataset.conventions);
            bail!(
                "pose_convention {}: the file of the poses cannot have this convention; choose one of {all}",
                asked.name()
            );
        }
        Some(asked) => asked,
        None if dataset.conventions.len() < 2 => standard,
        None => match judged_convention(dataset, photos) {
            Verdict::Standard => standard,
            Verdict::Other(found, [share, usual]) => {
                let warning = format!(
                    "the poses are read as {} ({:.0} % of the key point matches agree), not as {} ({:.0} %); \
                     set pose_convention to choose another one",
                    found.name(),
                    100.0 * share,
                    standard.name(),
                    100.0 * usual
                );
                super::warn(run, warnings, warning);
                found
            }
            Verdict::Unclear(among) => bail!(
                "the poses do not fit the photos as {}, but fit equally well as {}; set pose_convention to the one in which they are written",
                standard.name(),
                names(&among)
            ),
        },
    };
    dataset.apply_convention(chosen);
    for (known, posed) in photos.iter_mut().zip(&dataset.photos) {
        posed.camera.check().map_err(crate::Error::Invalid)?;
        known.camera.world_to_camera = posed.camera.world_to_camera;
    }
    Ok(())
}

/// Determines which convention of the poses fits the key point matches.
fn judged_convention(dataset: &mut Dataset, photos: &[PreparedPhoto]) -> Verdict {
    let keypoints: Vec<Keypoints> = photos.iter().map(|photo| photo.points.clone()).collect();
    let matches = pose_convention::sample(&keypoints);
    let mut candidates = Vec::new();
    for convention in dataset.conventions.clone() {
        dataset.apply_convention(convention);
        let pose = |(known, posed): (&PreparedPhoto, &PosedPhoto)| Camera {
            world_to_camera: posed.camera.world_to_camera,
            ..known.camera.clone()
        };
        let cameras = photos.iter().zip(&dataset.photos).map(pose);
        candidates.push((convention, cameras.collect::<Vec<_>>()));
    }
    pose_convention::judge(&candidates, &keypoints, &matches)
}

/// Runs structure from motion. Returns names and contents of the files of the model that places
/// most photos.
fn reconstruct(
    tool: &Tool,
    photos: &Path,
    images: &[PathBuf],
    folder: &SceneFolder,
    run: &Run,
) -> Result<Vec<(String, Vec<u8>)>> {
    let work = run.work("poses", 0);
    run.warn(&format!(
        "{}: no poses were found; structure from motion computes them, which takes minutes",
        photos.display()
    ));
    let folders = images
        .first()
        .and_then(|image| image.parent())
        .map(dataset::folders_within)
        .unwrap_or_default();
    if !folders.is_empty() {
        run.warn(&format!(
            "photos in subfolders of images/ are not read ({}): move them to images/",
            folders.join(", ")
        ));
    }
    let partial = folder.root.join(PARTIAL);
    let found = structure::reconstruct(tool, images, &partial, run.seed, |stage, line| {
        report_line(&work, stage, line)
    });
    work.check()?;
    let model = found?;
    let mut files = Vec::new();
    for entry in model
        .read_dir()
        .map_err(fastlgs_core::Error::io(&model))?
        .flatten()
    {
        files.push((
            entry.file_name().to_string_lossy().into_owned(),
            fs::read(&entry.path())?,
        ));
    }
    files.sort();
    let _ = std::fs::remove_dir_all(&partial);
    Ok(files)
}

/// Reports a line that a tool printed. Returns whether to continue.
fn report_line(work: &Work, stage: &str, line: &str) -> bool {
    work.set_activity(&format!("{stage}: {line}"));
    work.check().is_ok()
}

/// Longer side of the photos for the pose check, in pixels. The tolerances of the check are in
/// these pixels. Coarse key points of small photos match across wide baselines.
const CHECK_SIDE: u32 = 480;

/// Returns the key points of the photos in the sizes of `cameras`; detects them if the photos are
/// larger.
fn points_for_check(
    photos: &[PreparedPhoto],
    cameras: &[Camera],
    folder: &SceneFolder,
    run: &Run,
) -> Result<Vec<Keypoints>> {
    let mut pairs = photos.iter().zip(cameras);
    if pairs.any(|(photo, camera)| photo.camera.width != camera.width) {
        detect_small(folder, cameras, run)
    } else {
        Ok(photos.iter().map(|p| p.points.clone()).collect())
    }
}

/// Verifies the poses by key points, and moves groups of cameras that contradict the others. If
/// many poses are wrong, all poses are computed again. Held-out photos take part, as in structure
/// from motion.
pub(super) fn check(
    photos: &mut [PreparedPhoto],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<pose_check::PoseCheckReport> {
    let given: Vec<Camera> = photos
        .iter()
        .map(|p| p.camera.shrunk_to(CHECK_SIDE))
        .collect();
    let given_json = serde_json::to_vec(&given)?;
    let mut inputs: Vec<&[u8]> = photos.iter().map(|p| p.key.as_slice()).collect();
    let seed = run.seed.to_le_bytes();
    inputs.extend([
        given_json.as_slice(),
        &seed,
        keypoints::version().as_bytes(),
    ]);
    let key = cache::key(&inputs);
    let detected = OnceCell::new();
    let points = || -> Result<&Vec<Keypoints>> {
        if detected.get().is_none() {
            let _ = detected.set(points_for_check(photos, &given, folder, run)?);
        }
        Ok(detected.get().expect("set above"))
    };
    let poses = |cameras: &[Camera]| -> Vec<glam::Mat4> {
        cameras.iter().map(|c| c.world_to_camera).collect()
    };
    let (mut report, mut corrected_poses) = cache.get("poses", &key, || {
        let mut cameras = given.clone();
        let report = pose_check::repair(&mut cameras, points()?, run.seed);
        Ok((report, poses(&cameras)))
    })?;
    let wrong = wrong_pose_count(&report);
    if wrong > 0 && wrong * WRONG_POSES_RATIO >= given.len() {
        let anew = cache.get("poses anew", &key, || {
            let found = recompute_poses(&given, points()?, &report, folder, run)?;
            Ok(found.map(|(cameras, report)| (report, poses(&cameras))))
        });
        match anew {
            Ok(anew) => (report, corrected_poses) = anew.unwrap_or((report, corrected_poses)),
            // Errors are not cached: the next run tries again, also after pycolmap is installed.
            Err(Error::Sfm(error)) => {
                let warning = format!(
                    "many poses contradict the photos, but computing all poses again failed: {error}; only single groups of cameras are corrected"
                );
                super::warn(run, warnings, warning);
            }
            Err(error) => return Err(error),
        }
    }
    photos
        .iter_mut()
        .zip(corrected_poses)
        .for_each(|(photo, pose)| photo.camera.world_to_camera = pose);
    Ok(report)
}

/// Folder in the scene for the temporary files of structure from motion.
const PARTIAL: &str = "sfm.partial";
/// All poses are computed again if at least one of this many photos has a wrong pose.
const WRONG_POSES_RATIO: usize = 10;

/// Returns the number of wrong poses: moved ones, and those that could not be corrected.
fn wrong_pose_count(report: &pose_check::PoseCheckReport) -> usize {
    report.moved.len() + report.contradictory.len()
}

/// Computes all poses again with the given intrinsics, because correcting many wrong poses one by
/// one seldom works. The result is in the coordinate system of the given poses that were correct.
///
/// Returns `None` if the new poses are not better: not fewer of them contradict the photos, or more
/// photos have no pose.
fn recompute_poses(
    given: &[Camera],
    points: &[Keypoints],
    checked: &pose_check::PoseCheckReport,
    folder: &SceneFolder,
    run: &Run,
) -> Result<Option<(Vec<Camera>, pose_check::PoseCheckReport)>> {
    let Tool::Pycolmap(python) = pose_tool(Sfm::Auto)? else {
        return Err(Error::Sfm(fastlgs_sfm::Error::NoPycolmap));
    };
    let work = run.work("poses anew", 0);
    let files: Vec<PathBuf> = given.iter().map(|c| folder.photo_path(&c.name)).collect();
    let on_line = |stage: &str, line: &str| report_line(&work, stage, line);
    let partial = folder.root.join(PARTIAL);
    let found = structure::reconstruct_with_lenses(
        &python, &files, given, points, &partial, run.seed, on_line,
    );
    let _ = std::fs::remove_dir_all(&partial);
    work.check()?;
    let found = found?;
    let Some((mut cameras, mut moved)) = frame::align(given, &found, run.seed) else {
        return Ok(None);
    };
    let again = pose_check::repair(&mut cameras, points, run.seed);
    let unplaced = (0..given.len()).filter(|&photo| found[photo].is_none());
    let lost: BTreeSet<usize> = unplaced
        .chain(again.contradictory.iter().copied())
        .collect();
    let wrong_now = lost
        .iter()
        .chain(&again.moved)
        .collect::<BTreeSet<_>>()
        .len();
    tracing::info!(
        doubted = wrong_pose_count(checked),
        wrong_now,
        lost = lost.len(),
        "all poses were computed again"
    );
    // Training uses photos with corrected poses, but not photos without a pose.
    if wrong_now >= wrong_pose_count(checked) || lost.len() > checked.contradictory.len() {
        return Ok(None);
    }
    moved.extend(again.moved);
    let moved = moved.difference(&lost).copied().collect();
    Ok(Some((
        cameras,
        pose_check::PoseCheckReport {
            moved,
            contradictory: lost.into_iter().collect(),
        },
    )))
}

/// Conditions under which a photo supports the pose of another one: least number of matches, and
/// the share of them that must agree with the pose.
const SUPPORT: (usize, f32) = (15, 0.5);

/// Marks photos as contradictory whose cameras lie far outside of all others, and whose poses no
/// other photo supports.
pub(super) fn mark_unsupported_outliers(
    photos: &[PreparedPhoto],
    cache: &Cache,
    checked: &mut pose_check::PoseCheckReport,
) -> Result<()> {
    let cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let points: Vec<Keypoints> = photos.iter().map(|p| p.points.clone()).collect();
    let outside = camera::outlier_cameras(&cameras);
    let doubtful: Vec<usize> = (0..photos.len())
        .filter(|photo| outside[*photo] && !checked.contradictory.contains(photo))
        .collect();
    for lost in doubtful {
        let mut supported = false;
        for other in (0..photos.len()).filter(|other| !outside[*other]) {
            let (a, b) = (lost.min(other), lost.max(other));
            let found = PairMatches {
                a,
                b,
                pairs: super::matches::cached_matches(photos, a, b, cache)?,
            };
            let obeying = found
                .inliers(&cameras, &points, tracks::TOLERANCE)
                .pairs
                .len();
            supported |= found.pairs.len() >= SUPPORT.0
                && obeying as f32 > SUPPORT.1 * found.pairs.len() as f32;
        }
        if !supported {
            checked.moved.retain(|photo| *photo != lost);
            checked.contradictory.push(lost);
        }
    }
    checked.contradictory.sort_unstable();
    Ok(())
}

/// Computes the poses of contradictory photos by resection from matched key points, and updates
/// `checked`.
pub(super) fn resect_contradictory(
    photos: &mut [PreparedPhoto],
    checked: &mut pose_check::PoseCheckReport,
    matches: &[PairMatches],
) {
    if checked.contradictory.is_empty() {
        return;
    }
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let points: Vec<Keypoints> = photos.iter().map(|p| p.points.clone()).collect();
    let placed = resection::place(&mut cameras, &checked.contradictory, &points, matches);
    photos
        .iter_mut()
        .zip(cameras)
        .for_each(|(photo, camera)| photo.camera = camera);
    checked
        .contradictory
        .retain(|photo| !placed.contains(photo));
    checked.moved.extend(placed);
    checked.moved.sort_unstable();
}

/// Warns about photos whose poses were wrong.
pub(super) fn warn(
    photos: &[PreparedPhoto],
    checked: &pose_check::PoseCheckReport,
    run: &Run,
    warnings: &mut Vec<String>,
) {
    let names = |list: &[usize]| {
        list.iter()
            .map(|&i| photos[i].camera.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    };
    for (list, what) in [
        (
            &checked.moved,
            "contradicted the photos and were corrected by key point matches",
        ),
        (
            &checked.contradictory,
            "contradict the photos and could not be corrected; these views are not trained on",
        ),
    ] {
        if !list.is_empty() {
            let warning = format!(
                "the poses of {} of {} photos {what}: {}",
                list.len(),
                photos.len(),
                names(list)
            );
            run.warn(&warning);
            warnings.push(warning);
        }
    }
}

/// Detects key points in the photos, scaled to the sizes of `cameras`.
fn detect_small(folder: &SceneFolder, cameras: &[Camera], run: &Run) -> Result<Vec<Keypoints>> {
    let work = run.work("key points for the pose check", cameras.len() as u64);
    let mut points = Vec::new();
    for camera in cameras {
        let small = image_io::resize(&folder.photo(&camera.name)?, camera.width, camera.height);
        points.push(keypoints::detect(&image::imageops::grayscale(&small))?);
        work.advance()?;
    }
    Ok(points)
}

/// Displacement at the corners, in pixels, above which a found distortion is removed from the
/// photos. A smaller distortion stays, because resampling reduces sharpness.
const MAX_CORNER_SHIFT: f32 = 1.0;
/// Adjusted poses are used if the reprojection error falls below this share of its old value. The
/// error of exact poses falls slightly, too, because adjustment also fits the noise of key points.
const MAX_ERROR_RATIO: f32 = 0.9;

/// Returns by how many pixels a radial distortion moves the corner of a photo.
fn corner_shift(camera: &Camera, k1: f32) -> f32 {
    let corner = camera.ray(glam::Vec2::ZERO).truncate();
    k1.abs() * corner.length().powi(3) * camera.fx
}

/// Runs bundle adjustment on all cameras, and removes the lens distortion that it finds. The given
/// poses stay if they fit almost as well, unless `asked` is [`Poses::Refine`]. They may come from
/// larger photos, and are then more exact.
pub(super) fn adjust(
    photos: &mut [PreparedPhoto],
    matches: &[PairMatches],
    asked: Poses,
    folder: &SceneFolder,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<Option<Adjusted>> {
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let points: Vec<Keypoints> = photos.iter().map(|p| p.points.clone()).collect();
    let work = run.work("bundle adjustment", 0);
    let Some(report) = bundle::adjust(&mut cameras, &points, matches) else {
        return Ok(None);
    };
    drop(work);
    let mut moved = report.moved.clone();
    moved.sort_by(f32::total_cmp);
    let explained = report.observations[1] as f32 / report.observations[0].max(1) as f32;
    let used = asked == Poses::Refine || report.error[1] < MAX_ERROR_RATIO * report.error[0];
    if used {
        photos
            .iter_mut()
            .zip(cameras)
            .for_each(|(photo, camera)| photo.camera = camera);
    }
    let shifts = photos.iter().zip(&report.k1);
    let bent = shifts.map(|(photo, k1)| corner_shift(&photo.camera, *k1));
    let bent = bent.fold(0.0, f32::max);
    let larger = |a: f32, b: f32| if b.abs() > a.abs() { b } else { a };
    let k1 = report.k1.iter().copied().fold(0.0, larger);
    if used && bent > MAX_CORNER_SHIFT {
        super::photos::remove_distortion(photos, &report.k1, folder)?;
        let warning = format!(
            "the lens distorts the photos by {bent:.1} pixels at their corners, but the input states no such distortion; the photos were straightened, labels \
             drawn on them were not; to remove the distortion at full size, add \"k1\": {k1:.4} to transforms.json, or a radial term to COLMAP's camera model"
        );
        super::warn(run, warnings, warning);
    }
    Ok(Some(Adjusted {
        error_before: report.error[0],
        error_after: report.error[1],
        explained,
        moved_median: moved.get(moved.len() / 2).copied().unwrap_or(0.0),
        moved_most: moved.last().copied().unwrap_or(0.0),
        focal: report.focal.iter().sum::<f32>() / report.focal.len().max(1) as f32,
        k1,
        used,
    }))
}
