//! Poses: found where there are none, checked where they are given.

use super::config::Sfm;
use super::photos::Known;
use crate::cache::{self, Cache};
use crate::{Result, Run};
use fastlgs_core::{Camera, SceneFolder, image_io};
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::{pose_check, structure};
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

/// Moves misplaced cameras and warns about them. Poses come from all photos, held out or not, as in structure from motion.
pub(super) fn check(
    photos: &mut [Known],
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<pose_check::Report> {
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
    let names = |list: &[usize]| list.iter().map(|&i| photos[i].camera.name.as_str()).collect::<Vec<_>>().join(", ");
    for (list, what) in [
        (&report.moved, "contradicted the photos and were moved to where the key points match"),
        (&report.contradictory, "contradict the photos and could not be mended; these views are not trained on"),
    ] {
        if !list.is_empty() {
            let warning = format!("the poses of {} of {} photos {what}: {}", list.len(), photos.len(), names(list));
            run.warn(&warning);
            warnings.push(warning);
        }
    }
    photos.iter_mut().zip(poses).for_each(|(photo, pose)| photo.camera.world_to_camera = pose);
    Ok(report)
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
