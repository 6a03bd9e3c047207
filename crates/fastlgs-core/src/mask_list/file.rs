//! Reads and writes `masks/NAME.json`: the COCO run lengths of Segment Anything's automatic mask
//! script, with a `level` for each mask.

use super::{Level, Mask, MaskList, RunLengths};
use crate::{Error, Result, fs};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Largest number of pixels of an image. Pixel indices are 32-bit numbers.
const MAX_MASK_PIXELS: u64 = 1 << 31;

/// A mask as a COCO annotation.
#[derive(Serialize, Deserialize)]
struct Annotation {
    segmentation: Segmentation,
    #[serde(default)]
    area: f64,
    /// Left, top, width and height in pixels.
    #[serde(default)]
    bbox: [f64; 4],
    #[serde(default = "one")]
    predicted_iou: f32,
    #[serde(default = "one")]
    stability_score: f32,
    #[serde(default)]
    level: Level,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    track_id: Option<u32>,
}

fn one() -> f32 {
    1.0
}

/// Run lengths of a mask, and its size [height, width].
#[derive(Serialize, Deserialize)]
struct Segmentation {
    size: [u32; 2],
    counts: Counts,
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Counts {
    Text(String),
    Numbers(Vec<u32>),
}

/// Content of a file: the list itself, or an object with the list as `annotations`.
#[derive(Deserialize)]
#[serde(untagged)]
enum File {
    List(Vec<Annotation>),
    Named { annotations: Vec<Annotation> },
}

impl MaskList {
    /// Writes the masks as COCO annotations, atomically.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        let annotation = |mask: &Mask| {
            let mut b = [u32::MAX, u32::MAX, 0, 0];
            for p in self.pixel_indices(mask) {
                let (x, y) = (p as u32 % self.width, p as u32 / self.width);
                b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
            }
            let bbox = if b[2] > 0 {
                [b[0], b[1], b[2] - b[0], b[3] - b[1]]
            } else {
                [0; 4]
            };
            Annotation {
                segmentation: Segmentation {
                    size: [self.height, self.width],
                    counts: Counts::Text(mask.runs.to_text()),
                },
                area: mask.runs.area() as f64,
                bbox: bbox.map(f64::from),
                predicted_iou: mask.predicted_iou,
                stability_score: mask.stability,
                level: mask.level,
                track_id: mask.track,
            }
        };
        fs::write_json(path, &self.masks.iter().map(annotation).collect::<Vec<_>>())
    }

    /// Reads COCO annotations with run lengths as text or as numbers. The list of a file without
    /// masks has size 0x0.
    ///
    /// # Errors
    /// A missing or damaged file, or masks of different or invalid sizes.
    pub fn load(path: &Path) -> Result<Self> {
        let annotations = match fs::read_json(path)? {
            File::List(list) | File::Named { annotations: list } => list,
        };
        let [height, width] = annotations.first().map_or([0, 0], |a| a.segmentation.size);
        if !annotations.is_empty()
            && !(1..=MAX_MASK_PIXELS).contains(&(u64::from(width) * u64::from(height)))
        {
            return Err(Error::format(
                path,
                format!("{width}x{height} pixels is not a valid mask size; create the masks again"),
            ));
        }
        let mut list = Self::new(width, height);
        for (k, annotation) in annotations.into_iter().enumerate() {
            let Segmentation { size, counts } = annotation.segmentation;
            if size != [height, width] {
                return Err(Error::format(
                    path,
                    format!(
                        "mask {k} has {}x{} pixels, but the first mask has {width}x{height}; create all masks in one size",
                        size[1], size[0]
                    ),
                ));
            }
            let pixels = u64::from(width) * u64::from(height);
            let runs = match counts {
                Counts::Text(text) => RunLengths::from_text(&text, pixels),
                Counts::Numbers(counts) => RunLengths::from_counts(counts, pixels),
            };
            let runs =
                runs.ok_or_else(|| Error::format(path, format!("the run lengths of mask {k} do not add up to {width}x{height} pixels; create it again")))?;
            let (level, predicted_iou) = (annotation.level, annotation.predicted_iou);
            list.masks.push(Mask {
                level,
                predicted_iou,
                stability: annotation.stability_score,
                track: annotation.track_id,
                runs,
            });
        }
        Ok(list)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.json");
        let mut list = MaskList::new(5, 4);
        let runs = RunLengths::from_fn(5, 4, |x, y| x > 1 && y == 2);
        list.masks = vec![
            Mask {
                level: Level::Part,
                predicted_iou: 0.5,
                stability: 0.25,
                track: Some(7),
                runs,
            },
            Mask::new(Level::Whole, RunLengths::from_fn(5, 4, |_, _| true)),
        ];
        list.save(&path).unwrap();
        assert_eq!(MaskList::load(&path).unwrap(), list);
        let text = std::fs::read_to_string(&path)
            .unwrap()
            .replace([' ', '\n'], "");
        assert!(
            text.contains("\"bbox\":[2.0,2.0,3.0,1.0]") && text.contains("\"area\":3.0"),
            "{text}"
        );
    }

    #[test]
    fn other_programs_files_are_read_and_errors_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.json");
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            MaskList::load(&path)
        };
        let list = load(r#"{"image": {}, "annotations": [{"segmentation": {"size": [2, 3], "counts": [1, 2, 3]}, "id": 4, "area": 2.5}]}"#)
            .unwrap();
        assert_eq!(
            (list.width, list.height, list.masks[0].runs.area()),
            (3, 2, 2)
        );
        assert_eq!(load("[]").unwrap(), MaskList::default());
        for damaged in [
            r#"[{"segmentation": {"size": [2, 3], "counts": [1, 2, 9]}}]"#,
            r#"[{"segmentation": 1}]"#,
            "[",
            r#"{"a": 1}"#,
        ] {
            let error = load(damaged).unwrap_err().to_string();
            assert!(error.contains("a.json"), "{error}");
        }
    }
}
