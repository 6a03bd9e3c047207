//! Segment Anything (Kirillov et al. 2023) from ONNX exports: automatic mask generation by a grid of point prompts.
//!
//! Three families of exports are told apart by the names of their inputs: the official one (also MobileSAM's and others'
//! with the same decoder), EfficientSAM's, and that of transformers.js.

use crate::masks::{Mask, box_iou, paint};
use crate::runtime::{Array, Model};
use crate::segmenter::{Level, Segmentation, Segmenter};
use crate::{Error, Result};
use fastlgs_core::image_io;
use image::RgbImage;
use std::path::Path;

/// Constants of mask generation; the defaults are those of the original.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Point prompts along each side of the photo.
    pub points_per_side: u32,
    /// Least IoU that the model predicts for its own mask.
    pub predicted_iou: f32,
    /// Least IoU of the masks cut at logits of plus and minus one.
    pub stability: f32,
    /// IoU of boxes from which the worse of two masks is dropped.
    pub box_nms: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self { points_per_side: 32, predicted_iou: 0.88, stability: 0.95, box_nms: 0.7 }
    }
}

/// Prompts in one inference.
const BATCH: usize = 64;
/// Longer side of the photo that the models were trained on.
const SIDE: usize = 1024;
/// Side of the low-resolution masks.
const LOW: usize = 256;
/// Mean and standard deviation of the training photos, RGB in [0, 255].
const MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const DEVIATION: [f32; 3] = [58.395, 57.12, 57.375];
/// Masks at logits of plus and minus this are compared for stability.
const STABILITY_OFFSET: f32 = 1.0;
/// Holes and islands below this share of the photo are removed.
const SPECK: f32 = 2e-4;
/// Mask IoU from which a mask of a finer level is the same as one of a coarser level.
const SAME: f32 = 0.9;

/// How a decoder is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Export {
    /// `point_coords`, `point_labels`, `mask_input`, `has_mask_input`, `orig_im_size`; points on the padded photo.
    Official,
    /// `batched_point_coords`, `batched_point_labels`, `orig_im_size`; points on the photo itself.
    Efficient,
    /// `input_points`, `input_labels`, `image_positional_embeddings`; points on the padded photo.
    Transformers,
}

/// Image encoder and prompt decoder.
pub struct Sam {
    encoder: Model,
    decoder: Model,
    export: Export,
    config: Config,
}

/// An encoded photo.
struct Encoded {
    /// What the encoder gave, by the decoder's names.
    embeddings: Vec<(&'static str, Array)>,
    /// Pixels of the photo along x and y, and of the photo as the points see it.
    photo: [f32; 2],
    prompted: [f32; 2],
}

/// A mask that passed the filters, in low resolution.
struct Candidate {
    level: Level,
    score: f32,
    /// Bounding box of positive logits.
    bounds: [u32; 4],
    /// Logits of the box, widened by a pixel.
    window: Window,
}

/// A rectangle cut from a grid of logits that covers some pixels of the photo per cell.
struct Window {
    left: usize,
    top: usize,
    width: usize,
    logits: Vec<f32>,
    /// Cells per pixel of the photo along x and y.
    scale: [f32; 2],
}

impl Sam {
    /// Loads an encoder and the decoder that belongs to it.
    ///
    /// # Errors
    /// When a file is missing or of no known kind.
    pub fn load(encoder: &Path, decoder: &Path, config: Config) -> Result<Self> {
        let (encoder, decoder) = (Model::load(encoder)?, Model::load(decoder)?);
        let has = |name: &str| decoder.input(&[name]).is_some();
        let export = if has("batched_point_coords") {
            Export::Efficient
        } else if has("input_points") {
            Export::Transformers
        } else if has("point_coords") {
            Export::Official
        } else {
            let names: Vec<&str> = decoder.inputs.iter().map(|i| i.name.as_str()).collect();
            return Err(decoder.refuse(format!("no known SAM decoder: its inputs are {}", names.join(", "))));
        };
        if encoder.inputs.len() != 1 {
            return Err(encoder.refuse("no SAM image encoder: it has more than one input"));
        }
        Ok(Self { encoder, decoder, export, config })
    }

    fn encode(&self, photo: &RgbImage) -> Result<Encoded> {
        let slot = &self.encoder.inputs[0];
        let (w, h) = (photo.width() as f32, photo.height() as f32);
        let (input, prompted) = match slot.shape.as_slice() {
            _ if self.export == Export::Efficient => (planar(photo, [0.0; 3], [255.0; 3], None), [w, h]),
            // Rows, columns, colours: such encoders normalise and pad by themselves.
            [_, _, Some(3)] => {
                let small = scaled(photo, SIDE);
                let values = small.as_raw().iter().map(|v| f32::from(*v)).collect();
                (Array::new([small.height() as usize, small.width() as usize, 3], values), size_of(&small))
            }
            [_, Some(3), rows, _] => {
                let side = rows.unwrap_or(SIDE);
                let small = scaled(photo, side);
                let prompted = size_of(&small);
                (planar(&small, MEAN, DEVIATION, Some(side)), prompted)
            }
            shape => return Err(self.encoder.refuse(format!("its input '{}' has shape {shape:?}, not that of a photo", slot.name))),
        };
        let embedding = self.encoder.output(&["image_embeddings", "image_embedding", "embeddings", "output"]);
        let embedding = embedding.or(self.encoder.outputs.first().map(String::as_str)).unwrap_or_default();
        let mut wanted = vec![("image_embeddings", embedding)];
        if self.export == Export::Transformers {
            wanted.push(("image_positional_embeddings", "image_positional_embeddings"));
        }
        let outputs: Vec<&str> = wanted.iter().map(|w| w.1).collect();
        let found = self.encoder.run(vec![(slot.name.as_str(), input)], &outputs)?;
        Ok(Encoded { embeddings: wanted.iter().map(|w| w.0).zip(found).collect(), photo: [w, h], prompted })
    }

    /// Logits `[prompt][mask][rows][columns]` and predicted IoU `[prompt][mask]` for points given as shares of the photo;
    /// and whether the logits cover the photo alone (not the padded square).
    fn decode(&self, encoded: &Encoded, points: &[[f32; 2]]) -> Result<(Array, Vec<f32>, bool)> {
        let n = points.len();
        let on_photo: Vec<[f32; 2]> = points.iter().map(|p| [p[0] * encoded.prompted[0], p[1] * encoded.prompted[1]]).collect();
        let mut inputs: Vec<(&str, Array)> = encoded.embeddings.iter().map(|(name, a)| (*name, a.clone())).collect();
        let flat = || on_photo.iter().flatten().copied();
        match self.export {
            Export::Official => {
                // A point without box is followed by a padding point of label -1.
                let coordinates = on_photo.iter().flat_map(|p| [p[0], p[1], 0.0, 0.0]).collect();
                let labels = (0..n).flat_map(|_| [1.0, -1.0]).collect();
                // The size of the masks in full resolution, which are not used: as small as can be.
                let [w, h] = encoded.prompted.map(|v| (v * LOW as f32 / SIDE as f32).ceil());
                inputs.extend([
                    ("point_coords", Array::new([n, 2, 2], coordinates)),
                    ("point_labels", Array::new([n, 2], labels)),
                    ("mask_input", Array::new([1, 1, LOW, LOW], vec![0.0; LOW * LOW])),
                    ("has_mask_input", Array::new([1], vec![0.0])),
                    ("orig_im_size", Array::new([2], vec![h, w])),
                ]);
            }
            Export::Efficient => inputs.extend([
                ("batched_point_coords", Array::new([1, n, 1, 2], flat().collect())),
                ("batched_point_labels", Array::new([1, n, 1], vec![1.0; n])),
                ("orig_im_size", Array::new([2], vec![encoded.photo[1], encoded.photo[0]])),
            ]),
            Export::Transformers => inputs.extend([
                ("input_points", Array::new([1, n, 1, 2], flat().collect())),
                ("input_labels", Array::new([1, n, 1], vec![1.0; n])),
            ]),
        }
        inputs.retain(|(name, _)| self.decoder.input(&[name]).is_some());
        let find =
            |names: &[&str], what: &str| self.decoder.output(names).ok_or_else(|| self.decoder.refuse(format!("it gives no {what}")));
        let masks = find(&["low_res_masks", "pred_masks", "output_masks", "masks"], "masks")?;
        let scores = find(&["iou_predictions", "iou_scores"], "predicted IoU")?;
        let mut found = self.decoder.run(inputs, &[masks, scores])?;
        let (scores, logits) = (found.remove(1).values, found.remove(0));
        let [.., count, rows, columns] = logits.shape[..] else {
            return Err(self.decoder.refuse(format!("its masks have shape {:?}", logits.shape)));
        };
        if scores.len() != n * count || logits.values.len() != n * count * rows * columns {
            return Err(self.decoder.refuse(format!("{n} prompts gave masks of shape {:?} and {} scores", logits.shape, scores.len())));
        }
        let photo_only = self.export == Export::Efficient || masks == "masks";
        Ok((Array::new([n, count, rows, columns], logits.values), scores, photo_only))
    }

    /// Prompts that every inference of an export with a fixed batch takes.
    fn fixed_batch(&self) -> Option<usize> {
        let points = self.decoder.input(&["point_coords", "batched_point_coords", "input_points"])?;
        let prompts = if self.export == Export::Official { 0 } else { 1 };
        *points.shape.get(prompts)?
    }

    /// All masks of a photo that pass the filters, in low resolution.
    fn candidates(&self, photo: &RgbImage) -> Result<Vec<Candidate>> {
        let encoded = self.encode(photo)?;
        let n = self.config.points_per_side;
        let at = |k: u32| (k as f32 + 0.5) / n as f32;
        let grid: Vec<[f32; 2]> = (0..n).flat_map(|y| (0..n).map(move |x| [at(x), at(y)])).collect();
        let mut out = Vec::new();
        let batch = self.fixed_batch();
        for points in grid.chunks(batch.unwrap_or(BATCH)) {
            let mut asked = points.to_vec();
            asked.resize(batch.unwrap_or(points.len()), points[0]);
            let (logits, scores, photo_only) = self.decode(&encoded, &asked)?;
            let [_, count, rows, columns] = logits.shape[..] else { unreachable!("decode checks the shape") };
            // Cells that show the photo, and cells per pixel of it.
            let shown = if photo_only {
                [columns as f32, rows as f32]
            } else {
                let long = encoded.prompted[0].max(encoded.prompted[1]);
                [0, 1].map(|k| [columns, rows][k] as f32 * encoded.prompted[k] / long)
            };
            let scale = [shown[0] / encoded.photo[0], shown[1] / encoded.photo[1]];
            let shown = shown.map(|v| v.ceil() as usize);
            for (prompt, own) in logits.values.chunks_exact(count * rows * columns).take(points.len()).enumerate() {
                // Of four masks the first is meant for prompts of several points.
                let skipped = usize::from(count == 4);
                let mut masks: Vec<(usize, f32, &[f32])> = own
                    .chunks_exact(rows * columns)
                    .enumerate()
                    .skip(skipped)
                    .map(|(k, m)| (area(m, columns, shown, 0.0), scores[prompt * count + k], m))
                    .collect();
                masks.sort_by_key(|m| std::cmp::Reverse(m.0));
                for ((area_, score, mask), level) in masks.into_iter().zip(Level::ALL) {
                    let stable = area(mask, columns, shown, STABILITY_OFFSET) as f32;
                    let stability = stable / area(mask, columns, shown, -STABILITY_OFFSET).max(1) as f32;
                    if area_ > 0 && score >= self.config.predicted_iou && stability >= self.config.stability {
                        out.push(candidate(level, score, mask, columns, shown, scale));
                    }
                }
            }
        }
        Ok(out)
    }
}

/// Cells of the shown part above a threshold.
fn area(logits: &[f32], columns: usize, shown: [usize; 2], threshold: f32) -> usize {
    let rows = logits.chunks_exact(columns).take(shown[1]);
    rows.map(|row| row[..shown[0].min(columns)].iter().filter(|v| **v > threshold).count()).sum()
}

/// Cuts out what is above zero, with a margin for interpolation.
fn candidate(level: Level, score: f32, logits: &[f32], columns: usize, shown: [usize; 2], scale: [f32; 2]) -> Candidate {
    let [width, height] = [shown[0].min(columns), shown[1].min(logits.len() / columns)];
    let mut b = [usize::MAX, usize::MAX, 0, 0];
    for y in 0..height {
        for x in (0..width).filter(|x| logits[y * columns + x] > 0.0) {
            b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
        }
    }
    let (left, top) = (b[0].saturating_sub(1), b[1].saturating_sub(1));
    let (right, bottom) = ((b[2] + 1).min(width), (b[3] + 1).min(height));
    let cut = (top..bottom).flat_map(|y| logits[y * columns + left..y * columns + right].iter().copied()).collect();
    let window = Window { left, top, width: right - left, logits: cut, scale };
    Candidate { level, score, bounds: b.map(|v| v as u32), window }
}

impl Window {
    /// The logit at the centre of a pixel of the photo, bilinear between cells.
    fn at(&self, x: u32, y: u32) -> f32 {
        let height = self.logits.len() / self.width;
        let place = |pixel: u32, scale: f32, first: usize, count: usize| {
            let v = ((pixel as f32 + 0.5) * scale - 0.5 - first as f32).clamp(0.0, (count - 1) as f32);
            (v as usize, (v as usize + 1).min(count - 1), v.fract())
        };
        let (x0, x1, fx) = place(x, self.scale[0], self.left, self.width);
        let (y0, y1, fy) = place(y, self.scale[1], self.top, height);
        let row = |y: usize| self.logits[y * self.width + x0] * (1.0 - fx) + self.logits[y * self.width + x1] * fx;
        row(y0) * (1.0 - fy) + row(y1) * fy
    }

    /// The mask at the photo's size.
    fn mask(&self, photo: [u32; 2]) -> Option<Mask> {
        let height = self.logits.len() / self.width;
        let pixel = |cell: usize, k: usize| ((cell as f32 / self.scale[k]) as u32).min(photo[k]);
        let ends = [pixel(self.left + self.width, 0) + 1, pixel(self.top + height, 1) + 1];
        let bounds = [pixel(self.left, 0), pixel(self.top, 1), ends[0].min(photo[0]), ends[1].min(photo[1])];
        Mask::of(bounds, |x, y| self.at(x, y) > 0.0)
    }
}

/// Of overlapping boxes of one level only the best stays.
fn suppressed(mut candidates: Vec<Candidate>, box_nms: f32) -> Vec<Candidate> {
    // Stable: of equal scores the earlier prompt wins.
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<Candidate> = Vec::new();
    for c in candidates {
        if !kept.iter().any(|k| k.level == c.level && box_iou(k.bounds, c.bounds) > box_nms) {
            kept.push(c);
        }
    }
    kept
}

impl Segmenter for Sam {
    fn name(&self) -> &'static str {
        "sam"
    }

    fn segment(&self, _view: &str, photo: &RgbImage) -> Result<Segmentation> {
        let size = [photo.width(), photo.height()];
        let least = (SPECK * (size[0] * size[1]) as f32) as usize;
        let mut levels: [Vec<Mask>; 3] = Default::default();
        for candidate in suppressed(self.candidates(photo)?, self.config.box_nms) {
            if let Some(mask) = candidate.window.mask(size).and_then(|m| m.without_specks(least)) {
                levels[candidate.level as usize].push(mask);
            }
        }
        for level in 1..levels.len() {
            let (coarser, finer) = levels.split_at_mut(level);
            finer[0].retain(|m| !coarser.iter().flatten().any(|c| box_iou(c.bounds, m.bounds) > 0.5 && c.iou(m) > SAME));
        }
        if levels.iter().all(Vec::is_empty) {
            return Err(Error::Invalid("SAM found no mask; are encoder and decoder of one model?".to_owned()));
        }
        Ok(Segmentation { levels: levels.map(|masks| paint(&masks, size[0], size[1])) })
    }
}

fn size_of(photo: &RgbImage) -> [f32; 2] {
    [photo.width() as f32, photo.height() as f32]
}

/// The photo with its longer side at `side`.
fn scaled(photo: &RgbImage, side: usize) -> RgbImage {
    let scale = side as f32 / photo.width().max(photo.height()) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    image_io::resize(photo, size(photo.width()), size(photo.height()))
}

/// `[1][3][rows][columns]`, normalised; padded with zeros to the right and below where a side is given.
fn planar(photo: &RgbImage, mean: [f32; 3], deviation: [f32; 3], side: Option<usize>) -> Array {
    let (w, h) = (photo.width() as usize, photo.height() as usize);
    let (columns, rows) = side.map_or((w, h), |s| (s, s));
    let mut values = vec![0.0; 3 * rows * columns];
    for (x, y, pixel) in photo.enumerate_pixels() {
        for k in 0..3 {
            values[(k * rows + y as usize) * columns + x as usize] = (f32::from(pixel[k]) - mean[k]) / deviation[k];
        }
    }
    Array::new([1, 3, rows, columns], values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy_models::{self, SamExport};
    use image::Rgb;

    const GRAY: [u8; 3] = [90, 90, 90];
    const RED: [u8; 3] = [220, 20, 20];
    const DARK_RED: [u8; 3] = [150, 15, 15];
    const BLUE: [u8; 3] = [20, 20, 230];

    /// A red thing with a dark part, and a blue thing with a hole of one pixel, on grey.
    fn photo() -> RgbImage {
        RgbImage::from_fn(120, 80, |x, y| {
            Rgb(match (x, y) {
                (20..32, 20..32) => DARK_RED,
                (10..60, 10..50) => RED,
                (90, 60) => GRAY,
                (70..110, 40..70) => BLUE,
                _ => GRAY,
            })
        })
    }

    fn sam(export: SamExport, config: Config) -> Option<(tempfile::TempDir, Sam)> {
        let dir = tempfile::tempdir().unwrap();
        let (encoder, decoder) = (dir.path().join("encoder.onnx"), dir.path().join("decoder.onnx"));
        toy_models::sam(export, &encoder, &decoder);
        if let Err(e) = crate::places::runtime_library() {
            assert!(std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(), "{e}");
            eprintln!("SKIPPED: {e}");
            return None;
        }
        Some((dir, Sam::load(&encoder, &decoder, config).unwrap()))
    }

    /// IoU of the best label.
    fn agree(map: &fastlgs_core::LabelMap, member: impl Fn(u32, u32) -> bool) -> f32 {
        let best = (1..=map.max()).map(|l| {
            let (mut common, mut either) = (0.0, 0.0);
            for (x, y) in (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y))) {
                let (a, b) = (map.at(x, y) == l, member(x, y));
                common += f32::from(u8::from(a && b));
                either += f32::from(u8::from(a || b));
            }
            common / f32::max(either, 1.0)
        });
        best.fold(0.0, f32::max)
    }

    #[test]
    fn every_export_gives_the_same_masks_at_their_levels() {
        let config = Config { points_per_side: 12, ..Config::default() };
        let exports =
            [SamExport::Official { batched: true }, SamExport::Official { batched: false }, SamExport::Efficient, SamExport::Transformers];
        for export in exports {
            let Some((_dir, sam)) = sam(export, config) else { return };
            let [whole, part, subpart] = sam.segment("", &photo()).unwrap().levels;
            let red = |x: u32, y: u32| (10..60).contains(&x) && (10..50).contains(&y);
            let blue = |x: u32, y: u32| (70..110).contains(&x) && (40..70).contains(&y);
            let dark = |x: u32, y: u32| (20..32).contains(&x) && (20..32).contains(&y);
            // Interpolated borders of half-resolution masks cost a row of pixels; the hole is filled.
            assert!(agree(&whole, red) > 0.9, "{export:?}: {}", agree(&whole, red));
            assert!(agree(&whole, blue) > 0.9, "{export:?}: {}", agree(&whole, blue));
            assert!(agree(&whole, dark) < 0.5, "{export:?}: the part is no whole");
            assert!(agree(&part, dark) > 0.75, "{export:?}: {}", agree(&part, dark));
            assert_eq!(part.at(100, 50), 0, "{export:?}: a part that is the whole is not repeated");
            assert_eq!(subpart.at(100, 50), 0, "{export:?}: nor is a subpart");
        }
    }

    #[test]
    fn filters_drop_what_the_model_doubts() {
        let config = Config { points_per_side: 4, predicted_iou: 0.99, ..Config::default() };
        let Some((_dir, sam)) = sam(SamExport::Transformers, config) else { return };
        assert!(sam.segment("", &photo()).err().unwrap().to_string().contains("no mask"));
    }

    #[test]
    fn other_models_are_refused_by_name() {
        let Some((dir, _)) = sam(SamExport::Transformers, Config::default()) else { return };
        let encoder = dir.path().join("encoder.onnx");
        let error = Sam::load(&encoder, &encoder, Config::default()).err().unwrap().to_string();
        assert!(error.contains("encoder.onnx") && error.contains("pixel_values"), "{error}");
        let missing = Sam::load(&dir.path().join("none.onnx"), &encoder, Config::default()).err().unwrap().to_string();
        assert!(missing.contains("none.onnx") && missing.contains("models pull"), "{missing}");
    }
}
