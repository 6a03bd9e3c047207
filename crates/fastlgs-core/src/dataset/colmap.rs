//! COLMAP sparse models: `cameras`, `images` and `points3D`, each `.bin` (little-endian) or `.txt`.

use super::album::Album;
use super::pose::{PoseConvention, RawPose};
use super::{ParsedPoses, PosedPhoto, text};
use crate::fs::{self, ByteReader};
use crate::undistort::{Distortion, LensProjection};
use crate::{Camera, Error, Result};
use glam::{DVec3, Mat4};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Returns whether the folder contains a COLMAP model.
pub fn is_model(folder: &Path) -> bool {
    ["bin", "txt"]
        .iter()
        .any(|e| folder.join(format!("cameras.{e}")).is_file())
}

/// Intrinsics of one COLMAP camera.
struct Lens {
    width: u32,
    height: u32,
    focal: [f64; 2],
    centre: [f64; 2],
    distortion: Distortion,
}

/// A registered image: id, rotation quaternion in file order (COLMAP: w, x, y, z), translation,
/// camera id and file name.
struct Registered {
    id: u32,
    rotation: [f64; 4],
    translation: [f64; 3],
    lens: u32,
    name: String,
}

/// A 3-D point with the ids of the images in its track.
struct Point {
    position: DVec3,
    color: [u8; 3],
    images: Vec<u32>,
}

/// A camera model of COLMAP.
struct Model {
    name: &'static str,
    projection: LensProjection,
    /// Parameters in the order of the files, separated by spaces: focal lengths (f), principal
    /// point (c), radial (k), tangential (p) and thin prism (s) coefficients, and those of the
    /// radial denominator (d).
    parameters: &'static str,
}

impl Model {
    const fn new(name: &'static str, projection: LensProjection, parameters: &'static str) -> Self {
        Self {
            name,
            projection,
            parameters,
        }
    }

    /// Number of parameters.
    fn count(&self) -> usize {
        self.parameters.split(' ').count()
    }

    /// Returns the lens with these parameters.
    fn lens(&self, width: u64, height: u64, values: &[f64]) -> Lens {
        let mut lens = Lens {
            width: width as u32,
            height: height as u32,
            focal: [0.0; 2],
            centre: [0.0; 2],
            distortion: Distortion {
                projection: self.projection,
                ..Distortion::default()
            },
        };
        for (name, &value) in self.parameters.split(' ').zip(values) {
            let (distortion, single) = (&mut lens.distortion, value as f32);
            match name {
                "f" => lens.focal = [value; 2],
                "fx" => lens.focal[0] = value,
                "fy" => lens.focal[1] = value,
                "cx" => lens.centre[0] = value,
                "cy" => lens.centre[1] = value,
                "k1" => distortion.k1 = single,
                "k2" => distortion.k2 = single,
                "k3" => distortion.k3 = single,
                "k4" => distortion.k4 = single,
                "p1" => distortion.p1 = single,
                "p2" => distortion.p2 = single,
                "s1" => distortion.prism[0] = single,
                "s2" => distortion.prism[1] = single,
                "d1" => distortion.radial_denominator[0] = single,
                "d2" => distortion.radial_denominator[1] = single,
                "d3" => distortion.radial_denominator[2] = single,
                // A field of view of 0 means no distortion.
                "fov" if value == 0.0 => {}
                "fov" => distortion.projection = LensProjection::Fov(single),
                other => unreachable!("the parameter {other}"),
            }
        }
        lens
    }
}

/// COLMAP's camera models, indexed by model id.
const MODELS: [Model; 11] = {
    use LensProjection::{Fisheye, None};
    [
        Model::new("SIMPLE_PINHOLE", None, "f cx cy"),
        Model::new("PINHOLE", None, "fx fy cx cy"),
        Model::new("SIMPLE_RADIAL", None, "f cx cy k1"),
        Model::new("RADIAL", None, "f cx cy k1 k2"),
        Model::new("OPENCV", None, "fx fy cx cy k1 k2 p1 p2"),
        Model::new("OPENCV_FISHEYE", Fisheye, "fx fy cx cy k1 k2 k3 k4"),
        Model::new("FULL_OPENCV", None, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
        Model::new("FOV", None, "fx fy cx cy fov"),
        Model::new("SIMPLE_RADIAL_FISHEYE", Fisheye, "f cx cy k1"),
        Model::new("RADIAL_FISHEYE", Fisheye, "f cx cy k1 k2"),
        Model::new(
            "THIN_PRISM_FISHEYE",
            Fisheye,
            "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2",
        ),
    ]
};

/// Returns the number of images that the model in a folder registers; 0 if it cannot be read.
pub fn registered_count(folder: &Path) -> usize {
    registered(folder).map_or(0, |(_, images)| images.len())
}

/// Returns the path of a file of the model, and whether the model is binary.
fn file(folder: &Path, name: &str) -> (PathBuf, bool) {
    let binary = folder.join("cameras.bin").is_file();
    (
        folder.join(format!("{name}.{}", if binary { "bin" } else { "txt" })),
        binary,
    )
}

/// Reads the images of the model. Also returns the path of the file that lists them.
fn registered(folder: &Path) -> Result<(PathBuf, Vec<Registered>)> {
    let (path, binary) = file(folder, "images");
    let images = if binary {
        images_bin(&path)?
    } else {
        images_txt(&path)?
    };
    Ok((path, images))
}

/// Reads the model in `folder` and finds its photos in `album`. Image names are relative to `base`.
///
/// # Errors
/// Missing or truncated files, unknown camera models, and fields that are not numbers.
pub fn load(album: &Album, base: &Path, folder: &Path) -> Result<ParsedPoses> {
    let ((cameras, binary), (points, _)) = (file(folder, "cameras"), file(folder, "points3D"));
    let lenses = if binary {
        cameras_bin(&cameras)?
    } else {
        cameras_txt(&cameras)?
    };
    let (images, registered) = registered(folder)?;
    let mut stated = ParsedPoses {
        conventions: PoseConvention::OF_QUATERNIONS.to_vec(),
        ..ParsedPoses::default()
    };
    let names: Vec<String> = registered.iter().map(|image| image.name.clone()).collect();
    let mut missing = Vec::new();
    let mut photo_of = HashMap::new();
    for (image, path) in registered.iter().zip(album.find(&names, base)) {
        let lens = lenses.get(&image.lens).ok_or_else(|| {
            Error::format(&images, format!("image '{}' refers to camera {}, which is missing from {}; export the model again", image.name, image.lens, cameras.display()))
        })?;
        match path {
            Some(path) => {
                photo_of.insert(image.id, stated.photos.len() as u32);
                stated.photos.push(posed(path, image, lens));
            }
            None => missing.push(image.name.clone()),
        }
    }
    if points.is_file() {
        let read = if binary {
            points_bin(&points)?
        } else {
            points_txt(&points)?
        };
        // Some programs write no colours, so that all points are black. Their colours are then
        // sampled from the photos.
        let colorless = read.iter().all(|point| point.color == [0; 3]);
        let seen_in = |point: &Point| {
            point
                .images
                .iter()
                .filter_map(|id| photo_of.get(id).copied())
                .collect()
        };
        stated.track_photos = if colorless {
            read.iter().map(seen_in).collect()
        } else {
            Vec::new()
        };
        stated.points = read
            .into_iter()
            .map(|point| (point.position, point.color))
            .collect();
    }
    stated
        .warnings
        .extend(album.missing(&missing, registered.len(), &images));
    Ok(stated)
}

fn posed(path: PathBuf, image: &Registered, lens: &Lens) -> PosedPhoto {
    PosedPhoto {
        camera: Camera {
            name: String::new(),
            width: lens.width,
            height: lens.height,
            fx: lens.focal[0] as f32,
            fy: lens.focal[1] as f32,
            cx: lens.centre[0] as f32,
            cy: lens.centre[1] as f32,
            world_to_camera: Mat4::IDENTITY,
        },
        raw_pose: RawPose::Quaternion(image.rotation, DVec3::from(image.translation)),
        path,
        distortion: lens.distortion,
        ignore: None,
        upright: false,
    }
}

fn cameras_bin(path: &Path) -> Result<HashMap<u32, Lens>> {
    let data = fs::read(path)?;
    let mut bytes = ByteReader::new(path, &data);
    // Id, model, width and height of a camera take 24 bytes; its parameters follow.
    let count = bytes.count(24)?;
    let mut lenses = HashMap::new();
    for _ in 0..count {
        let (id, model) = (bytes.u32()?, bytes.u32()?);
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        let model = MODELS
            .get(model as usize)
            .ok_or_else(|| Error::format(path, unknown(&format!("number {model}"))))?;
        let parameters = (0..model.count())
            .map(|_| bytes.f64())
            .collect::<Result<Vec<_>>>()?;
        lenses.insert(id, model.lens(width, height, &parameters));
    }
    Ok(lenses)
}

fn images_bin(path: &Path) -> Result<Vec<Registered>> {
    let data = fs::read(path)?;
    let mut bytes = ByteReader::new(path, &data);
    // An image takes at least 73 bytes: id, pose, camera id, end of the name, observation count.
    let count = bytes.count(73)?;
    (0..count)
        .map(|_| {
            let id = bytes.u32()?;
            let mut pose = [0.0; 7];
            for value in &mut pose {
                *value = bytes.f64()?;
            }
            let lens = bytes.u32()?;
            let name = bytes.c_string()?.to_owned();
            // An observation has 24 bytes: x and y (f64), and the id of its point (u64).
            let observations = bytes.count(24)?;
            bytes.take(observations * 24)?;
            let [w, x, y, z, tx, ty, tz] = pose;
            Ok(Registered {
                id,
                rotation: [w, x, y, z],
                translation: [tx, ty, tz],
                lens,
                name,
            })
        })
        .collect()
}

fn points_bin(path: &Path) -> Result<Vec<Point>> {
    let data = fs::read(path)?;
    let mut bytes = ByteReader::new(path, &data);
    // A point takes at least 51 bytes: id, position, colour, reprojection error, track length.
    let count = bytes.count(51)?;
    (0..count)
        .map(|_| {
            bytes.u64()?;
            let position = DVec3::new(bytes.f64()?, bytes.f64()?, bytes.f64()?);
            let rgb = bytes.take(3)?;
            let color = [rgb[0], rgb[1], rgb[2]];
            bytes.f64()?;
            let length = bytes.count(8)?;
            let track = bytes.take(length * 8)?;
            let images = track
                .chunks_exact(8)
                .map(|seen| u32::from_le_bytes([seen[0], seen[1], seen[2], seen[3]]))
                .collect();
            Ok(Point {
                position,
                color,
                images,
            })
        })
        .collect()
}

/// Yields the line number and the fields of each line that is not a comment.
fn rows(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    let lines = text
        .lines()
        .enumerate()
        .filter(|(_, l)| !l.starts_with('#'));
    lines.map(|(i, l)| (i + 1, l.split_whitespace().collect()))
}

/// Returns the error text for a camera model that is not supported.
fn unknown(model: &str) -> String {
    let known: Vec<&str> = MODELS.iter().map(|model| model.name).collect();
    format!(
        "the camera model {model} is not supported; undistort the photos with 'colmap image_undistorter' and use the model that it writes (supported: {})",
        known.join(", ")
    )
}

fn parse<T: std::str::FromStr>(path: &Path, line: usize, fields: &[&str], i: usize) -> Result<T> {
    fields.get(i).and_then(|f| f.parse().ok()).ok_or_else(|| {
        Error::format(
            path,
            format!(
                "line {line}, field {} is not a valid number; export the model again",
                i + 1
            ),
        )
    })
}

fn cameras_txt(path: &Path) -> Result<HashMap<u32, Lens>> {
    let mut lenses = HashMap::new();
    for (line, f) in rows(&text(path)?).filter(|(_, f)| !f.is_empty()) {
        let name = f.get(1).copied().unwrap_or_default();
        let model = MODELS.iter().find(|model| model.name == name);
        let model = model.ok_or_else(|| {
            Error::format(
                path,
                format!("line {line}: {}", unknown(&format!("'{name}'"))),
            )
        })?;
        let n = model.count();
        if f.len() != 4 + n {
            let given = f.len().saturating_sub(4);
            let why = format!(
                "line {line}: the camera model {name} has {n} parameters, but this line has {given}; export the model again"
            );
            return Err(Error::format(path, why));
        }
        let parameters = (0..n)
            .map(|i| parse(path, line, &f, 4 + i))
            .collect::<Result<Vec<f64>>>()?;
        let (width, height) = (parse(path, line, &f, 2)?, parse(path, line, &f, 3)?);
        lenses.insert(
            parse(path, line, &f, 0)?,
            model.lens(width, height, &parameters),
        );
    }
    Ok(lenses)
}

/// Number of fields before the name of an image.
const BEFORE_NAME: usize = 9;

/// Reads `images.txt`: each image is followed by a line of its observations. Some programs omit
/// these lines, or omit them only if they are empty.
fn images_txt(path: &Path) -> Result<Vec<Registered>> {
    let content = text(path)?;
    let mut lines = content
        .lines()
        .enumerate()
        .filter(|(_, line)| !line.starts_with('#'))
        .peekable();
    let mut images = Vec::new();
    while let Some((line, row)) = lines.next() {
        let f: Vec<&str> = row.split_whitespace().collect();
        if f.is_empty() {
            continue;
        }
        let line = line + 1;
        let number = |i| parse::<f64>(path, line, &f, i);
        images.push(Registered {
            id: parse(path, line, &f, 0)?,
            rotation: [number(1)?, number(2)?, number(3)?, number(4)?],
            translation: [number(5)?, number(6)?, number(7)?],
            lens: parse(path, line, &f, 8)?,
            name: name_of(row).ok_or_else(|| {
                Error::format(
                    path,
                    format!(
                        "line {line}: the name of the image is missing; export the model again"
                    ),
                )
            })?,
        });
        lines.next_if(|(_, next)| is_observations(next));
    }
    Ok(images)
}

/// Returns the name at the end of an image's line. It may contain spaces.
fn name_of(row: &str) -> Option<String> {
    let mut rest = row.trim();
    for _ in 0..BEFORE_NAME {
        rest = rest.split_once(char::is_whitespace)?.1.trim_start();
    }
    Some(rest.to_owned()).filter(|name| !name.is_empty())
}

/// Returns whether a line lists observations: zero or more triples (x, y, point id). A line of an
/// image has ten fields or a name that is not a number.
fn is_observations(line: &str) -> bool {
    let fields: Vec<&str> = line.split_whitespace().collect();
    fields.len().is_multiple_of(3) && fields.iter().all(|field| field.parse::<f64>().is_ok())
}

fn points_txt(path: &Path) -> Result<Vec<Point>> {
    rows(&text(path)?)
        .filter(|(_, f)| !f.is_empty())
        .map(|(line, f)| {
            let number = |i| parse::<f64>(path, line, &f, i);
            let byte = |i| parse::<u8>(path, line, &f, i);
            // The reprojection error (field 7) is followed by pairs of image id and key point
            // index.
            let images = f
                .get(8..)
                .unwrap_or_default()
                .iter()
                .step_by(2)
                .filter_map(|id| id.parse().ok())
                .collect();
            Ok(Point {
                position: DVec3::new(number(1)?, number(2)?, number(3)?),
                color: [byte(4)?, byte(5)?, byte(6)?],
                images,
            })
        })
        .collect()
}
