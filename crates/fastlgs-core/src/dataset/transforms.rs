//! Reads `transforms.json` of instant-ngp and nerfstudio: camera-to-world matrices with OpenGL axes
//! (y up, looking along -z).

use super::album::{Album, find_by_suffix};
use super::pose::{PoseConvention, RawPose};
use super::{ParsedPoses, PosedPhoto, text};
use crate::undistort::{Distortion, LensProjection};
use crate::{Camera, Error, Result};
use glam::{DMat4, DVec3, DVec4, Mat4};
use serde::Deserialize;
use std::path::{Path, PathBuf};

#[derive(Deserialize, Default, Clone)]
struct Lens {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    /// Field of instant-ngp; true for an equidistant fisheye.
    is_fisheye: Option<bool>,
    /// Field of nerfstudio. Without it, the camera is a pinhole with optional distortion.
    camera_model: Option<String>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    /// Path of the mask of ignored pixels, which are black in it.
    mask_path: Option<String>,
    /// Rows of four numbers. The last row may be missing.
    transform_matrix: Vec<[Option<f64>; 4]>,
    #[serde(flatten)]
    lens: Lens,
}

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    lens: Lens,
    frames: Vec<Frame>,
}

/// Pose file of the training photos in data sets with splits (NeRF's synthetic scenes).
const TRAIN: &str = "transforms_train.json";
/// Pose file of the held-out photos in such data sets.
const TEST: &str = "transforms_test.json";

/// Returns the pose files of PHOTOS, each with whether its photos are held out.
pub fn files(photos: &Path) -> Vec<(PathBuf, bool)> {
    let one = photos.join("transforms.json");
    if one.is_file() {
        return vec![(one, false)];
    }
    let sets = [(photos.join(TRAIN), false), (photos.join(TEST), true)];
    if sets[0].0.is_file() {
        sets.into_iter()
            .filter(|(file, _)| file.is_file())
            .collect()
    } else {
        Vec::new()
    }
}

/// Reads the poses of PHOTOS. Frames without photo are skipped, and a warning lists them.
///
/// # Errors
/// Damaged JSON, a matrix entry that is NaN or infinite, a missing focal length, or a missing mask.
pub fn load(photos: &Path, album: &Album, files: &[(PathBuf, bool)]) -> Result<ParsedPoses> {
    let mut stated = ParsedPoses {
        conventions: PoseConvention::OF_MATRICES.to_vec(),
        ..ParsedPoses::default()
    };
    let read = files
        .iter()
        .map(|(path, _)| read(path))
        .collect::<Result<Vec<_>>>()?;
    // Names of all files are resolved together, so that no two names get the same photo.
    let names: Vec<String> = read
        .iter()
        .flat_map(|file| &file.frames)
        .map(|frame| frame.file_path.clone())
        .collect();
    let mut found = album.find(&names, photos).into_iter();
    for ((path, held_out), file) in files.iter().zip(&read) {
        let photos: Vec<Option<PathBuf>> = found.by_ref().take(file.frames.len()).collect();
        add(album, path, *held_out, file, photos, &mut stated)?;
    }
    Ok(stated)
}

fn read(path: &Path) -> Result<Transforms> {
    // JSON has no NaN, but Python writes it. Such entries become null, and `matrix` reports them.
    let text = replace_non_finite(&text(path)?);
    let file: Transforms = serde_json::from_str(&text)
        .map_err(|e| Error::format(path, format!("not the expected JSON: {e}")))?;
    if file.frames.is_empty() {
        return Err(Error::format(
            path,
            "the file lists no frames; export it again",
        ));
    }
    Ok(file)
}

/// Adds the frames of a file that have a photo.
fn add(
    album: &Album,
    path: &Path,
    held_out: bool,
    file: &Transforms,
    photos: Vec<Option<PathBuf>>,
    stated: &mut ParsedPoses,
) -> Result<()> {
    let matrices = file
        .frames
        .iter()
        .map(|frame| matrix(path, frame))
        .collect::<Result<Vec<_>>>()?;
    // The storage order of a pose at the origin is ambiguous. It follows the other poses of the
    // file.
    let stored_transposed = matrices.iter().any(|(_, by_columns)| *by_columns);
    let mut missing = Vec::new();
    for ((frame, photo), (matrix, transposed)) in file.frames.iter().zip(photos).zip(matrices) {
        let Some(photo) = photo else {
            missing.push(frame.file_path.clone());
            continue;
        };
        let at_origin = matrix.w_axis.truncate() == DVec3::ZERO;
        let matrix = if stored_transposed && !transposed && at_origin {
            matrix.transpose()
        } else {
            matrix
        };
        if held_out {
            stated.held_out.push(photo.clone());
        }
        stated
            .photos
            .push(posed(path, photo, frame, &file.lens, matrix)?);
    }
    if stored_transposed {
        let why =
            "the translations are in the last row of the matrices, so they were read as transposed";
        stated.warnings.push(format!("{}: {why}", path.display()));
    }
    stated
        .warnings
        .extend(album.missing(&missing, file.frames.len(), path));
    Ok(())
}

/// Returns the pose of a frame, and whether the file stores the matrix transposed.
///
/// # Errors
/// A wrong number of rows, an entry that is NaN or infinite, or a last row other than (0, 0, 0, 1).
fn matrix(file: &Path, frame: &Frame) -> Result<(DMat4, bool)> {
    let name = &frame.file_path;
    let mut rows = [DVec4::W; 4];
    if !(3..=4).contains(&frame.transform_matrix.len()) {
        let count = frame.transform_matrix.len();
        return Err(Error::format(
            file,
            format!("the pose of '{name}' has {count} rows, not 4; export it again"),
        ));
    }
    for (row, values) in rows.iter_mut().zip(&frame.transform_matrix) {
        for (k, value) in values.iter().enumerate() {
            row[k] = value.ok_or_else(|| {
                Error::format(file, format!("the pose of '{name}' has a NaN or infinite entry; remove or correct that frame"))
            })?;
        }
    }
    let by_rows = DMat4::from_cols_array_2d(&rows.map(|r| r.to_array()));
    let is_last = |row: DVec4| (row - DVec4::W).abs().max_element() < 1e-6;
    if is_last(rows[3]) {
        return Ok((by_rows.transpose(), false));
    }
    if is_last(by_rows.row(3)) {
        return Ok((by_rows, true));
    }
    let last = rows[3];
    let why = format!(
        "the pose of '{name}' has the last row [{}, {}, {}, {}], not [0, 0, 0, 1]; export it again",
        last.x, last.y, last.z, last.w
    );
    Err(Error::format(file, why))
}

/// Replaces Python's NaN and Infinity by null, except inside strings.
fn replace_non_finite(text: &str) -> String {
    let mut within = false;
    let mut escaped = false;
    let parts = text.split_inclusive(|c| {
        let ends = c == '"' && !escaped;
        escaped = c == '\\' && !escaped;
        ends
    });
    let mended = parts.map(|part| {
        let number = !within;
        within ^= part.ends_with('"');
        if number {
            part.replace("-Infinity", "null")
                .replace("Infinity", "null")
                .replace("NaN", "null")
        } else {
            part.to_owned()
        }
    });
    mended.collect()
}

fn posed(
    file: &Path,
    photo: PathBuf,
    frame: &Frame,
    shared: &Lens,
    matrix: DMat4,
) -> Result<PosedPhoto> {
    let either = |f: fn(&Lens) -> Option<f64>| f(&frame.lens).or(f(shared));
    let (w, h) = match (either(|l| l.w), either(|l| l.h)) {
        (Some(w), Some(h)) => (w, h),
        _ => {
            let (w, h) = crate::image_io::dimensions(&photo)?;
            (f64::from(w), f64::from(h))
        }
    };
    let from_angle = either(|l| l.camera_angle_x).map(|a| w / (2.0 * (a / 2.0).tan()));
    let fx = either(|l| l.fl_x).or(from_angle).ok_or_else(|| {
        Error::format(
            file,
            "the focal length is missing; add fl_x or camera_angle_x",
        )
    })?;
    let coefficient = |f: fn(&Lens) -> Option<f64>| either(f).unwrap_or(0.0) as f32;
    let projection = projection(file, &frame.lens, shared)?;
    let ignore = frame
        .mask_path
        .as_ref()
        .map(|mask| find_mask(file, &photo, mask))
        .transpose()?;
    Ok(PosedPhoto {
        path: photo,
        camera: Camera {
            name: String::new(),
            width: w as u32,
            height: h as u32,
            fx: fx as f32,
            fy: either(|l| l.fl_y).unwrap_or(fx) as f32,
            cx: either(|l| l.cx).unwrap_or(w / 2.0) as f32,
            cy: either(|l| l.cy).unwrap_or(h / 2.0) as f32,
            world_to_camera: Mat4::IDENTITY,
        },
        raw_pose: RawPose::Matrix(matrix),
        distortion: Distortion {
            projection,
            k1: coefficient(|l| l.k1),
            k2: coefficient(|l| l.k2),
            k3: coefficient(|l| l.k3),
            k4: coefficient(|l| l.k4),
            p1: coefficient(|l| l.p1),
            p2: coefficient(|l| l.p2),
            ..Distortion::default()
        },
        ignore,
        upright: false,
    })
}

/// Returns the projection of a lens. Values that it lacks are `shared` by all photos.
fn projection(file: &Path, lens: &Lens, shared: &Lens) -> Result<LensProjection> {
    let model = lens.camera_model.as_deref();
    match model.or(shared.camera_model.as_deref()) {
        None if lens.is_fisheye.or(shared.is_fisheye) == Some(true) => Ok(LensProjection::Fisheye),
        None
        | Some(
            "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE",
        ) => Ok(LensProjection::None),
        Some("OPENCV_FISHEYE") => Ok(LensProjection::Fisheye),
        Some(other) => Err(Error::format(
            file,
            format!("the camera_model '{other}' is not supported; undistort the photos first"),
        )),
    }
}

/// Returns the mask of a frame: the file with the longest trailing part of the path `mask`. The
/// photo itself is not accepted.
fn find_mask(file: &Path, photo: &Path, mask: &str) -> Result<PathBuf> {
    let folder = file.parent().unwrap_or(Path::new("."));
    let same = |path: &PathBuf| path.canonicalize().ok() == photo.canonicalize().ok();
    let found = find_by_suffix(mask, &[folder.to_owned()]).filter(|path| !same(path));
    found.ok_or_else(|| {
        let (mask, photo) = (folder.join(mask), photo.display());
        Error::format(
            file,
            format!(
                "the mask '{}' of '{photo}' is missing; add it or remove its mask_path",
                mask.display()
            ),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::RgbImage;

    #[test]
    fn is_fisheye_and_file_names_that_contain_nan_are_read() {
        let dir = tempfile::tempdir().expect("a folder");
        let name = "Infinity \"NaN\".png";
        crate::image_io::save_png(&dir.path().join("images").join(name), RgbImage::new(8, 6))
            .expect("a photo");
        let frame = |pose: &str| {
            let text = format!(
                r#"{{"fl_x": 9, "w": 8, "h": 6, "k1": 0.1, "is_fisheye": true,
                "frames": [{{"file_path": {name:?}, "transform_matrix": {pose}}}]}}"#,
                name = format!("images/{name}")
            );
            std::fs::write(dir.path().join("transforms.json"), text).expect("a file");
            super::super::load(dir.path())
        };
        let photos = frame("[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]")
            .expect("a pose")
            .photos;
        assert_eq!(
            (photos.len(), photos[0].distortion.projection),
            (1, LensProjection::Fisheye)
        );
        let refused = frame("[[NaN,0,0,0],[0,1,0,-Infinity],[0,0,1,0],[0,0,0,1]]")
            .expect_err("no pose")
            .to_string();
        assert!(refused.contains("NaN or infinite"), "{refused}");
    }
}
