//! COLMAP sparse models: `cameras`, `images` and `points3D`, each `.bin` (little-endian) or `.txt`.

use super::{Dataset, PosedPhoto, SfmPoint, first_few};
use crate::fs::{self, Bytes};
use crate::undistort::{Bend, Distortion};
use crate::{Camera, Error, Result};
use glam::{DMat3, DQuat, DVec3, Mat4, Vec3};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Whether the folder holds a COLMAP model.
pub fn is_model(folder: &Path) -> bool {
    ["bin", "txt"].iter().any(|e| folder.join(format!("cameras.{e}")).is_file())
}

/// Intrinsics as COLMAP states them.
struct Lens {
    width: u32,
    height: u32,
    focal: [f64; 2],
    centre: [f64; 2],
    distortion: Distortion,
}

/// A registered image: rotation (w, x, y, z), translation, camera id, file name.
struct Registered {
    rotation: [f64; 4],
    translation: [f64; 3],
    lens: u32,
    name: String,
}

/// Names and parameter counts of COLMAP's camera models, by id.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// Reads the model in `folder`; photos are looked for in `PHOTOS/images`, then in PHOTOS itself.
///
/// # Errors
/// Missing or truncated files, unknown camera models, numbers that do not parse.
pub fn load(photos: &Path, folder: &Path) -> Result<Dataset> {
    let binary = folder.join("cameras.bin").is_file();
    let file = |name: &str| folder.join(format!("{name}.{}", if binary { "bin" } else { "txt" }));
    let (cameras, images, points) = (file("cameras"), file("images"), file("points3D"));
    let lenses = if binary { cameras_bin(&cameras)? } else { cameras_txt(&cameras)? };
    let registered = if binary { images_bin(&images)? } else { images_txt(&images)? };
    let mut dataset = Dataset::default();
    if points.is_file() {
        dataset.points = if binary { points_bin(&points)? } else { points_txt(&points)? };
    }
    let mut missing = Vec::new();
    let listed = registered.len();
    for image in registered {
        let lens = lenses.get(&image.lens).ok_or_else(|| {
            Error::format(&images, format!("image '{}' names camera {}, which {} lacks", image.name, image.lens, cameras.display()))
        })?;
        match find_photo(photos, &image.name) {
            Some(path) => dataset.photos.push(posed(path, &image, lens)),
            None => missing.push(image.name),
        }
    }
    if !missing.is_empty() {
        let names = first_few(&missing);
        dataset.warnings.push(format!("{} of {listed} images of {} have no photo: {names}", missing.len(), images.display()));
    }
    Ok(dataset)
}

fn find_photo(photos: &Path, name: &str) -> Option<PathBuf> {
    [photos.join("images").join(name), photos.join(name)].into_iter().find(|p| p.is_file())
}

fn posed(path: PathBuf, image: &Registered, lens: &Lens) -> PosedPhoto {
    let [w, x, y, z] = image.rotation;
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let world_to_camera = glam::DMat4::from_mat3_translation(rotation, DVec3::from(image.translation));
    PosedPhoto {
        camera: Camera {
            name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            width: lens.width,
            height: lens.height,
            fx: lens.focal[0] as f32,
            fy: lens.focal[1] as f32,
            cx: lens.centre[0] as f32,
            cy: lens.centre[1] as f32,
            world_to_camera: Mat4::from_cols_array(&world_to_camera.to_cols_array().map(|v| v as f32)),
        },
        path,
        distortion: lens.distortion,
        ignore: None,
    }
}

fn lens(path: &Path, model: &str, width: u64, height: u64, p: &[f64]) -> Result<Lens> {
    let d = |i: usize| p[i] as f32;
    let none = Distortion::default();
    let (focal, centre, distortion) = match model {
        "SIMPLE_PINHOLE" => ([p[0], p[0]], [p[1], p[2]], none),
        "PINHOLE" => ([p[0], p[1]], [p[2], p[3]], none),
        "SIMPLE_RADIAL" => ([p[0], p[0]], [p[1], p[2]], Distortion { k1: d(3), ..none }),
        "RADIAL" => ([p[0], p[0]], [p[1], p[2]], Distortion { k1: d(3), k2: d(4), ..none }),
        "OPENCV" => ([p[0], p[1]], [p[2], p[3]], Distortion { k1: d(4), k2: d(5), p1: d(6), p2: d(7), ..none }),
        "FULL_OPENCV" => {
            let (tangential, below) = ((d(6), d(7)), [d(9), d(10), d(11)]);
            ([p[0], p[1]], [p[2], p[3]], Distortion { k1: d(4), k2: d(5), k3: d(8), p1: tangential.0, p2: tangential.1, below, ..none })
        }
        "OPENCV_FISHEYE" => {
            ([p[0], p[1]], [p[2], p[3]], Distortion { bend: Bend::Fisheye, k1: d(4), k2: d(5), k3: d(6), k4: d(7), ..none })
        }
        "SIMPLE_RADIAL_FISHEYE" => ([p[0], p[0]], [p[1], p[2]], Distortion { bend: Bend::Fisheye, k1: d(3), ..none }),
        "RADIAL_FISHEYE" => ([p[0], p[0]], [p[1], p[2]], Distortion { bend: Bend::Fisheye, k1: d(3), k2: d(4), ..none }),
        "FOV" => ([p[0], p[1]], [p[2], p[3]], if p[4] == 0.0 { none } else { Distortion { bend: Bend::Fov(d(4)), ..none } }),
        "THIN_PRISM_FISHEYE" => {
            let radial = Distortion { bend: Bend::Fisheye, k1: d(4), k2: d(5), k3: d(8), k4: d(9), ..none };
            ([p[0], p[1]], [p[2], p[3]], Distortion { p1: d(6), p2: d(7), prism: [d(10), d(11)], ..radial })
        }
        other => {
            return Err(Error::format(
                path,
                format!("camera model {other} is not supported; undistort with 'colmap image_undistorter' first"),
            ));
        }
    };
    Ok(Lens { width: width as u32, height: height as u32, focal, centre, distortion })
}

fn cameras_bin(path: &Path) -> Result<HashMap<u32, Lens>> {
    let data = fs::read(path)?;
    let mut bytes = Bytes::new(path, &data);
    let count = bytes.count(24)?;
    let mut lenses = HashMap::new();
    for _ in 0..count {
        let (id, model) = (bytes.u32()?, bytes.u32()?);
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        let &(name, n) = MODELS.get(model as usize).ok_or_else(|| Error::format(path, format!("unknown camera model number {model}")))?;
        let parameters = (0..n).map(|_| bytes.f64()).collect::<Result<Vec<_>>>()?;
        lenses.insert(id, lens(path, name, width, height, &parameters)?);
    }
    Ok(lenses)
}

fn images_bin(path: &Path) -> Result<Vec<Registered>> {
    let data = fs::read(path)?;
    let mut bytes = Bytes::new(path, &data);
    let count = bytes.count(73)?;
    (0..count)
        .map(|_| {
            bytes.u32()?;
            let mut pose = [0.0; 7];
            for value in &mut pose {
                *value = bytes.f64()?;
            }
            let lens = bytes.u32()?;
            let name = bytes.c_string()?.to_owned();
            let observations = bytes.count(24)?;
            bytes.take(observations * 24)?;
            let [w, x, y, z, tx, ty, tz] = pose;
            Ok(Registered { rotation: [w, x, y, z], translation: [tx, ty, tz], lens, name })
        })
        .collect()
}

fn points_bin(path: &Path) -> Result<Vec<SfmPoint>> {
    let data = fs::read(path)?;
    let mut bytes = Bytes::new(path, &data);
    let count = bytes.count(51)?;
    (0..count)
        .map(|_| {
            bytes.u64()?;
            let position = Vec3::new(bytes.f64()? as f32, bytes.f64()? as f32, bytes.f64()? as f32);
            let rgb = bytes.take(3)?;
            bytes.f64()?;
            let track = bytes.count(8)?;
            bytes.take(track * 8)?;
            Ok(SfmPoint { position, color: [rgb[0], rgb[1], rgb[2]], seen_by: Vec::new() })
        })
        .collect()
}

/// The fields of each line that is not a comment, with its line number.
fn rows(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    let lines = text.lines().enumerate().filter(|(_, l)| !l.starts_with('#'));
    lines.map(|(i, l)| (i + 1, l.split_whitespace().collect()))
}

fn text(path: &Path) -> Result<String> {
    String::from_utf8(fs::read(path)?).map_err(|_| Error::format(path, "not UTF-8 text"))
}

fn parse<T: std::str::FromStr>(path: &Path, line: usize, fields: &[&str], i: usize) -> Result<T> {
    fields
        .get(i)
        .and_then(|f| f.parse().ok())
        .ok_or_else(|| Error::format(path, format!("line {line}, field {}: a number was expected", i + 1)))
}

fn cameras_txt(path: &Path) -> Result<HashMap<u32, Lens>> {
    let mut lenses = HashMap::new();
    for (line, f) in rows(&text(path)?).filter(|(_, f)| !f.is_empty()) {
        let model = f.get(1).copied().unwrap_or_default();
        let n = MODELS.iter().find(|m| m.0 == model).map(|m| m.1);
        let n = n.ok_or_else(|| Error::format(path, format!("line {line}: unknown camera model '{model}'")))?;
        let parameters = (0..n).map(|i| parse(path, line, &f, 4 + i)).collect::<Result<Vec<f64>>>()?;
        let (width, height) = (parse(path, line, &f, 2)?, parse(path, line, &f, 3)?);
        lenses.insert(parse(path, line, &f, 0)?, lens(path, model, width, height, &parameters)?);
    }
    Ok(lenses)
}

fn images_txt(path: &Path) -> Result<Vec<Registered>> {
    let content = text(path)?;
    // Every second line lists observations and may be empty: only comments are dropped before pairing.
    let lines: Vec<_> = rows(&content).collect();
    let mut images = Vec::new();
    for (line, f) in lines.iter().step_by(2).filter(|(_, f)| !f.is_empty()) {
        let number = |i| parse::<f64>(path, *line, f, i);
        images.push(Registered {
            rotation: [number(1)?, number(2)?, number(3)?, number(4)?],
            translation: [number(5)?, number(6)?, number(7)?],
            lens: parse(path, *line, f, 8)?,
            name: f
                .get(9..)
                .map(|n| n.join(" "))
                .filter(|n| !n.is_empty())
                .ok_or_else(|| Error::format(path, format!("line {line}: the image's name is missing")))?,
        });
    }
    Ok(images)
}

fn points_txt(path: &Path) -> Result<Vec<SfmPoint>> {
    rows(&text(path)?)
        .filter(|(_, f)| !f.is_empty())
        .map(|(line, f)| {
            let number = |i| parse::<f32>(path, line, &f, i);
            let byte = |i| parse::<u8>(path, line, &f, i);
            Ok(SfmPoint {
                position: Vec3::new(number(1)?, number(2)?, number(3)?),
                color: [byte(4)?, byte(5)?, byte(6)?],
                seen_by: Vec::new(),
            })
        })
        .collect()
}
