//! ONNX exports of Segment Anything by different authors, recognised by the names of their inputs.

use crate::runtime::{Array, Model};
use crate::{Error, Result};
use fastlgs_core::image_io;
use image::imageops::{self, FilterType};
use image::{DynamicImage, ImageBuffer, Pixel, RgbImage};
use std::path::Path;

/// Longer side, in pixels, of the images that the models were trained on.
const SAM_SIDE: usize = 1024;
/// Side of the low-resolution masks, in cells.
const MASK_SIDE: usize = 256;
/// Largest size of the mask logits of one inference, in bytes.
const MAX_MASK_BYTES: usize = 64 << 20;
/// Largest number of masks that a decoder returns per prompt.
const MASKS: usize = 4;
/// Mean and standard deviation of the training images, RGB in [0, 255]. SAM and SAM 2 use the same
/// values.
const SAM_MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const DEVIATION: [f32; 3] = [58.395, 57.12, 57.375];
/// Names of the encoder's main output in the known exports.
const EMBEDDING: [&str; 6] = [
    "image_embeddings",
    "image_embedding",
    "image_embed",
    "embeddings",
    "output",
    "image_embeddings.2",
];

/// Input convention of a decoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// `point_coords`, `point_labels`; points in pixels of the padded image. Also MobileSAM,
    /// EdgeSAM and others.
    Official,
    /// The same names, with embeddings of several resolutions. The image is stretched to a square
    /// instead of padded (SAM 2).
    Stretched,
    /// `batched_point_coords`, `batched_point_labels`; points in pixels of the original image
    /// (EfficientSAM).
    Efficient,
    /// `input_points`, `input_labels`; points in pixels of the padded or the stretched image
    /// (transformers.js).
    Transformers { stretched: bool },
}

impl Kind {
    /// Determines the kind of a decoder by its inputs.
    fn of(decoder: &Model) -> Result<Self> {
        let has = |name: &str| decoder.input(&[name]).is_some();
        let finer = decoder
            .inputs
            .iter()
            .any(|i| i.name.starts_with("high_res_feats") || i.name == "image_embeddings.0");
        if has("batched_point_coords") {
            Ok(Self::Efficient)
        } else if has("input_points") {
            Ok(Self::Transformers { stretched: finer })
        } else if has("point_coords") {
            Ok(if finer {
                Self::Stretched
            } else {
                Self::Official
            })
        } else {
            let names: Vec<&str> = decoder.inputs.iter().map(|i| i.name.as_str()).collect();
            Err(decoder.error(format!(
                "this is not a supported SAM decoder; its inputs are {}",
                names.join(", ")
            )))
        }
    }

    /// Returns the names of the inputs that describe a prompt.
    fn prompt_inputs(self) -> &'static [&'static str] {
        match self {
            Self::Official | Self::Stretched => &[
                "point_coords",
                "point_labels",
                "mask_input",
                "has_mask_input",
                "orig_im_size",
            ],
            Self::Efficient => &[
                "batched_point_coords",
                "batched_point_labels",
                "orig_im_size",
            ],
            Self::Transformers { .. } => &["input_points", "input_labels", "input_boxes"],
        }
    }

    /// Returns the inputs for prompts of one point each, 0 to 1 across the photo.
    fn prompt(self, encoded: &Encoded, points: &[[f32; 2]]) -> Vec<(&'static str, Array)> {
        let n = points.len();
        let [width, height] = encoded.prompt_size;
        let on_picture = points.iter().map(|p| [p[0] * width, p[1] * height]);
        let flat = || on_picture.clone().flatten().collect();
        match self {
            Self::Official | Self::Stretched => {
                // Without a box, a padding point with label -1 follows each point.
                let padded = on_picture.flat_map(|p| [p[0], p[1], 0.0, 0.0]);
                let labels = (0..n).flat_map(|_| [1.0, -1.0]).collect();
                // Size of the full-resolution masks. They are not used, so the size is kept small.
                let [w, h] = encoded
                    .prompt_size
                    .map(|v| (v * MASK_SIDE as f32 / SAM_SIDE as f32).ceil());
                let mask = vec![0.0; MASK_SIDE * MASK_SIDE];
                vec![
                    ("point_coords", Array::new([n, 2, 2], padded.collect())),
                    ("point_labels", Array::new([n, 2], labels)),
                    ("mask_input", Array::new([1, 1, MASK_SIDE, MASK_SIDE], mask)),
                    ("has_mask_input", Array::new([1], vec![0.0])),
                    ("orig_im_size", Array::new([2], vec![h, w])),
                ]
            }
            Self::Efficient => {
                let [w, h] = encoded.size.map(|side| side as f32);
                vec![
                    ("batched_point_coords", Array::new([1, n, 1, 2], flat())),
                    ("batched_point_labels", Array::new([1, n, 1], vec![1.0; n])),
                    ("orig_im_size", Array::new([2], vec![h, w])),
                ]
            }
            Self::Transformers { .. } => vec![
                ("input_points", Array::new([1, n, 1, 2], flat())),
                ("input_labels", Array::new([1, n, 1], vec![1.0; n])),
                ("input_boxes", Array::new([1, 0, 4], Vec::new())),
            ],
        }
    }
}

/// An image encoder and its prompt decoder.
pub struct Exports {
    encoder: Model,
    decoder: Model,
    kind: Kind,
    /// Pairs of a decoder input and the encoder output that fills it.
    decoder_inputs: Vec<(String, String)>,
}

/// An encoded image.
pub struct Encoded {
    /// Embeddings by the name of the decoder's input.
    embeddings: Vec<(String, Array)>,
    /// Width and height of the image in pixels.
    pub size: [u32; 2],
    /// Width and height of the image in the coordinates of prompt points.
    prompt_size: [f32; 2],
}

/// Answer of the decoder to a batch of prompts.
pub struct Logits {
    /// Mask logits, `[prompt][mask][rows][columns]`.
    pub values: Vec<f32>,
    /// Predicted IoU, `[prompt][mask]`.
    pub scores: Vec<f32>,
    /// Masks per prompt.
    pub masks: usize,
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Cells along x and y that cover the image; the others are padding.
    pub covered_cells: [usize; 2],
    /// Cells per pixel of the image, along x and y.
    pub scale: [f32; 2],
}

impl Exports {
    /// Loads encoder and decoder, and recognises the input convention.
    ///
    /// # Errors
    /// A missing file, an unknown kind of model, or a decoder input that no encoder output fills.
    /// The message names that input.
    pub fn load(encoder: &Path, decoder: &Path) -> Result<Self> {
        let (encoder, decoder) = (Model::load(encoder)?, Model::load(decoder)?);
        let kind = Kind::of(&decoder)?;
        if encoder.inputs.len() != 1 {
            return Err(
                encoder.error("this is not a SAM image encoder; it must have exactly one input")
            );
        }
        let asked = kind.prompt_inputs();
        let mut passed = Vec::new();
        for input in decoder
            .inputs
            .iter()
            .map(|i| i.name.as_str())
            .filter(|name| !asked.contains(name))
        {
            let named = encoder.output(&[input]).or_else(|| {
                encoder
                    .output(&EMBEDDING)
                    .filter(|_| EMBEDDING.contains(&input))
            });
            // The single output of an encoder may have any name.
            let only = encoder
                .outputs
                .first()
                .map(String::as_str)
                .filter(|_| encoder.outputs.len() == 1 && EMBEDDING.contains(&input));
            let output = named.or(only).ok_or_else(|| {
                let outputs = encoder.outputs.join(", ");
                decoder.error(format!("its input '{input}' matches no output of the encoder ({outputs}); check that both files belong to the same model"))
            })?;
            passed.push((input.to_owned(), output.to_owned()));
        }
        Ok(Self {
            encoder,
            decoder,
            kind,
            decoder_inputs: passed,
        })
    }

    /// Encodes an image.
    ///
    /// # Errors
    /// Failed inference, or an encoder whose input is not an image.
    pub fn encode(&self, picture: &RgbImage) -> Result<Encoded> {
        let slot = &self.encoder.inputs[0];
        let size = [picture.width(), picture.height()];
        let (input, prompted) = match slot.shape.as_slice() {
            _ if self.kind == Kind::Efficient => (
                planar(picture, [0.0; 3], [255.0; 3], None),
                size_of(picture),
            ),
            // `[rows][columns][3]`: such encoders normalise and pad the image themselves.
            [_, _, Some(3)] => {
                let small = scaled(picture, SAM_SIDE);
                let values = small.as_raw().iter().map(|v| f32::from(*v)).collect();
                (
                    Array::new([small.height() as usize, small.width() as usize, 3], values),
                    size_of(&small),
                )
            }
            [_, Some(3), rows, _] => {
                let side = rows.unwrap_or(SAM_SIDE);
                if self.stretched() {
                    // SAM 2 resizes in floats; SAM resizes in bytes.
                    let exact = DynamicImage::ImageRgb8(picture.clone()).into_rgb32f();
                    let small =
                        imageops::resize(&exact, side as u32, side as u32, FilterType::Triangle);
                    (
                        planar(
                            &small,
                            SAM_MEAN.map(|v| v / 255.0),
                            DEVIATION.map(|v| v / 255.0),
                            Some(side),
                        ),
                        [side as f32; 2],
                    )
                } else {
                    let small = scaled(picture, side);
                    (
                        planar(&small, SAM_MEAN, DEVIATION, Some(side)),
                        size_of(&small),
                    )
                }
            }
            shape => {
                return Err(self.encoder.error(format!(
                    "its input '{}' has shape {shape:?}, which is not that of an image",
                    slot.name
                )));
            }
        };
        let outputs: Vec<&str> = self.decoder_inputs.iter().map(|p| p.1.as_str()).collect();
        let found = self
            .encoder
            .run(vec![(slot.name.as_str(), input)], &outputs)?;
        Ok(Encoded {
            embeddings: self
                .decoder_inputs
                .iter()
                .map(|p| p.0.clone())
                .zip(found)
                .collect(),
            size,
            prompt_size: prompted,
        })
    }

    fn stretched(&self) -> bool {
        matches!(
            self.kind,
            Kind::Stretched | Kind::Transformers { stretched: true }
        )
    }

    /// Returns the masks of point prompts; `points` are (x, y) as shares of the image, 0 to 1.
    ///
    /// # Errors
    /// Failed inference, or outputs that are not masks with scores.
    pub fn decode(&self, encoded: &Encoded, points: &[[f32; 2]]) -> Result<Logits> {
        let n = points.len();
        let embeddings = encoded.embeddings.iter();
        let mut inputs: Vec<(&str, Array)> = embeddings
            .map(|(name, a)| (name.as_str(), a.clone()))
            .collect();
        inputs.extend(self.kind.prompt(encoded, points));
        inputs.retain(|(name, _)| self.decoder.input(&[name]).is_some());
        let find = |names: &[&str], what: &str| {
            self.decoder
                .output(names)
                .ok_or_else(|| self.decoder.error(format!("it has no output for {what}")))
        };
        let masks = find(
            &["low_res_masks", "pred_masks", "output_masks", "masks"],
            "masks",
        )?;
        let scores = find(
            &["iou_predictions", "iou_scores", "scores"],
            "predicted IoU",
        )?;
        let mut found = self.decoder.run(inputs, &[masks, scores])?;
        let (scores, logits) = (found.remove(1).values, found.remove(0));
        let [.., masks, rows, columns] = logits.shape[..] else {
            return Err(self.decoder.error(format!(
                "its masks have the unsupported shape {:?}",
                logits.shape
            )));
        };
        if masks == 0
            || scores.len() != n * masks
            || logits.values.len() != n * masks * rows * columns
        {
            return Err(self.decoder.error(format!("{n} prompts returned masks of shape {:?} and {} scores; these numbers do not fit together", logits.shape, scores.len())));
        }
        let shown = self.image_cells(encoded, [columns, rows]);
        let scale = [0, 1].map(|k| shown[k] / encoded.size[k] as f32);
        let shown = [
            (shown[0].ceil() as usize).min(columns),
            (shown[1].ceil() as usize).min(rows),
        ];
        Ok(Logits {
            values: logits.values,
            scores,
            masks,
            rows,
            columns,
            covered_cells: shown,
            scale,
        })
    }

    /// Returns the numbers of cells along x and y that cover the image.
    /// These are all cells if the grid has the proportions of the image, or if the image was
    /// stretched. Otherwise they are the unpadded part of the square.
    fn image_cells(&self, encoded: &Encoded, cells: [usize; 2]) -> [f32; 2] {
        let [w, h] = encoded.size.map(|v| v as f32);
        let all = cells.map(|c| c as f32);
        let alike = (all[0] * h - all[1] * w).abs() <= w.max(h);
        if self.stretched() || self.kind == Kind::Efficient || (cells[0] != cells[1] && alike) {
            return all;
        }
        let long = encoded.prompt_size[0].max(encoded.prompt_size[1]);
        [0, 1].map(|k| all[k] * encoded.prompt_size[k] / long)
    }

    /// Returns the number of prompts per inference if the export fixes it.
    pub fn fixed_batch(&self) -> Option<usize> {
        let points =
            self.decoder
                .input(&["point_coords", "batched_point_coords", "input_points"])?;
        let prompts = if matches!(self.kind, Kind::Official | Kind::Stretched) {
            0
        } else {
            1
        };
        *points.shape.get(prompts)?
    }

    /// Returns the largest number of prompts per inference whose masks fit into [`MAX_MASK_BYTES`].
    /// EfficientSAM returns masks in the size of the image.
    pub fn most_prompts(&self, encoded: &Encoded) -> usize {
        let cells = if self.kind == Kind::Efficient {
            encoded.size[0] * encoded.size[1]
        } else {
            (MASK_SIDE * MASK_SIDE) as u32
        };
        (MAX_MASK_BYTES / (4 * MASKS * cells as usize)).max(1)
    }

    /// Returns an error that names the decoder and the reason.
    pub fn error(&self, reason: &str) -> Error {
        self.decoder.error(reason)
    }
}

fn size_of(picture: &RgbImage) -> [f32; 2] {
    [picture.width() as f32, picture.height() as f32]
}

/// Resizes an image so that its longer side has `side` pixels.
fn scaled(picture: &RgbImage, side: usize) -> RgbImage {
    let scale = side as f32 / picture.width().max(picture.height()) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    image_io::resize(picture, size(picture.width()), size(picture.height()))
}

/// Returns `[1][3][rows][columns]`, normalised. With `side`, it pads with zeros at the right and
/// bottom to a square.
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
            values[(k * rows + y as usize) * columns + x as usize] =
                (pixel.channels()[k].into() - mean[k]) / deviation[k];
        }
    }
    Array::new([1, 3, rows, columns], values)
}
