//! Reads masks in the formats of annotation programs: COCO, labelme and Label Studio.
//!
//! COCO files contain run lengths or polygons, for one photo or for all, as CVAT and the script of
//! Segment Anything write them.

use super::{Level, Mask, MaskList, RunLengths};
use crate::labels::fill;
use crate::{Error, Result, fs};
use base64::Engine;
use image::GrayImage;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Largest number of pixels of an image. Pixel indices are 32-bit numbers.
const MAX_MASK_PIXELS: u64 = 1 << 31;

/// A file of annotations in any supported format.
#[derive(Deserialize)]
#[serde(untagged)]
enum File {
    Coco {
        annotations: Vec<Annotation>,
        #[serde(default)]
        images: Option<Vec<Image>>,
    },
    Labelme(Labelme),
    LabelStudio(Vec<Task>),
    List(Vec<Annotation>),
}

/// An image of a COCO file.
#[derive(Deserialize)]
struct Image {
    id: i64,
    #[serde(default)]
    file_name: String,
    width: u32,
    height: u32,
}

/// A mask in the format of COCO and Segment Anything.
#[derive(Deserialize)]
struct Annotation {
    segmentation: Segmentation,
    #[serde(default)]
    image_id: Option<i64>,
    #[serde(default)]
    predicted_iou: Option<f32>,
    #[serde(default)]
    stability_score: Option<f32>,
    #[serde(default)]
    level: Option<Level>,
    #[serde(default)]
    track_id: Option<Track>,
    /// CVAT stores the track id here.
    #[serde(default)]
    attributes: Option<Attributes>,
}

#[derive(Deserialize)]
struct Attributes {
    #[serde(default)]
    track_id: Option<Track>,
}

/// Id of an object that is the same in all photos.
#[derive(Deserialize)]
#[serde(untagged)]
enum Track {
    Number(f64),
    Name(String),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Segmentation {
    /// Run lengths of a mask, and its size [height, width].
    Runs { size: [u32; 2], counts: Counts },
    /// Polygons as alternating x and y in pixels.
    Polygons(Vec<Vec<f64>>),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Counts {
    Text(String),
    Numbers(Vec<u32>),
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Labelme {
    shapes: Vec<Shape>,
    image_width: Option<u32>,
    image_height: Option<u32>,
}

#[derive(Deserialize)]
struct Shape {
    #[serde(default)]
    label: String,
    points: Vec<[f64; 2]>,
    #[serde(default)]
    group_id: Option<i64>,
    #[serde(default)]
    shape_type: Option<String>,
    /// A PNG in base64. Its upper left corner is the first point.
    #[serde(default)]
    mask: Option<String>,
}

#[derive(Deserialize)]
struct Task {
    data: BTreeMap<String, serde_json::Value>,
    annotations: Vec<TaskAnnotation>,
}

#[derive(Deserialize)]
struct TaskAnnotation {
    result: Vec<Region>,
}

#[derive(Deserialize)]
struct Region {
    #[serde(default)]
    original_width: u32,
    #[serde(default)]
    original_height: u32,
    #[serde(default)]
    value: Option<Value>,
}

/// A region in per cent of the photo's width and height.
#[derive(Deserialize)]
#[serde(untagged)]
enum Value {
    Polygon {
        points: Vec<[f64; 2]>,
    },
    Ellipse {
        x: f64,
        y: f64,
        #[serde(rename = "radiusX")]
        rx: f64,
        #[serde(rename = "radiusY")]
        ry: f64,
        #[serde(default)]
        rotation: f64,
    },
    Rectangle {
        x: f64,
        y: f64,
        width: f64,
        height: f64,
        #[serde(default)]
        rotation: f64,
    },
    Brush {
        rle: Vec<u8>,
    },
    Other(serde::de::IgnoredAny),
}

/// Number of corners of the polygon that approximates a circle or ellipse.
const CORNERS: usize = 64;

/// Returns whether a file name in an annotation refers to the photo of a view. Ignores folders,
/// extension and case. Also accepts the prefix of Label Studio: eight characters and a hyphen.
fn is_name_of_view(name: &str, view: &str) -> bool {
    let bare = |name: &str| {
        let own = name
            .rsplit(['/', '\\'])
            .next()
            .unwrap_or(name)
            .to_lowercase();
        Path::new(&own)
            .file_stem()
            .map_or(own.clone(), |stem| stem.to_string_lossy().into_owned())
    };
    // If file names are not unique, names of views contain the folder: `left_1.jpg`.
    let joined = name.replace(['/', '\\'], "_");
    if bare(&joined) == bare(view)
        || joined
            .to_lowercase()
            .ends_with(&format!("_{}", view.to_lowercase()))
    {
        return true;
    }
    let (name, view) = (bare(name), bare(view));
    name == view
        || name
            .strip_suffix(view.as_str())
            .is_some_and(|code| code.len() == 9 && code.ends_with('-'))
}

/// Reads the masks of a photo from a file of annotations; `None` if the file is for other photos.
///
/// Without `view`, takes the first photo of the file. `sides` are the width and height of the
/// photo, for annotations without a size. The list of a file without masks has size 0x0.
///
/// # Errors
/// A missing or damaged file, an unsupported shape, or masks of different or invalid sizes.
pub fn load(
    path: &Path,
    view: Option<&str>,
    sides: Option<(u32, u32)>,
) -> Result<Option<MaskList>> {
    let text = fs::read(path)?;
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&text);
    let known = "supported formats: COCO with run lengths or polygons, labelme, Label Studio";
    let file = serde_json::from_slice(text)
        .map_err(|e| Error::format(path, format!("not the expected JSON: {e}; {known}")))?;
    match file {
        File::List(list) => coco(path, list.iter(), None, sides).map(Some),
        File::Coco {
            annotations,
            images: None,
        } => coco(path, annotations.iter(), None, sides).map(Some),
        File::Coco {
            annotations,
            images: Some(images),
        } => {
            let own = images
                .iter()
                .find(|image| view.is_none_or(|view| is_name_of_view(&image.file_name, view)));
            let Some(image) = own else { return Ok(None) };
            let of_image = annotations
                .iter()
                .filter(|a| a.image_id.is_none_or(|id| id == image.id));
            coco(path, of_image, Some((image.width, image.height)), sides).map(Some)
        }
        File::Labelme(file) => labelme(path, &file, sides).map(Some),
        File::LabelStudio(tasks) if tasks.is_empty() => Ok(Some(MaskList::default())),
        File::LabelStudio(tasks) => {
            let names = |task: &&Task| {
                task.data.values().any(|value| {
                    value
                        .as_str()
                        .is_some_and(|name| view.is_none_or(|view| is_name_of_view(name, view)))
                })
            };
            tasks
                .iter()
                .find(names)
                .map(|task| label_studio(path, task))
                .transpose()
        }
    }
}

fn check_size(path: &Path, width: u32, height: u32) -> Result<()> {
    if (1..=MAX_MASK_PIXELS).contains(&(u64::from(width) * u64::from(height))) {
        return Ok(());
    }
    Err(Error::format(
        path,
        format!(
            "{width}x{height} pixels is not a valid mask size; set the size of the photo in the file"
        ),
    ))
}

/// Reads the masks of COCO annotations. Their size is that of the run lengths, else the size in the
/// list of images, else that of the photo.
fn coco<'a>(
    path: &Path,
    annotations: impl Iterator<Item = &'a Annotation> + Clone,
    stated: Option<(u32, u32)>,
    sides: Option<(u32, u32)>,
) -> Result<MaskList> {
    let of_runs = |annotation: &Annotation| match annotation.segmentation {
        Segmentation::Runs {
            size: [height, width],
            ..
        } => Some((width, height)),
        Segmentation::Polygons(_) => None,
    };
    let Some(first) = annotations.clone().next() else {
        return Ok(MaskList::default());
    };
    let size = of_runs(first).or(stated).or(sides);
    let (width, height) = size.ok_or_else(|| {
        Error::format(
            path,
            "polygons need the size of the photo; export the file with its list of images",
        )
    })?;
    check_size(path, width, height)?;
    let mut list = MaskList::new(width, height);
    for (k, annotation) in annotations.enumerate() {
        let runs = runs_of(&annotation.segmentation, width, height)
            .map_err(|reason| Error::format(path, format!("mask {k} {reason}")))?;
        let attributes = annotation.attributes.as_ref();
        let track = annotation.track_id.as_ref();
        let track = track.or(attributes.and_then(|a| a.track_id.as_ref()));
        list.masks.push(Mask {
            level: annotation.level.unwrap_or_default(),
            predicted_iou: annotation.predicted_iou.unwrap_or(1.0),
            stability: annotation.stability_score.unwrap_or(1.0),
            track: track.and_then(track_number),
            runs,
        });
    }
    Ok(list)
}

/// Returns the pixels of an annotation in a photo of this size, or why they cannot be read.
fn runs_of(segmentation: &Segmentation, width: u32, height: u32) -> Result<RunLengths, String> {
    match segmentation {
        Segmentation::Runs { size, .. } if *size != [height, width] => Err(format!(
            "has {}x{} pixels, but the first mask has {width}x{height}; export all masks in one size",
            size[1], size[0]
        )),
        Segmentation::Runs { counts, .. } => {
            let pixels = u64::from(width) * u64::from(height);
            let runs = match counts {
                Counts::Text(text) => RunLengths::from_text(text, pixels),
                Counts::Numbers(counts) => RunLengths::from_counts(counts.clone(), pixels),
            };
            runs.ok_or_else(|| {
                format!(
                    "has run lengths that do not add up to {width}x{height} pixels; export it again"
                )
            })
        }
        Segmentation::Polygons(polygons) => {
            let corners = |flat: &Vec<f64>| flat.as_chunks::<2>().0.to_vec();
            let polygons: Vec<_> = polygons.iter().map(corners).collect();
            Ok(rasterize_union(&polygons, width, height))
        }
    }
}

/// Returns the id of a track: its number, or the 32-bit FNV-1a hash of its name. Negative numbers
/// mean no track.
fn track_number(track: &Track) -> Option<u32> {
    match track {
        Track::Number(number) => {
            (*number >= 0.0 && *number <= f64::from(u32::MAX)).then_some(*number as u32)
        }
        Track::Name(name) => match name.trim().parse::<i64>() {
            Ok(number) => u32::try_from(number).ok(),
            Err(_) => Some(name.bytes().fold(0x811c_9dc5, |hash: u32, byte| {
                (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193)
            })),
        },
    }
}

/// Rasterizes the union of polygons, given in pixels.
fn rasterize_union(polygons: &[Vec<[f64; 2]>], width: u32, height: u32) -> RunLengths {
    let mut inside = vec![false; (width * height) as usize];
    for polygon in polygons {
        let mut own = vec![false; inside.len()];
        fill(polygon, width, height, &mut own);
        inside
            .iter_mut()
            .zip(own)
            .for_each(|(inside, own)| *inside |= own);
    }
    RunLengths::from_fn(width, height, |x, y| inside[(y * width + x) as usize])
}

/// Returns a polygon that approximates an ellipse around `middle`. `rotation` is in degrees.
fn ellipse(middle: [f64; 2], radii: [f64; 2], rotation: f64) -> Vec<[f64; 2]> {
    let (sin, cos) = rotation.to_radians().sin_cos();
    let corner = |k: usize| {
        let angle = std::f64::consts::TAU * k as f64 / CORNERS as f64;
        let (x, y) = (radii[0] * angle.cos(), radii[1] * angle.sin());
        [middle[0] + cos * x - sin * y, middle[1] + sin * x + cos * y]
    };
    (0..CORNERS).map(corner).collect()
}

fn labelme(path: &Path, file: &Labelme, sides: Option<(u32, u32)>) -> Result<MaskList> {
    let size = file.image_width.zip(file.image_height).or(sides);
    let (width, height) = size.ok_or_else(|| {
        Error::format(
            path,
            "the size of the photo is missing; add imageWidth and imageHeight",
        )
    })?;
    check_size(path, width, height)?;
    // Shapes with the same label and group belong to one object.
    type Group<'a> = Option<(&'a str, i64)>;
    let mut objects: Vec<(Group<'_>, Vec<bool>)> = Vec::new();
    for shape in &file.shapes {
        let Some(inside) = shape_pixels(path, shape, width, height)? else {
            continue;
        };
        let group = shape.group_id.map(|group| (shape.label.as_str(), group));
        match objects
            .iter_mut()
            .find(|object| group.is_some() && object.0 == group)
        {
            Some((_, all)) => all
                .iter_mut()
                .zip(inside)
                .for_each(|(all, own)| *all |= own),
            None => objects.push((group, inside)),
        }
    }
    let mask = |(_, inside): (_, Vec<bool>)| {
        Mask::new(
            Level::Whole,
            RunLengths::from_fn(width, height, |x, y| inside[(y * width + x) as usize]),
        )
    };
    Ok(MaskList {
        masks: objects.into_iter().map(mask).collect(),
        ..MaskList::new(width, height)
    })
}

/// Returns the pixels of a labelme shape; `None` for points and lines, which have no area.
fn shape_pixels(path: &Path, shape: &Shape, width: u32, height: u32) -> Result<Option<Vec<bool>>> {
    let mut inside = vec![false; (width * height) as usize];
    let polygon = match (shape.shape_type.as_deref(), shape.points.as_slice()) {
        (None | Some("polygon"), points) => points.to_vec(),
        (Some("rectangle"), [a, b]) => vec![*a, [b[0], a[1]], *b, [a[0], b[1]]],
        (Some("circle"), [middle, edge]) => {
            let radius = (edge[0] - middle[0]).hypot(edge[1] - middle[1]);
            ellipse(*middle, [radius; 2], 0.0)
        }
        (Some("mask"), [corner, ..]) => {
            let picture = shape
                .mask
                .as_deref()
                .and_then(|text| base64::engine::general_purpose::STANDARD.decode(text).ok());
            let picture: Option<GrayImage> = picture
                .and_then(|data| image::load_from_memory(&data).ok())
                .map(|picture| picture.into_luma8());
            let picture = picture.ok_or_else(|| {
                Error::format(
                    path,
                    format!(
                        "the mask of '{}' cannot be read; save it again",
                        shape.label
                    ),
                )
            })?;
            for (x, y, _) in picture.enumerate_pixels().filter(|(_, _, p)| p[0] > 0) {
                let (x, y) = (
                    corner[0] as i64 + i64::from(x),
                    corner[1] as i64 + i64::from(y),
                );
                if (0..i64::from(width)).contains(&x) && (0..i64::from(height)).contains(&y) {
                    inside[(y * i64::from(width) + x) as usize] = true;
                }
            }
            return Ok(Some(inside));
        }
        (Some("point" | "points" | "line" | "linestrip"), _) => return Ok(None),
        (Some(other), _) => {
            return Err(Error::format(
                path,
                format!(
                    "the shape_type '{other}' of '{}' is not supported; draw a polygon instead",
                    shape.label
                ),
            ));
        }
    };
    fill(&polygon, width, height, &mut inside);
    Ok(Some(inside))
}

fn label_studio(path: &Path, task: &Task) -> Result<MaskList> {
    // A task may have several annotations; the last one is used.
    let regions = task
        .annotations
        .last()
        .map(|annotation| annotation.result.as_slice())
        .unwrap_or_default();
    let Some(first) = regions
        .iter()
        .find(|region| region.value.is_some() && region.original_width > 0)
    else {
        return Ok(MaskList::default());
    };
    let (width, height) = (first.original_width, first.original_height);
    check_size(path, width, height)?;
    let mut list = MaskList::new(width, height);
    let pixels = |[x, y]: [f64; 2]| [x / 100.0 * f64::from(width), y / 100.0 * f64::from(height)];
    for value in regions.iter().filter_map(|region| region.value.as_ref()) {
        let polygon = match value {
            Value::Polygon { points } => points.iter().copied().map(pixels).collect(),
            Value::Ellipse {
                x,
                y,
                rx,
                ry,
                rotation,
            } => ellipse(pixels([*x, *y]), pixels([*rx, *ry]), *rotation),
            Value::Rectangle {
                x,
                y,
                width: w,
                height: h,
                rotation,
            } => rectangle(pixels([*x, *y]), pixels([*w, *h]), *rotation),
            Value::Brush { rle } => {
                let runs = brush(rle, width, height).ok_or_else(|| {
                    Error::format(
                        path,
                        "a brush mask cannot be decoded; export as COCO with run lengths",
                    )
                })?;
                list.masks.push(Mask::new(Level::Whole, runs));
                continue;
            }
            // Choices, relations and texts have no pixels.
            Value::Other(_) => continue,
        };
        list.masks.push(Mask::new(
            Level::Whole,
            rasterize_union(&[polygon], width, height),
        ));
    }
    Ok(list)
}

/// Returns the corners of a rectangle that is rotated around its first corner, in degrees.
fn rectangle(corner: [f64; 2], [w, h]: [f64; 2], rotation: f64) -> Vec<[f64; 2]> {
    let (sin, cos) = rotation.to_radians().sin_cos();
    let turned = |[x, y]: [f64; 2]| [corner[0] + cos * x - sin * y, corner[1] + sin * x + cos * y];
    [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]
        .map(turned)
        .to_vec()
}

/// Decodes a brush mask of a photo of this size.
fn brush(rle: &[u8], width: u32, height: u32) -> Option<RunLengths> {
    let alpha = decode_brush(rle).filter(|alpha| alpha.len() == (width * height) as usize)?;
    let is_inside = |x, y| alpha[(y * width + x) as usize] > 127;
    Some(RunLengths::from_fn(width, height, is_inside))
}

/// Decodes the run lengths of Label Studio's brush and returns the alpha channel; `None` if the
/// data are damaged.
///
/// The data are a bit stream, most significant bit first:
/// * 32 bits: number of values (4 for each pixel, RGBA);
/// * 5 bits: number of bits of a value, minus 1;
/// * 4 x 4 bits: number of bits of a length, minus 1, for each of four kinds of lengths;
/// * blocks: 1 bit (1 if one value is repeated, 0 for a list of values), 2 bits with the kind of
///   length, the length minus 1, and the value or values.
fn decode_brush(rle: &[u8]) -> Option<Vec<u8>> {
    let mut at = 0;
    let mut take = |bits: usize| -> Option<u32> {
        let value = (0..bits).try_fold(0u32, |value, k| {
            let place = at + k;
            let bit = rle.get(place / 8)? >> (7 - place % 8) & 1;
            Some(value << 1 | u32::from(bit))
        })?;
        at += bits;
        Some(value)
    };
    let count = take(32)? as usize;
    let word = take(5)? as usize + 1;
    let mut sizes = [0; 4];
    for size in &mut sizes {
        *size = take(4)? as usize + 1;
    }
    let mut out = Vec::new();
    while out.len() < count {
        let repeats = take(1)? == 1;
        let length = {
            let bits = sizes[take(2)? as usize];
            take(bits)? as usize + 1
        };
        if out.len() + length > count {
            return None;
        }
        if repeats {
            let value = take(word)? as u8;
            out.extend(std::iter::repeat_n(value, length));
        } else {
            for _ in 0..length {
                out.push(take(word)? as u8);
            }
        }
    }
    Some(out.chunks_exact(4).map(|rgba| rgba[3]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the areas of the masks in a JSON text for a photo of 10x8 pixels.
    fn areas(text: &str, view: &str) -> Option<Vec<usize>> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.json");
        std::fs::write(&path, text).unwrap();
        load(&path, Some(view), Some((10, 8)))
            .unwrap()
            .map(|list| list.masks.iter().map(|mask| mask.runs.area()).collect())
    }

    const IMAGES: &str = r#""images": [{"id": 3, "file_name": "album/a.jpg", "width": 10, "height": 8}, {"id": 4, "file_name": "B.JPG", "width": 10, "height": 8}]"#;

    #[test]
    fn polygons_of_one_file_for_all_photos() {
        let text = format!(
            r#"{{{IMAGES}, "categories": [], "annotations": [
            {{"id": 1, "image_id": 3, "category_id": 1, "iscrowd": 0, "bbox": null, "area": null, "score": null, "predicted_iou": null,
              "segmentation": [[1, 1, 5, 1, 5, 4, 1, 4], [6, 0, 7, 0, 7, 2, 6, 2]], "attributes": {{"track_id": 7, "occluded": false}}}},
            {{"id": 2, "image_id": 4, "segmentation": {{"size": [8, 10], "counts": [2, 3, 75]}}, "track_id": "cup"}}]}}"#
        );
        assert_eq!(areas(&text, "a.jpg"), Some(vec![14]));
        assert_eq!(areas(&format!("\u{feff}{text}"), "b.png"), Some(vec![3]));
        assert_eq!(areas(&text, "c.jpg"), None);
        assert_eq!(
            areas("[]", "a.jpg"),
            Some(Vec::new()),
            "a photo without masks"
        );
        let folders = text
            .replace("album/a.jpg", "images/left/1.jpg")
            .replace("B.JPG", "images/right/1.jpg");
        assert_eq!(
            (
                areas(&folders, "left_1.jpg"),
                areas(&folders, "right_1.jpg")
            ),
            (Some(vec![14]), Some(vec![3]))
        );
    }

    #[test]
    fn tracks_are_numbers_names_or_none() {
        let text = |track: &str| {
            format!(
                r#"[{{"segmentation": {{"size": [8, 10], "counts": [80]}}, "track_id": {track}}}]"#
            )
        };
        let track = |json: &str| {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("a.json");
            std::fs::write(&path, text(json)).unwrap();
            load(&path, None, None).unwrap().unwrap().masks[0].track
        };
        assert_eq!(
            [
                track("-1"),
                track("null"),
                track("5"),
                track("\"5\""),
                track("\"-1\"")
            ],
            [None, None, Some(5), Some(5), None]
        );
        assert!(
            track("\"cup\"").is_some()
                && track("\"cup\"") == track("\"cup\"")
                && track("\"cup\"") != track("\"cups\"")
        );
    }

    #[test]
    fn shapes_of_labelme() {
        let text = r#"{"version": "5.4.1", "flags": {}, "imagePath": "a.jpg", "imageData": null, "imageHeight": 8, "imageWidth": 10, "shapes": [
            {"label": "box", "points": [[1, 1], [4, 3]], "group_id": null, "shape_type": "rectangle", "flags": {}},
            {"label": "cup", "points": [[5, 1], [8, 1], [8, 4], [5, 4]], "group_id": 1, "shape_type": "polygon", "flags": {}},
            {"label": "cup", "points": [[0, 6], [2, 6], [2, 8], [0, 8]], "group_id": 1, "shape_type": "polygon", "flags": {}},
            {"label": "ball", "points": [[5, 5], [5, 7]], "shape_type": "circle"}, {"label": "way", "points": [[0, 0], [9, 7]], "shape_type": "line"}]}"#;
        let found = areas(text, "a.jpg").unwrap();
        assert_eq!(found[..2], [6, 13]);
        assert!(found.len() == 3 && found[2].abs_diff(12) <= 2, "{found:?}");
    }

    #[test]
    fn regions_of_label_studio() {
        let text = r#"[{"id": 9, "data": {"image": "/data/upload/1/0a1b2c3d-a.jpg"}, "annotations": [{"result": [
            {"type": "polygonlabels", "original_width": 10, "original_height": 8, "value": {"points": [[10, 12.5], [50, 12.5], [50, 50], [10, 50]], "polygonlabels": ["cup"]}},
            {"type": "rectanglelabels", "original_width": 10, "original_height": 8, "value": {"x": 50, "y": 50, "width": 30, "height": 25, "rotation": 0, "rectanglelabels": ["box"]}},
            {"type": "choices", "original_width": 10, "original_height": 8, "value": {"choices": ["good"]}}]}]}]"#;
        assert_eq!(areas(text, "a.jpg"), Some(vec![12, 6]));
        assert_eq!(areas(text, "b.jpg"), None);
    }

    #[test]
    fn brushes_of_label_studio() {
        // Two pixels: a block of four repeated zeros, then a list of four values. Lengths have four
        // bits, values eight.
        let mut bits = String::new();
        let mut put = |value: u32, count: usize| bits.push_str(&format!("{value:0count$b}"));
        put(8, 32);
        put(7, 5);
        (0..4).for_each(|_| put(3, 4));
        for (value, count) in [
            (1, 1),
            (0, 2),
            (3, 4),
            (0, 8),
            (0, 1),
            (0, 2),
            (3, 4),
            (1, 8),
            (2, 8),
            (3, 8),
            (255, 8),
        ] {
            put(value, count);
        }
        let bytes: Vec<u8> = bits
            .as_bytes()
            .chunks(8)
            .map(|b| {
                u8::from_str_radix(&format!("{:0<8}", std::str::from_utf8(b).unwrap()), 2).unwrap()
            })
            .collect();
        assert_eq!(decode_brush(&bytes), Some(vec![0, 255]));
        assert_eq!(decode_brush(&bytes[..8]), None);
    }
}
