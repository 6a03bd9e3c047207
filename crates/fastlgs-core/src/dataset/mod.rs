//! Posed photos from other programs' folders.

pub mod colmap;
pub mod llff;
pub mod transforms;

use crate::undistort::Distortion;
use crate::{Camera, Error, Result};
use glam::Vec3;
use std::path::{Path, PathBuf};

/// One photo with the camera that took it, still distorted.
#[derive(Clone, Debug)]
pub struct PosedPhoto {
    /// File of the photo.
    pub path: PathBuf,
    /// Pinhole part of the camera, at the resolution that the poses' file states.
    pub camera: Camera,
    /// Lens distortion to be removed.
    pub distortion: Distortion,
    /// Mask of what does not count: black there.
    pub ignore: Option<PathBuf>,
}

/// A reconstructed 3-D point (structure from motion).
#[derive(Clone, Debug, PartialEq)]
pub struct SfmPoint {
    /// Position in the world.
    pub position: Vec3,
    /// Colour, 0 to 255.
    pub color: [u8; 3],
    /// Numbers of the training views that are known to show it.
    pub seen_by: Vec<u32>,
}

/// Posed photos, sorted by name, and what else their folder offered.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// Photos with poses, sorted by name.
    pub photos: Vec<PosedPhoto>,
    /// Structure-from-motion points; empty where the folder has none.
    pub points: Vec<SfmPoint>,
    /// What was wrong but survivable, one sentence each.
    pub warnings: Vec<String>,
}

/// Whether PHOTOS has poses of a kind that [`load`] reads.
pub fn has_poses(photos: &Path) -> bool {
    let model = ["sparse/0", "sparse"].iter().any(|s| colmap::is_model(&photos.join(s)));
    model || photos.join("transforms.json").is_file() || photos.join(llff::FILE).is_file()
}

/// Loads PHOTOS, with the masks in `ignore/`: `sparse/0` or `sparse` (COLMAP, binary or text) `transforms.json` (nerfstudio, instant-ngp) or
/// `poses_bounds.npy` (LLFF).
///
/// # Errors
/// When no poses are found, a file is damaged, a pose is not finite, or no posed photo is left.
pub fn load(photos: &Path) -> Result<Dataset> {
    if !photos.is_dir() {
        return Err(Error::Invalid(format!("{}: no such folder of photos", photos.display())));
    }
    let sparse = ["sparse/0", "sparse"].iter().map(|s| photos.join(s));
    let mut dataset = if let Some(folder) = sparse.into_iter().find(|s| colmap::is_model(s)) {
        colmap::load(photos, &folder)?
    } else if photos.join("transforms.json").is_file() {
        transforms::load(photos)?
    } else if photos.join(llff::FILE).is_file() {
        llff::load(photos)?
    } else {
        return Err(Error::Invalid(format!(
            "{}: no poses found; expected sparse/0/cameras.bin (or .txt) of COLMAP, transforms.json or poses_bounds.npy beside images/",
            photos.display()
        )));
    };
    if dataset.photos.is_empty() {
        return Err(Error::Invalid(format!("{}: no photo has a pose", photos.display())));
    }
    for photo in &dataset.photos {
        photo.camera.check().map_err(|reason| Error::format(photos, reason))?;
    }
    let count = dataset.points.len();
    dataset.points.retain(|point| point.position.is_finite());
    if dataset.points.len() < count {
        dataset.warnings.push(format!("{} points of {count} are nowhere (NaN or infinite) and are left out", count - dataset.points.len()));
    }
    dataset.photos.sort_by(|a, b| a.camera.name.cmp(&b.camera.name));
    if let Some(pair) = dataset.photos.windows(2).find(|p| p[0].camera.name == p[1].camera.name) {
        return Err(Error::format(
            photos,
            format!("two poses for the photo '{}'; photos of different folders need names of their own", pair[0].camera.name),
        ));
    }
    for photo in dataset.photos.iter_mut().filter(|p| p.ignore.is_none()) {
        photo.ignore = ignore_mask(photos, &photo.camera.name);
    }
    warn_of_photos_without_pose(photos, &mut dataset);
    dataset.warnings.extend(passed_over(&photos.join("images")));
    Ok(dataset)
}

/// `PHOTOS/ignore/NAME.png`, with or without the photo's own ending.
fn ignore_mask(photos: &Path, name: &str) -> Option<PathBuf> {
    let stem = Path::new(name).file_stem()?.to_string_lossy().into_owned();
    [name, &stem].iter().map(|n| photos.join("ignore").join(format!("{n}.png"))).find(|p| p.is_file())
}

/// Photos that no pose names are left out; the user hears of it once.
fn warn_of_photos_without_pose(photos: &Path, dataset: &mut Dataset) {
    let Ok(entries) = std::fs::read_dir(photos.join("images")) else { return };
    let posed: std::collections::HashSet<_> = dataset.photos.iter().filter_map(|p| p.path.file_name()).collect();
    let mut extra: Vec<String> = entries
        .flatten()
        .map(|e| e.path())
        .filter(|p| is_photo(p) && p.file_name().is_some_and(|n| !posed.contains(n)))
        .filter_map(|p| Some(p.file_name()?.to_string_lossy().into_owned()))
        .collect();
    extra.sort();
    if !extra.is_empty() {
        dataset.warnings.push(format!("{} photos have no pose and are left out: {}", extra.len(), first_few(&extra)));
    }
}

/// Endings of pictures that this project does not read.
const UNREAD: [&str; 12] = ["arw", "avif", "bmp", "cr2", "cr3", "dng", "heic", "heif", "nef", "tif", "tiff", "webp"];

/// What to do about pictures of a folder that are not read; nothing where there are none.
pub fn passed_over(images: &Path) -> Option<String> {
    let ending = |path: &Path| path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    let entries = std::fs::read_dir(images).ok()?.flatten().map(|entry| entry.path());
    let mut unread: Vec<PathBuf> = entries.filter(|path| ending(path).is_some_and(|e| UNREAD.contains(&e.as_str()))).collect();
    unread.sort();
    let names: Vec<String> = unread.iter().filter_map(|p| Some(p.file_name()?.to_string_lossy().into_owned())).collect();
    let count = names.len();
    (count > 0).then(|| format!("{count} pictures are neither JPEG nor PNG and are left out, convert them: {}", first_few(&names)))
}

/// Folders of photos within a folder of photos.
pub fn folders_within(images: &Path) -> Vec<String> {
    let holds_photos =
        |path: &PathBuf| std::fs::read_dir(path).is_ok_and(|mut entries| entries.any(|e| e.is_ok_and(|e| is_photo(&e.path()))));
    let entries = std::fs::read_dir(images).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut found: Vec<String> = entries.filter(holds_photos).filter_map(|p| Some(p.file_name()?.to_string_lossy().into_owned())).collect();
    found.sort();
    found
}

/// Whether the file's ending is that of a photo this project reads.
pub fn is_photo(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    matches!(ending.as_str(), "jpg" | "jpeg" | "png")
}

/// The first names of a list, for a message.
fn first_few(names: &[String]) -> String {
    let shown = names.iter().take(5).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > 5 { format!("{shown}, ...") } else { shown }
}
