//! The files that others export from Segment Anything, told apart by the names of what they take.

use crate::runtime::{Array, Model};
use crate::{Error, Result};
use fastlgs_core::image_io;
use image::imageops::{self, FilterType};
use image::{DynamicImage, ImageBuffer, Pixel, RgbImage};
use std::path::Path;

/// Longer side of the picture that the models were trained on.
const SIDE: usize = 1024;
/// Side of the low-resolution masks.
const LOW: usize = 256;
/// Most bytes of masks that one inference may give.
const ANSWER: usize = 64 << 20;
/// Masks that decoders give for a prompt.
const MASKS: usize = 4;
/// Mean and standard deviation of the training pictures, RGB in [0, 255]: those of SAM and of SAM 2 are the same.
const MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const DEVIATION: [f32; 3] = [58.395, 57.12, 57.375];
/// What encoders call their main output.
const EMBEDDING: [&str; 6] = ["image_embeddings", "image_embedding", "image_embed", "embeddings", "output", "image_embeddings.2"];

/// How a decoder is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// `point_coords`, `point_labels`; points on the padded picture. MobileSAM's, EdgeSAM's and others' as well.
    Official,
    /// The same names, and embeddings of several resolutions: the picture is stretched to a square, not padded (SAM 2).
    Stretched,
    /// `batched_point_coords`, `batched_point_labels`; points on the picture itself (EfficientSAM).
    Efficient,
    /// `input_points`, `input_labels`; points on the padded picture, or the stretched one (transformers.js).
    Transformers { stretched: bool },
}

/// An image encoder and the prompt decoder that belongs to it.
pub struct Exports {
    encoder: Model,
    decoder: Model,
    kind: Kind,
    /// The encoder's outputs that the decoder takes, and as what.
    passed: Vec<(String, String)>,
}

/// An encoded picture.
pub struct Encoded {
    /// By the decoder's names.
    embeddings: Vec<(String, Array)>,
    /// Pixels of the picture along x and y.
    pub size: [u32; 2],
    /// And as the points see it.
    prompted: [f32; 2],
}

/// What the decoder says to some prompts.
pub struct Logits {
    /// `[prompt][mask][rows][columns]`.
    pub values: Vec<f32>,
    /// Predicted IoU, `[prompt][mask]`.
    pub scores: Vec<f32>,
    /// Masks a prompt.
    pub masks: usize,
    /// Cells along y and x.
    pub rows: usize,
    pub columns: usize,
    /// Cells that show the picture, along x and y.
    pub shown: [usize; 2],
    /// Cells a pixel of the picture.
    pub scale: [f32; 2],
}

impl Exports {
    /// Loads both.
    ///
    /// # Errors
    /// When a file is missing or of no known kind; an input that nobody knows how to fill is named.
    pub fn load(encoder: &Path, decoder: &Path) -> Result<Self> {
        let (encoder, decoder) = (Model::load(encoder)?, Model::load(decoder)?);
        let has = |name: &str| decoder.input(&[name]).is_some();
        let finer = decoder.inputs.iter().any(|i| i.name.starts_with("high_res_feats") || i.name == "image_embeddings.0");
        let kind = if has("batched_point_coords") {
            Kind::Efficient
        } else if has("input_points") {
            Kind::Transformers { stretched: finer }
        } else if has("point_coords") {
            if finer { Kind::Stretched } else { Kind::Official }
        } else {
            let names: Vec<&str> = decoder.inputs.iter().map(|i| i.name.as_str()).collect();
            return Err(decoder.refuse(format!("no known SAM decoder: its inputs are {}", names.join(", "))));
        };
        if encoder.inputs.len() != 1 {
            return Err(encoder.refuse("no SAM image encoder: it has more than one input"));
        }
        let asked: &[&str] = match kind {
            Kind::Official | Kind::Stretched => &["point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"],
            Kind::Efficient => &["batched_point_coords", "batched_point_labels", "orig_im_size"],
            Kind::Transformers { .. } => &["input_points", "input_labels", "input_boxes"],
        };
        let mut passed = Vec::new();
        for input in decoder.inputs.iter().map(|i| i.name.as_str()).filter(|name| !asked.contains(name)) {
            let named = encoder.output(&[input]).or_else(|| encoder.output(&EMBEDDING).filter(|_| EMBEDDING.contains(&input)));
            // An encoder of one output has no need to name it well.
            let only = encoder.outputs.first().map(String::as_str).filter(|_| encoder.outputs.len() == 1 && EMBEDDING.contains(&input));
            let output = named.or(only).ok_or_else(|| {
                let outputs = encoder.outputs.join(", ");
                decoder.refuse(format!("its input '{input}' is unknown, and the encoder gives only {outputs}; do both belong together?"))
            })?;
            passed.push((input.to_owned(), output.to_owned()));
        }
        Ok(Self { encoder, decoder, kind, passed })
    }

    /// Encodes a picture.
    ///
    /// # Errors
    /// When inference fails, or the encoder takes no picture.
    pub fn encode(&self, picture: &RgbImage) -> Result<Encoded> {
        let slot = &self.encoder.inputs[0];
        let size = [picture.width(), picture.height()];
        let (input, prompted) = match slot.shape.as_slice() {
            _ if self.kind == Kind::Efficient => (planar(picture, [0.0; 3], [255.0; 3], None), size_of(picture)),
            // Rows, columns, colours: such encoders normalise and pad by themselves.
            [_, _, Some(3)] => {
                let small = scaled(picture, SIDE);
                let values = small.as_raw().iter().map(|v| f32::from(*v)).collect();
                (Array::new([small.height() as usize, small.width() as usize, 3], values), size_of(&small))
            }
            [_, Some(3), rows, _] => {
                let side = rows.unwrap_or(SIDE);
                if self.stretched() {
                    // In floats, as the authors of SAM 2 do it; those of SAM stretch in bytes.
                    let exact = DynamicImage::ImageRgb8(picture.clone()).into_rgb32f();
                    let small = imageops::resize(&exact, side as u32, side as u32, FilterType::Triangle);
                    (planar(&small, MEAN.map(|v| v / 255.0), DEVIATION.map(|v| v / 255.0), Some(side)), [side as f32; 2])
                } else {
                    let small = scaled(picture, side);
                    (planar(&small, MEAN, DEVIATION, Some(side)), size_of(&small))
                }
            }
            shape => return Err(self.encoder.refuse(format!("its input '{}' has shape {shape:?}, not that of a picture", slot.name))),
        };
        let outputs: Vec<&str> = self.passed.iter().map(|p| p.1.as_str()).collect();
        let found = self.encoder.run(vec![(slot.name.as_str(), input)], &outputs)?;
        Ok(Encoded { embeddings: self.passed.iter().map(|p| p.0.clone()).zip(found).collect(), size, prompted })
    }

    fn stretched(&self) -> bool {
        matches!(self.kind, Kind::Stretched | Kind::Transformers { stretched: true })
    }

    /// Masks of points given as shares of the picture.
    ///
    /// # Errors
    /// When inference fails, or gives no masks.
    pub fn decode(&self, encoded: &Encoded, points: &[[f32; 2]]) -> Result<Logits> {
        let n = points.len();
        let on_picture: Vec<[f32; 2]> = points.iter().map(|p| [p[0] * encoded.prompted[0], p[1] * encoded.prompted[1]]).collect();
        let mut inputs: Vec<(&str, Array)> = encoded.embeddings.iter().map(|(name, a)| (name.as_str(), a.clone())).collect();
        let flat = || on_picture.iter().flatten().copied();
        match self.kind {
            Kind::Official | Kind::Stretched => {
                // A point without box is followed by a padding point of label -1.
                let coordinates = on_picture.iter().flat_map(|p| [p[0], p[1], 0.0, 0.0]).collect();
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
            Kind::Efficient => inputs.extend([
                ("batched_point_coords", Array::new([1, n, 1, 2], flat().collect())),
                ("batched_point_labels", Array::new([1, n, 1], vec![1.0; n])),
                ("orig_im_size", Array::new([2], vec![encoded.size[1] as f32, encoded.size[0] as f32])),
            ]),
            Kind::Transformers { .. } => inputs.extend([
                ("input_points", Array::new([1, n, 1, 2], flat().collect())),
                ("input_labels", Array::new([1, n, 1], vec![1.0; n])),
                ("input_boxes", Array::new([1, 0, 4], Vec::new())),
            ]),
        }
        inputs.retain(|(name, _)| self.decoder.input(&[name]).is_some());
        let find =
            |names: &[&str], what: &str| self.decoder.output(names).ok_or_else(|| self.decoder.refuse(format!("it gives no {what}")));
        let masks = find(&["low_res_masks", "pred_masks", "output_masks", "masks"], "masks")?;
        let scores = find(&["iou_predictions", "iou_scores", "scores"], "predicted IoU")?;
        let mut found = self.decoder.run(inputs, &[masks, scores])?;
        let (scores, logits) = (found.remove(1).values, found.remove(0));
        let [.., masks, rows, columns] = logits.shape[..] else {
            return Err(self.decoder.refuse(format!("its masks have shape {:?}", logits.shape)));
        };
        if masks == 0 || scores.len() != n * masks || logits.values.len() != n * masks * rows * columns {
            return Err(self.decoder.refuse(format!("{n} prompts gave masks of shape {:?} and {} scores", logits.shape, scores.len())));
        }
        let shown = self.shown(encoded, [columns, rows]);
        let scale = [0, 1].map(|k| shown[k] / encoded.size[k] as f32);
        let shown = [(shown[0].ceil() as usize).min(columns), (shown[1].ceil() as usize).min(rows)];
        Ok(Logits { values: logits.values, scores, masks, rows, columns, shown, scale })
    }

    /// How many of so many cells show the picture: all, where they have its proportions or it was stretched to theirs; else those of the
    /// padded square that it covers.
    fn shown(&self, encoded: &Encoded, cells: [usize; 2]) -> [f32; 2] {
        let [w, h] = encoded.size.map(|v| v as f32);
        let all = cells.map(|c| c as f32);
        let alike = (all[0] * h - all[1] * w).abs() <= w.max(h);
        if self.stretched() || self.kind == Kind::Efficient || (cells[0] != cells[1] && alike) {
            return all;
        }
        let long = encoded.prompted[0].max(encoded.prompted[1]);
        [0, 1].map(|k| all[k] * encoded.prompted[k] / long)
    }

    /// Prompts that every inference of an export with a fixed batch takes.
    pub fn fixed_batch(&self) -> Option<usize> {
        let points = self.decoder.input(&["point_coords", "batched_point_coords", "input_points"])?;
        let prompts = if matches!(self.kind, Kind::Official | Kind::Stretched) { 0 } else { 1 };
        *points.shape.get(prompts)?
    }

    /// As many prompts as can be asked at once for [`ANSWER`] bytes: EfficientSAM draws its masks at the size of the picture.
    pub fn most_prompts(&self, encoded: &Encoded) -> usize {
        let cells = if self.kind == Kind::Efficient { encoded.size[0] * encoded.size[1] } else { (LOW * LOW) as u32 };
        (ANSWER / (4 * MASKS * cells as usize)).max(1)
    }

    /// That these models cannot be used, and why.
    pub fn refuse(&self, reason: &str) -> Error {
        self.decoder.refuse(reason)
    }
}

fn size_of(picture: &RgbImage) -> [f32; 2] {
    [picture.width() as f32, picture.height() as f32]
}

/// The picture with its longer side at `side`.
fn scaled(picture: &RgbImage, side: usize) -> RgbImage {
    let scale = side as f32 / picture.width().max(picture.height()) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    image_io::resize(picture, size(picture.width()), size(picture.height()))
}

/// `[1][3][rows][columns]`, normalised; padded with zeros to the right and below where a side is given.
fn planar<S: Copy + Into<f32>, P: Pixel<Subpixel = S>>(
    picture: &ImageBuffer<P, Vec<S>>,
    mean: [f32; 3],
    deviation: [f32; 3],
    side: Option<usize>,
) -> Array {
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let (columns, rows) = side.map_or((w, h), |s| (s, s));
    let mut values = vec![0.0; 3 * rows * columns];
    for (x, y, pixel) in picture.enumerate_pixels() {
        for k in 0..3 {
            values[(k * rows + y as usize) * columns + x as usize] = (pixel.channels()[k].into() - mean[k]) / deviation[k];
        }
    }
    Array::new([1, 3, rows, columns], values)
}
