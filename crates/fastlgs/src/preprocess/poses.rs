//! Poses: found where there are none, checked where they are given.

use super::config::{Adjusted, Poses, Sfm};
use super::photos::Known;
use crate::cache::{self, Cache};
use crate::progress::Work;
use crate::{Error, Result, Run};
use fastlgs_core::{Camera, SceneFolder, dataset, image_io};
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::structure::Tool;
use fastlgs_vision::tracks::PairMatches;
use fastlgs_vision::{bundle, frame, pose_check, resection, structure};
use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Structure from motion for photos without poses.
pub(super) fn find(photos: &Path, sfm: Sfm, run: &Run) -> Result<()> {
    let tool = structure::Tool::find(sfm == Sfm::Colmap)?;
    let work = run.work("poses", 0);
    run.warn(&format!("{}: no poses; structure from motion looks for them, which takes minutes", photos.display()));
    let folders = dataset::folders_within(&photos.join("images"));
    if !folders.is_empty() {
        run.warn(&format!("photos in folders within images/ are not read ({}): move them up", folders.join(", ")));
    }
    let found = structure::reconstruct(&tool, photos, run.seed, |stage, line| told(&work, stage, line));
    work.check()?;
    Ok(found?)
}

/// Passes on what a tool prints; whether to go on.
fn told(work: &Work, stage: &str, line: &str) -> bool {
    work.note(&format!("{stage}: {line}"));
    work.check().is_ok()
}

/// Longer side of the pictures on which poses are checked. Its tolerances are pixels, and the coarser key points of small
/// pictures are those that wide baselines share.
const CHECK_SIDE: u32 = 480;

/// Moves groups of cameras that contradict the others. Poses come from all photos, held out or not, as in structure from motion.
pub(super) fn check(
    photos: &mut [Known],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<pose_check::Report> {
    let given: Vec<Camera> = photos.iter().map(|p| p.camera.shrunk_to(CHECK_SIDE)).collect();
    let told = serde_json::to_vec(&given)?;
    let mut inputs: Vec<&[u8]> = photos.iter().map(|p| p.key.as_slice()).collect();
    let seed = run.seed.to_le_bytes();
    inputs.extend([told.as_slice(), &seed, keypoints::version().as_bytes()]);
    let key = cache::key(&inputs);
    let detected = OnceCell::new();
    let points = || -> Result<&Vec<Keypoints>> {
        if detected.get().is_none() {
            let small = photos.iter().zip(&given).any(|(p, c)| p.camera.width != c.width);
            let found = if small { detect_small(folder, &given, run)? } else { photos.iter().map(|p| p.points.clone()).collect() };
            let _ = detected.set(found);
        }
        Ok(detected.get().expect("set above"))
    };
    let poses = |cameras: &[Camera]| cameras.iter().map(|c| c.world_to_camera).collect::<Vec<_>>();
    let (mut report, mut mended) = cache.get("poses", &key, || {
        let mut cameras = given.clone();
        let report = pose_check::repair(&mut cameras, points()?, run.seed);
        Ok((report, poses(&cameras)))
    })?;
    if doubted(&report) > 0 && doubted(&report) * DOUBTED >= given.len() {
        let anew = cache.get("poses anew", &key, || {
            let found = anew(&given, points()?, &report, folder, run)?;
            Ok(found.map(|(cameras, report)| (report, poses(&cameras))))
        });
        match anew {
            Ok(anew) => (report, mended) = anew.unwrap_or((report, mended)),
            // What fails is tried again by the next run; that the tool is missing, too.
            Err(Error::Vision(error)) => {
                let warning =
                    format!("many poses contradict the photos, which could not be placed anew: {error}; they are mended one by one");
                run.warn(&warning);
                warnings.push(warning);
            }
            Err(error) => return Err(error),
        }
    }
    photos.iter_mut().zip(mended).for_each(|(photo, pose)| photo.camera.world_to_camera = pose);
    Ok(report)
}

/// Where structure from motion keeps what it needs, in the scene's folder.
const PARTIAL: &str = "sfm.partial";
/// One in so many photos whose poses are doubted is a reason to place all of them anew.
const DOUBTED: usize = 10;

/// How many poses were found wrong.
fn doubted(report: &pose_check::Report) -> usize {
    report.moved.len() + report.contradictory.len()
}

/// All photos placed anew with the lenses that are given, where many poses contradict the photos: what is wrong with many is seldom mended one by one.
/// In the frame of the poses that were right, and only where fewer of the new poses contradict the photos than of the old ones, and no more are lost.
fn anew(
    given: &[Camera],
    points: &[Keypoints],
    checked: &pose_check::Report,
    folder: &SceneFolder,
    run: &Run,
) -> Result<Option<(Vec<Camera>, pose_check::Report)>> {
    let Tool::Pycolmap(python) = Tool::find(false)? else {
        let mend = "that needs pycolmap, and only the program 'colmap' is there; 'fastlgs models install-offline' installs pycolmap";
        return Err(Error::Vision(fastlgs_vision::Error::Missing(mend.to_owned())));
    };
    let work = run.work("poses anew", 0);
    let files: Vec<PathBuf> = given.iter().map(|c| folder.photo_path(&c.name)).collect();
    let say = |stage: &str, line: &str| told(&work, stage, line);
    let partial = folder.root.join(PARTIAL);
    let found = structure::placed_anew(&python, &files, given, points, &partial, run.seed, say);
    let _ = std::fs::remove_dir_all(&partial);
    work.check()?;
    let found = found?;
    let Some((mut cameras, mut moved)) = frame::kept(given, &found, run.seed) else { return Ok(None) };
    let again = pose_check::repair(&mut cameras, points, run.seed);
    let unplaced = (0..given.len()).filter(|&photo| found[photo].is_none());
    let lost: BTreeSet<usize> = unplaced.chain(again.contradictory.iter().copied()).collect();
    let doubted_now = lost.iter().chain(&again.moved).collect::<BTreeSet<_>>().len();
    tracing::info!(doubted = doubted(checked), doubted_now, lost = lost.len(), "photos were placed anew");
    // What was mended is trained on, and what is lost is not.
    if doubted_now >= doubted(checked) || lost.len() > checked.contradictory.len() {
        return Ok(None);
    }
    moved.extend(again.moved);
    let moved = moved.difference(&lost).copied().collect();
    Ok(Some((cameras, pose_check::Report { moved, contradictory: lost.into_iter().collect() })))
}

/// Places photos that contradict the others by what their key points show.
pub(super) fn place(photos: &mut [Known], checked: &mut pose_check::Report, matches: &[PairMatches]) {
    if checked.contradictory.is_empty() {
        return;
    }
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let points: Vec<Keypoints> = photos.iter().map(|p| p.points.clone()).collect();
    let placed = resection::place(&mut cameras, &checked.contradictory, &points, matches);
    photos.iter_mut().zip(cameras).for_each(|(photo, camera)| photo.camera = camera);
    checked.contradictory.retain(|photo| !placed.contains(photo));
    checked.moved.extend(placed);
    checked.moved.sort_unstable();
}

/// Says which photos had wrong poses.
pub(super) fn warn(photos: &[Known], checked: &pose_check::Report, run: &Run, warnings: &mut Vec<String>) {
    let names = |list: &[usize]| list.iter().map(|&i| photos[i].camera.name.as_str()).collect::<Vec<_>>().join(", ");
    for (list, what) in [
        (&checked.moved, "contradicted the photos and were moved to where the key points match"),
        (&checked.contradictory, "contradict the photos and could not be mended; these views are not trained on"),
    ] {
        if !list.is_empty() {
            let warning = format!("the poses of {} of {} photos {what}: {}", list.len(), photos.len(), names(list));
            run.warn(&warning);
            warnings.push(warning);
        }
    }
}

/// Key points of the photos at the sizes of `cameras`.
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

/// Photos up to which all cameras are adjusted together: time grows with the third power of their number.
const ADJUSTED: usize = 600;
/// Pixels by which a lens may bend a photo's corners before the photos are straightened: resampling costs some sharpness.
const BENT: f32 = 1.0;
/// Adjusted poses are used where the error of the key points falls below this share of what it was: that of exact poses falls by some
/// hundredths, as adjusting fits the noise of the key points as well.
const MENDED: f32 = 0.9;

/// Adjusts all cameras to what the key points say. Poses that explain these about as well as the adjusted ones stay, unless refining was
/// asked for: structure from motion on larger photos knew better.
pub(super) fn adjust(
    photos: &mut [Known],
    matches: &[PairMatches],
    asked: Poses,
    folder: &SceneFolder,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<Option<Adjusted>> {
    if photos.len() > ADJUSTED && asked != Poses::Refine {
        let warning = format!(
            "poses and lenses of more than {ADJUSTED} photos are adjusted only if that is asked for (--poses refine), as it takes long"
        );
        run.warn(&warning);
        warnings.push(warning);
        return Ok(None);
    }
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.clone()).collect();
    let points: Vec<Keypoints> = photos.iter().map(|p| p.points.clone()).collect();
    let work = run.work("bundle adjustment", 0);
    let Some(report) = bundle::adjust(&mut cameras, &points, matches) else { return Ok(None) };
    drop(work);
    let mut moved = report.moved.clone();
    moved.sort_by(f32::total_cmp);
    let explained = report.observations[1] as f32 / report.observations[0].max(1) as f32;
    let used = asked == Poses::Refine || report.error[1] < MENDED * report.error[0];
    if used {
        photos.iter_mut().zip(cameras).for_each(|(photo, camera)| photo.camera = camera);
    }
    let bend = |(camera, k1): (&Camera, &f32)| {
        let corner = camera.ray(glam::Vec2::ZERO).truncate();
        k1.abs() * corner.length().powi(3) * camera.fx
    };
    let bent = photos.iter().map(|p| &p.camera).zip(&report.k1).map(bend).fold(0.0, f32::max);
    let k1 = report.k1.iter().copied().fold(0.0, |a: f32, b| if b.abs() > a.abs() { b } else { a });
    if used && bent > BENT {
        super::photos::straighten(photos, &report.k1, folder)?;
        let warning = format!(
            "the lens bends the photos by {bent:.1} pixels at their corners, which the given poses do not say; the photos were straightened \
             (\"k1\": {k1:.4} in a transforms.json, or a radial term in COLMAP's camera model, does it at full size; labels drawn on them are \
             as bent as they were)"
        );
        run.warn(&warning);
        warnings.push(warning);
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
