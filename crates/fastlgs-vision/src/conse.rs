//! The offline encoder, a joint space of photos and texts: ConSE (Norouzi et al. 2014).
//!
//! The embedding of an image is the probability-weighted mean of the text embeddings of its ten
//! most likely ImageNet class names. It is zero-shot, but limited to 1,000 concepts.

use crate::appearance::{self, Appearance};
use crate::attributes;
use crate::brighten;
use crate::crops::{self, Surround};
use crate::encoder::{Encoder, normalise};
use crate::runtime::{Array, Model};
use crate::{Result, model_paths, names};
use fastlgs_core::LabelMap;
use fastlgs_core::rng::Rng;
use image::RgbImage;
use rayon::prelude::*;

/// Version of the embeddings; those of different versions cannot be compared. Raise it when a mask
/// gets another embedding.
pub const VERSION: u32 = 4;

/// Length of an embedding: 384 values of MiniLM, then [`attributes`] and [`appearance`].
pub const LENGTH: usize = 384 + attributes::COUNT + appearance::COUNT;

/// Number of classes that contribute to an embedding.
const TOP: usize = 10;
/// Input size of EfficientNet-Lite2 in pixels.
const CROP_SIDE: usize = 260;
/// Number of dimensions of a projected dense map.
pub const DENSE: usize = 32;

/// Features of a grid of cells that covers a photo.
#[derive(Clone, Debug)]
pub struct DenseMap {
    /// Number of cells in a row.
    pub columns: usize,
    /// Number of cells in a column.
    pub rows: usize,
    /// Number of values of a cell.
    pub channels: usize,
    /// `[rows][columns][channels]`.
    pub values: Vec<f32>,
}

/// The offline encoder: EfficientNet-Lite2 and MiniLM.
pub struct Conse {
    classifier: Model,
    /// `[1000][384]`, L2-normalised.
    class_embeddings: Vec<Vec<f32>>,
    /// `[1000][DENSE]`: random projection of logits.
    projection: Vec<[f32; DENSE]>,
    appearance: Appearance,
}

impl Conse {
    /// Loads the classifier and the embeddings of its class names from the cache folder.
    ///
    /// # Errors
    /// When they are not installed.
    pub fn load() -> Result<Self> {
        let folder = model_paths::offline_dir();
        let classifier = Model::load_for_each_core(&folder.join("classifier8.onnx"))?;
        let class_embeddings = names::embeddings()?;
        let mut rng = Rng::new(0, "dense projection");
        let projection = class_embeddings
            .iter()
            .map(|_| std::array::from_fn(|_| rng.normal()))
            .collect();
        let appearance = Appearance::new(class_embeddings.len());
        Ok(Self {
            classifier,
            class_embeddings,
            projection,
            appearance,
        })
    }

    /// Returns the class logits of each crop, `[crops][1000]`.
    fn logits(&self, crops: &[crops::Crop]) -> Result<Array> {
        let data = crops
            .iter()
            .flat_map(|c| c.planar.iter().map(|v| (v - 127.0) / 128.0))
            .collect();
        Ok(self
            .classifier
            .run(
                vec![(
                    "image",
                    Array::new([crops.len(), 3, CROP_SIDE, CROP_SIDE], data),
                )],
                &["logits"],
            )?
            .remove(0))
    }

    /// Returns the L2-normalised ConSE embedding of class probabilities.
    fn embedding(&self, probabilities: &[f32]) -> Vec<f32> {
        let mut order: Vec<usize> = (0..probabilities.len()).collect();
        order.sort_by(|&a, &b| {
            probabilities[b]
                .total_cmp(&probabilities[a])
                .then(a.cmp(&b))
        });
        let mut sum = vec![0.0; self.class_embeddings[0].len()];
        for &class in order.iter().take(TOP) {
            for (s, e) in sum.iter_mut().zip(&self.class_embeddings[class]) {
                *s += probabilities[class] * e;
            }
        }
        normalise(&mut sum);
        sum
    }

    /// Returns the class logits of cells of 32 pixels, minus the mean of each class over the photo.
    ///
    /// # Errors
    /// When inference fails.
    pub fn dense(&self, photo: &RgbImage) -> Result<DenseMap> {
        let (w, h) = (photo.width() as usize, photo.height() as usize);
        let mut data = vec![0.0; 3 * w * h];
        for (i, pixel) in photo.pixels().enumerate() {
            (0..3).for_each(|k| data[k * w * h + i] = (f32::from(pixel[k]) - 127.0) / 128.0);
        }
        let Array {
            shape,
            values: logits,
        } = self
            .classifier
            .run(vec![("image", Array::new([1, 3, h, w], data))], &["dense"])?
            .remove(0);
        let (classes, rows, columns) = (shape[1], shape[2], shape[3]);
        let cells = rows * columns;
        let mut values = vec![0.0; cells * classes];
        for (k, class) in logits.chunks_exact(cells).enumerate() {
            let mean = class.iter().sum::<f32>() / cells as f32;
            class
                .iter()
                .enumerate()
                .for_each(|(cell, v)| values[cell * classes + k] = v - mean);
        }
        Ok(DenseMap {
            columns,
            rows,
            channels: classes,
            values,
        })
    }

    /// Projects a dense map to [`DENSE`] dimensions by a seeded random projection, which preserves
    /// distances approximately.
    pub fn project(&self, map: &DenseMap) -> DenseMap {
        let mut values = vec![0.0; map.columns * map.rows * DENSE];
        for (cell, out) in map
            .values
            .chunks_exact(map.channels)
            .zip(values.chunks_exact_mut(DENSE))
        {
            for (value, axes) in cell.iter().zip(&self.projection) {
                out.iter_mut().zip(axes).for_each(|(o, a)| *o += value * a);
            }
        }
        DenseMap {
            channels: DENSE,
            values,
            ..*map
        }
    }

    /// Returns the class logits of each label 1..=max; empty for labels that do not occur.
    ///
    /// Each mask is classified alone and with its surroundings; the result is the mean of both.
    fn mask_logits(&self, photo: &RgbImage, masks: &LabelMap) -> Result<Vec<Vec<f32>>> {
        let photo = &brighten::brightened(photo);
        let boxes = masks.boxes();
        let present: Vec<(u16, [u32; 4])> = (1..=masks.max())
            .filter_map(|l| Some((l, boxes[usize::from(l)]?)))
            .collect();
        let views = [Surround::Neutral, Surround::Context];
        let of_mask = |&(label, bounds): &(u16, [u32; 4])| -> Result<Vec<f32>> {
            let crops = views.map(|s| crops::crop(photo, masks, label, bounds, CROP_SIDE, s));
            let logits = self.logits(&crops)?;
            let (alone, within) = logits.values.split_at(logits.shape[1]);
            Ok(alone
                .iter()
                .zip(within)
                .map(|(a, b)| 0.5 * (a + b))
                .collect())
        };
        let logits = present
            .par_iter()
            .map(of_mask)
            .collect::<Result<Vec<_>>>()?;
        let mut out = vec![Vec::new(); usize::from(masks.max())];
        for ((label, _), own) in present.iter().zip(logits) {
            out[usize::from(*label) - 1] = own;
        }
        Ok(out)
    }
}

impl Encoder for Conse {
    fn embed_masks(
        &self,
        _view: &str,
        photo: &RgbImage,
        masks: &LabelMap,
    ) -> Result<Vec<Vec<f32>>> {
        let colors = attributes::of_masks(&brighten::brightened(photo), masks);
        let embed =
            |(logits, colors): (&Vec<f32>, [f32; attributes::COUNT])| match logits.as_slice() {
                [] => vec![0.0; LENGTH],
                logits => [
                    self.embedding(&softmax(logits)).as_slice(),
                    &colors,
                    &self.appearance.project(logits),
                ]
                .concat(),
            };
        Ok(self
            .mask_logits(photo, masks)?
            .iter()
            .zip(colors)
            .map(embed)
            .collect())
    }
}

fn softmax(logits: &[f32]) -> Vec<f32> {
    let most = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let raw: Vec<f32> = logits.iter().map(|l| (l - most).exp()).collect();
    let sum: f32 = raw.iter().sum();
    raw.into_iter().map(|v| v / sum).collect()
}
