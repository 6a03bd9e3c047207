//! `transforms.json` of instant-ngp and nerfstudio: camera-to-world matrices in OpenGL axes (y up, looking along -z).

use super::{Dataset, PosedPhoto, first_few};
use crate::undistort::{Bend, Distortion};
use crate::{Camera, Error, Result, fs};
use glam::{Mat4, Vec4};
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
    /// instant-ngp's.
    is_fisheye: Option<bool>,
    /// nerfstudio's; pinholes with or without distortion where it is left out.
    camera_model: Option<String>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    /// Black where the photo does not count.
    mask_path: Option<String>,
    transform_matrix: [[Option<f64>; 4]; 4],
    #[serde(flatten)]
    lens: Lens,
}

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    lens: Lens,
    frames: Vec<Frame>,
}

/// Reads `PHOTOS/transforms.json`. Frames whose photo is missing are counted in a warning and left out.
///
/// # Errors
/// Damaged JSON, a matrix entry that is no number, or no focal length.
pub fn load(photos: &Path) -> Result<Dataset> {
    let path = photos.join("transforms.json");
    // JSON has no NaN, but Python writes it: such entries become null and are refused by name below.
    let text = String::from_utf8(fs::read(&path)?).map_err(|_| Error::format(&path, "not UTF-8 text"))?;
    let text = without_what_is_no_number(&text);
    let file: Transforms = serde_json::from_str(&text).map_err(|e| Error::format(&path, format!("not the expected JSON: {e}")))?;
    if file.frames.is_empty() {
        return Err(Error::format(&path, "it lists no frames"));
    }
    let mut dataset = Dataset::default();
    let mut missing = Vec::new();
    let listed = file.frames.len();
    for frame in file.frames {
        match find_photo(photos, &frame.file_path) {
            Some(photo) => dataset.photos.push(posed(&path, photo, &frame, &file.lens)?),
            None => missing.push(frame.file_path),
        }
    }
    if !missing.is_empty() {
        let names = first_few(&missing);
        dataset.warnings.push(format!("{} of {listed} frames of {} have no photo: {names}", missing.len(), path.display()));
    }
    Ok(dataset)
}

/// Python's NaN and Infinity as null, outside of strings.
fn without_what_is_no_number(text: &str) -> String {
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
        if number { part.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null") } else { part.to_owned() }
    });
    mended.collect()
}

/// Old files leave out the ending.
fn find_photo(photos: &Path, name: &str) -> Option<PathBuf> {
    let bare = photos.join(name);
    let endings = ["png", "jpg", "jpeg", "JPG"].map(|e| PathBuf::from(format!("{}.{e}", bare.display())));
    std::iter::once(bare).chain(endings).find(|p| p.is_file())
}

fn posed(file: &Path, photo: PathBuf, frame: &Frame, shared: &Lens) -> Result<PosedPhoto> {
    let name = photo.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let either = |f: fn(&Lens) -> Option<f64>| f(&frame.lens).or(f(shared));
    let (w, h) = match (either(|l| l.w), either(|l| l.h)) {
        (Some(w), Some(h)) => (w, h),
        _ => {
            let (w, h) = crate::image_io::dimensions(&photo)?;
            (f64::from(w), f64::from(h))
        }
    };
    let from_angle = either(|l| l.camera_angle_x).map(|a| w / (2.0 * (a / 2.0).tan()));
    let fx = either(|l| l.fl_x).or(from_angle).ok_or_else(|| Error::format(file, "neither fl_x nor camera_angle_x is given"))?;
    let mut rows = [Vec4::ZERO; 4];
    for (row, values) in rows.iter_mut().zip(&frame.transform_matrix) {
        for (k, value) in values.iter().enumerate() {
            row[k] = value.ok_or_else(|| {
                Error::format(file, format!("the pose of '{name}' has a NaN or infinite entry; remove or mend that frame"))
            })? as f32;
        }
    }
    let coefficient = |f: fn(&Lens) -> Option<f64>| either(f).unwrap_or(0.0) as f32;
    let bend = match frame.lens.camera_model.as_deref().or(shared.camera_model.as_deref()) {
        None if frame.lens.is_fisheye.or(shared.is_fisheye) == Some(true) => Bend::Fisheye,
        None | Some("PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE") => Bend::None,
        Some("OPENCV_FISHEYE") => Bend::Fisheye,
        Some(other) => {
            return Err(Error::format(file, format!("the camera_model '{other}' is not supported; undistort the photos first")));
        }
    };
    let camera_to_world = Mat4::from_cols_array_2d(&rows.map(|r| r.to_array())).transpose();
    let flip = Mat4::from_diagonal(Vec4::new(1.0, -1.0, -1.0, 1.0));
    let ignore = frame.mask_path.as_ref().map(|mask| file.with_file_name(mask));
    if let Some(mask) = ignore.as_ref().filter(|m| !m.is_file()) {
        return Err(Error::format(file, format!("the mask '{}' of '{name}' is missing; add it or remove its mask_path", mask.display())));
    }
    Ok(PosedPhoto {
        path: photo,
        camera: Camera {
            name,
            width: w as u32,
            height: h as u32,
            fx: fx as f32,
            fy: either(|l| l.fl_y).unwrap_or(fx) as f32,
            cx: either(|l| l.cx).unwrap_or(w / 2.0) as f32,
            cy: either(|l| l.cy).unwrap_or(h / 2.0) as f32,
            world_to_camera: (camera_to_world * flip).inverse(),
        },
        distortion: Distortion {
            bend,
            k1: coefficient(|l| l.k1),
            k2: coefficient(|l| l.k2),
            k3: coefficient(|l| l.k3),
            k4: coefficient(|l| l.k4),
            p1: coefficient(|l| l.p1),
            p2: coefficient(|l| l.p2),
            ..Distortion::default()
        },
        ignore,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::RgbImage;

    #[test]
    fn instant_ngps_fisheyes_and_names_like_numbers_are_read() {
        let dir = tempfile::tempdir().expect("a folder");
        let name = "Infinity \"NaN\".png";
        crate::image_io::save_png(&dir.path().join("images").join(name), RgbImage::new(8, 6)).expect("a photo");
        let frame = |pose: &str| {
            let text = format!(
                r#"{{"fl_x": 9, "w": 8, "h": 6, "k1": 0.1, "is_fisheye": true,
                "frames": [{{"file_path": {name:?}, "transform_matrix": {pose}}}]}}"#,
                name = format!("images/{name}")
            );
            std::fs::write(dir.path().join("transforms.json"), text).expect("a file");
            load(dir.path())
        };
        let photos = frame("[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]").expect("a pose").photos;
        assert_eq!((photos.len(), photos[0].distortion.bend), (1, Bend::Fisheye));
        let refused = frame("[[NaN,0,0,0],[0,1,0,-Infinity],[0,0,1,0],[0,0,0,1]]").expect_err("no pose").to_string();
        assert!(refused.contains("NaN or infinite"), "{refused}");
    }
}
