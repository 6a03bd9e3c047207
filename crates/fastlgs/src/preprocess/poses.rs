//! Poses: found where there are none, checked where they are given.

use super::config::{Adjusted, Poses, Sfm};
use super::photos::Known;
use crate::cache::{self, Cache};
use crate::{Result, Run};
use fastlgs_core::{Camera, SceneFolder, image_io};
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::tracks::PairMatches;
use fastlgs_vision::{bundle, pose_check, resection, structure};
use std::path::Path;

/// Structure from motion for photos without poses.
pub(super) fn find(photos: &Path, sfm: Sfm, run: &Run) -> Result<()> {
    let tool = structure::Tool::find(sfm == Sfm::Colmap)?;
    let work = run.work("poses", 0);
    run.warn(&format!("{}: no poses; structure from motion looks for them, which takes minutes", photos.display()));
    structure::reconstruct(&tool, photos, run.seed, |stage, line| {
        work.note(&format!("{stage}: {line}"));
        tracing::debug!(stage, line, "COLMAP");
    })?;
    Ok(())
}

/// Longer side of the pictures on which poses are checked. Its tolerances are pixels, and the coarser key points of small
/// pictures are those that wide baselines share.
const CHECK_SIDE: u32 = 480;

/// Moves groups of cameras that contradict the others. Poses come from all photos, held out or not, as in structure from motion.
pub(super) fn check(photos: &mut [Known], folder: &SceneFolder, cache: &Cache, run: &Run) -> Result<pose_check::Report> {
    let mut cameras: Vec<Camera> = photos.iter().map(|p| p.camera.shrunk_to(CHECK_SIDE)).collect();
    let given = serde_json::to_vec(&cameras)?;
    let mut inputs: Vec<&[u8]> = photos.iter().map(|p| p.key.as_slice()).collect();
    let seed = run.seed.to_le_bytes();
    inputs.extend([given.as_slice(), &seed, keypoints::backend().as_bytes()]);
    let (report, poses) = cache.get("poses", &cache::key(&inputs), || {
        let small = photos.iter().zip(&cameras).any(|(p, c)| p.camera.width != c.width);
        let points = if small { detect_small(folder, &cameras, run)? } else { photos.iter().map(|p| p.points.clone()).collect() };
        let report = pose_check::repair(&mut cameras, &points, run.seed);
        Ok((report, cameras.iter().map(|c| c.world_to_camera).collect::<Vec<_>>()))
    })?;
    photos.iter_mut().zip(poses).for_each(|(photo, pose)| photo.camera.world_to_camera = pose);
    Ok(report)
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
