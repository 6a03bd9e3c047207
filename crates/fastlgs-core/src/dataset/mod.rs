//! Loads posed photos from the folders of other programs: COLMAP, nerfstudio, NeRF and LLFF.

pub mod album;
pub mod colmap;
pub mod llff;
pub mod pose;
pub mod transforms;

use crate::undistort::Distortion;
use crate::world_frame::WorldFrame;
use crate::{Camera, Error, Result, fs};
use album::Album;
pub use album::images_folder;
use glam::{DVec3, Vec3};
pub use pose::{PoseConvention, RawPose};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// A photo with its camera. The photo is still distorted.
#[derive(Clone, Debug)]
pub struct PosedPhoto {
    /// File of the photo.
    pub path: PathBuf,
    /// Pinhole part of the camera in the data set's frame. Its size is the one that the pose file
    /// states, which may differ from the photo's.
    pub camera: Camera,
    /// Pose as written in the file.
    pub raw_pose: RawPose,
    /// Lens distortion that preparation removes.
    pub distortion: Distortion,
    /// Path of the mask of ignored pixels, which are black in it.
    pub ignore: Option<PathBuf>,
    /// Whether the camera refers to the photo turned upright by its EXIF orientation, instead of
    /// the pixels as stored.
    pub upright: bool,
}

/// A 3-D point from structure from motion.
#[derive(Clone, Debug, PartialEq)]
pub struct SfmPoint {
    /// Position in the scene's frame.
    pub position: Vec3,
    /// Colour (red, green, blue), 0 to 255.
    pub color: [u8; 3],
    /// Indices of the training views in which the point is visible, as far as known.
    pub seen_by: Vec<u32>,
}

/// Content of the pose files, before sorting and checks.
#[derive(Clone, Debug, Default)]
pub struct ParsedPoses {
    /// Photos with poses. Name and pose of their cameras are not set yet.
    photos: Vec<PosedPhoto>,
    /// Points in world coordinates with their colours, 0 to 255.
    points: Vec<(DVec3, [u8; 3])>,
    /// For each point, the indices of the photos in its track. Empty if the points have colours.
    track_photos: Vec<Vec<u32>>,
    /// Conventions in which the poses may be written. The first is the default.
    conventions: Vec<PoseConvention>,
    /// Photos that the data set reserves for testing.
    held_out: Vec<PathBuf>,
    warnings: Vec<String>,
}

/// Posed photos, points and other content of a folder of photos.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// Photos with poses, sorted by name.
    pub photos: Vec<PosedPhoto>,
    /// Points from structure from motion; empty if the folder has none.
    pub points: Vec<SfmPoint>,
    /// For each point, the indices of the photos in its track; an empty entry means unknown. The
    /// list is empty if the points have colours.
    pub track_photos: Vec<Vec<u32>>,
    /// Frame of the cameras and points.
    pub frame: WorldFrame,
    /// Conventions in which the poses may be written. The first is the default.
    pub conventions: Vec<PoseConvention>,
    /// Names of the views that the data set reserves for testing.
    pub held_out: Vec<String>,
    /// Warnings about problems that do not prevent loading, one sentence each.
    pub warnings: Vec<String>,
    /// Frame of the existing scene. It is kept as long as it fits the cameras, so that the scene's
    /// Gaussians remain valid.
    pub earlier_frame: Option<WorldFrame>,
    /// Points in world coordinates, in the order of `points`.
    world_points: Vec<DVec3>,
}

impl Dataset {
    /// Sets the poses of all cameras by a convention. Chooses the frame again and transforms the
    /// points into it.
    pub fn apply_convention(&mut self, convention: PoseConvention) {
        let poses: Vec<_> = self
            .photos
            .iter()
            .map(|photo| photo.raw_pose.to_pose(convention))
            .collect();
        let centres: Vec<DVec3> = poses.iter().map(|pose| pose.centre()).collect();
        self.frame = self
            .earlier_frame
            .filter(|frame| frame.keeps_precision(&centres))
            .unwrap_or_else(|| WorldFrame::for_cameras(&centres));
        for (photo, pose) in self.photos.iter_mut().zip(&poses) {
            photo.camera.world_to_camera = self.frame.local_pose(pose);
        }
        for (point, world) in self.points.iter_mut().zip(&self.world_points) {
            point.position = self.frame.to_local(*world);
        }
    }
}

/// Returns the COLMAP model of PHOTOS with the most registered images. If there are several models,
/// also returns a warning that lists them.
fn colmap_model(photos: &Path) -> Option<(PathBuf, Option<String>)> {
    let roots = ["sparse", "colmap/sparse"].map(|root| photos.join(root));
    let numbered = roots.iter().flat_map(|root| {
        let mut folders: Vec<PathBuf> = root
            .read_dir()
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path())
            .collect();
        folders.sort();
        folders
    });
    let models: Vec<PathBuf> = numbered
        .chain(roots.iter().cloned())
        .filter(|folder| colmap::is_model(folder))
        .collect();
    if models.len() < 2 {
        return models.into_iter().next().map(|model| (model, None));
    }
    let mut sizes: Vec<(usize, PathBuf)> = models
        .into_iter()
        .map(|model| (colmap::registered_count(&model), model))
        .collect();
    // The sort is stable: among models of equal size, the first wins.
    sizes.sort_by_key(|(size, _)| std::cmp::Reverse(*size));
    let list = |models: &[(usize, PathBuf)]| {
        let each = models
            .iter()
            .map(|(size, model)| format!("{} ({size} photos)", model.display()));
        each.collect::<Vec<_>>().join(", ")
    };
    let warning = format!(
        "found {} COLMAP models; using {}; ignoring {}",
        sizes.len(),
        list(&sizes[..1]),
        list(&sizes[1..])
    );
    Some((sizes.swap_remove(0).1, Some(warning)))
}

/// Returns whether PHOTOS has poses that [`load`] can read.
pub fn has_poses(photos: &Path) -> bool {
    colmap_model(photos).is_some()
        || !transforms::files(photos).is_empty()
        || photos.join(llff::FILE).is_file()
}

/// Loads the posed photos of PHOTOS, with the masks in `ignore/`.
///
/// The poses come from the first of these that exists: a COLMAP model (binary or text) in `sparse/`
/// or `colmap/sparse/`, `transforms.json` (nerfstudio, instant-ngp), `transforms_train.json`
/// (NeRF's synthetic scenes), or `poses_bounds.npy` (LLFF).
///
/// # Errors
/// No poses, a damaged file, a pose that is not finite, or poses without any photo.
pub fn load(photos: &Path) -> Result<Dataset> {
    if !photos.is_dir() {
        return Err(Error::Invalid(format!(
            "{}: no such folder of photos",
            photos.display()
        )));
    }
    if let Some((folder, warning)) = colmap_model(photos) {
        let mut dataset = load_model(photos, &folder)?;
        dataset.warnings.splice(0..0, warning);
        return Ok(dataset);
    }
    let album = Album::of(photos);
    let files = transforms::files(photos);
    let stated = if !files.is_empty() {
        transforms::load(photos, &album, &files)?
    } else if photos.join(llff::FILE).is_file() {
        llff::load(photos)?
    } else {
        return Err(Error::Invalid(format!(
            "{}: no poses found; expected sparse/0/cameras.bin (or .txt) of COLMAP, transforms.json or poses_bounds.npy beside images/",
            photos.display()
        )));
    };
    assembled(photos, &album, stated)
}

/// Loads PHOTOS with the poses of a COLMAP model in another folder.
///
/// # Errors
/// As [`load`].
pub fn load_model(photos: &Path, model: &Path) -> Result<Dataset> {
    let album = Album::of(photos);
    let base = images_folder(photos).unwrap_or_else(|| photos.to_owned());
    assembled(photos, &album, colmap::load(&album, &base, model)?)
}

/// Names, sorts and checks the content of the pose files.
fn assembled(photos: &Path, album: &Album, stated: ParsedPoses) -> Result<Dataset> {
    if stated.photos.is_empty() {
        let warnings = stated.warnings.iter().map(|warning| format!("; {warning}"));
        return Err(Error::Invalid(format!(
            "{}: no photo has a pose{}",
            photos.display(),
            warnings.collect::<String>()
        )));
    }
    let mut dataset = named_and_sorted(photos, album, stated)?;
    dataset.apply_convention(dataset.conventions[0]);
    for photo in &mut dataset.photos {
        photo
            .camera
            .check()
            .map_err(|reason| Error::format(photos, reason))?;
        check_principal_point(photo)?;
        if photo.ignore.is_none() {
            photo.ignore = ignore_mask(photos, &photo.camera.name, &photo.path);
        }
    }
    warn_of_photos_without_pose(album, &mut dataset);
    dataset
        .warnings
        .extend(images_folder(photos).and_then(|images| unreadable_images_warning(&images)));
    Ok(dataset)
}

/// Returns the content of the pose files with view names, sorted by them.
fn named_and_sorted(photos: &Path, album: &Album, mut stated: ParsedPoses) -> Result<Dataset> {
    let files: Vec<&Path> = stated.photos.iter().map(|p| p.path.as_path()).collect();
    let names = album.view_names(&files);
    let held_out = files
        .iter()
        .zip(&names)
        .filter(|(file, _)| stated.held_out.iter().any(|held| held == *file))
        .map(|(_, name)| name.clone())
        .collect();
    let photos_and_names = stated.photos.iter_mut().zip(names);
    photos_and_names.for_each(|(photo, name)| photo.camera.name = name);
    let name_of = |index: &usize| &stated.photos[*index].camera.name;
    let mut order: Vec<usize> = (0..stated.photos.len()).collect();
    order.sort_by(|a, b| name_of(a).cmp(name_of(b)));
    if let Some(pair) = order.windows(2).find(|p| name_of(&p[0]) == name_of(&p[1])) {
        let name = name_of(&pair[0]);
        let reason = format!("the photo '{name}' has two poses; remove one of them");
        return Err(Error::format(photos, reason));
    }
    let mut new_index = vec![0; order.len()];
    for (new, old) in order.iter().enumerate() {
        new_index[*old] = new as u32;
    }
    let mut dataset = Dataset {
        photos: order
            .iter()
            .map(|old| stated.photos[*old].clone())
            .collect(),
        conventions: stated.conventions,
        held_out,
        warnings: stated.warnings,
        ..Dataset::default()
    };
    let count = stated.points.len();
    let mut tracks = stated.track_photos.into_iter();
    for (position, color) in stated.points {
        let track = tracks.next();
        if !position.is_finite() {
            continue;
        }
        let renumbered = |track: Vec<u32>| {
            track
                .iter()
                .map(|photo| new_index[*photo as usize])
                .collect()
        };
        dataset.track_photos.extend(track.map(renumbered));
        dataset.world_points.push(position);
        dataset.points.push(SfmPoint {
            position: Vec3::ZERO,
            color,
            seen_by: Vec::new(),
        });
    }
    let lost = count - dataset.points.len();
    let warning =
        format!("{lost} of {count} points have NaN or infinite positions and are ignored");
    dataset.warnings.extend((lost > 0).then_some(warning));
    Ok(dataset)
}

/// Returns an error if the principal point lies outside the photo. The intrinsics then belong to
/// another image size.
fn check_principal_point(photo: &PosedPhoto) -> Result<()> {
    let Camera {
        width,
        height,
        cx,
        cy,
        ..
    } = photo.camera;
    let within = |c: f32, side: u32| c > 0.0 && c < side as f32;
    if within(cx, width) && within(cy, height) {
        return Ok(());
    }
    let why = format!(
        "the principal point ({cx}, {cy}) lies outside the {width}x{height} pixels of its camera; set the size that the camera was calibrated for (w and h in transforms.json)"
    );
    Err(Error::format(&photo.path, why))
}

/// Reads a UTF-8 file and removes the byte order mark.
fn text(path: &Path) -> Result<String> {
    let text =
        String::from_utf8(fs::read(path)?).map_err(|_| Error::format(path, "not UTF-8 text"))?;
    Ok(text
        .strip_prefix('\u{feff}')
        .map(str::to_owned)
        .unwrap_or(text))
}

/// Returns the ignore mask of a photo: `PHOTOS/ignore/NAME.png`. NAME is the view's name or the
/// photo's path in its folder, with or without the photo's extension.
fn ignore_mask(photos: &Path, view: &str, file: &Path) -> Option<PathBuf> {
    let below =
        images_folder(photos).and_then(|images| Some(file.strip_prefix(images).ok()?.to_owned()));
    let names = [PathBuf::from(view), below.unwrap_or_default()];
    let each = names
        .iter()
        .flat_map(|name| [name.with_added_extension("png"), name.with_extension("png")]);
    each.map(|name| photos.join("ignore").join(name))
        .find(|path| path.is_file())
}

/// Adds one warning that lists all photos without a pose.
fn warn_of_photos_without_pose(album: &Album, dataset: &mut Dataset) {
    let posed: HashSet<&Path> = dataset.photos.iter().map(|p| p.path.as_path()).collect();
    let extra: Vec<String> = album.others(&posed).collect();
    if !extra.is_empty() {
        let warning = format!(
            "{} photos have no pose and are ignored: {}",
            extra.len(),
            join_first(&extra)
        );
        dataset.warnings.push(warning);
    }
}

/// Extensions of image formats that cannot be read.
const UNSUPPORTED_EXTENSIONS: [&str; 11] = [
    "arw", "avif", "cr2", "cr3", "dng", "heic", "heif", "jp2", "jxl", "nef", "orf",
];

/// Returns a warning if a folder contains images that cannot be read, with their names; else
/// `None`.
pub fn unreadable_images_warning(images: &Path) -> Option<String> {
    let ending = |path: &Path| {
        path.extension()
            .map(|e| e.to_string_lossy().to_ascii_lowercase())
    };
    let is_hidden = |path: &Path| {
        path.file_name()
            .is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
    };
    let entries = std::fs::read_dir(images)
        .ok()?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| !is_hidden(path));
    let mut unread: Vec<PathBuf> = entries
        .filter(|path| ending(path).is_some_and(|e| UNSUPPORTED_EXTENSIONS.contains(&e.as_str())))
        .collect();
    unread.sort();
    let names: Vec<String> = unread
        .iter()
        .filter_map(|p| Some(p.file_name()?.to_string_lossy().into_owned()))
        .collect();
    let count = names.len();
    (count > 0).then(|| {
        format!(
            "{count} images have formats that cannot be read; convert them to JPEG or PNG: {}",
            join_first(&names)
        )
    })
}

/// Returns the names of the subfolders that contain photos, sorted.
pub fn folders_within(images: &Path) -> Vec<String> {
    let holds_photos = |path: &PathBuf| {
        std::fs::read_dir(path)
            .is_ok_and(|mut entries| entries.any(|e| e.is_ok_and(|e| is_photo(&e.path()))))
    };
    let entries = std::fs::read_dir(images)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    let mut found: Vec<String> = entries
        .filter(holds_photos)
        .filter_map(|p| Some(p.file_name()?.to_string_lossy().into_owned()))
        .collect();
    found.sort();
    found
}

/// Extensions of the image formats that can be read.
const PHOTO_EXTENSIONS: [&str; 8] = ["bmp", "jfif", "jpeg", "jpg", "png", "tif", "tiff", "webp"];

/// Returns whether the file extension is that of a readable photo. Hidden files, such as the
/// `._NAME` files of macOS, are not photos.
pub fn is_photo(path: &Path) -> bool {
    let hidden = path
        .file_name()
        .is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
    let ending = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default()
        .to_ascii_lowercase();
    !hidden && PHOTO_EXTENSIONS.contains(&ending.as_str())
}

/// Joins the first five names of a list for a message.
fn join_first(names: &[String]) -> String {
    let printable = |name: &String| {
        name.chars()
            .map(|c| if c.is_control() { '?' } else { c })
            .collect::<String>()
    };
    let joined = names
        .iter()
        .take(5)
        .map(printable)
        .collect::<Vec<_>>()
        .join(", ");
    if names.len() > 5 {
        format!("{joined}, ...")
    } else {
        joined
    }
}
