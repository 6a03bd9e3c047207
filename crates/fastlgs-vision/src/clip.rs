//! CLIP (Radford et al. 2021) and SigLIP (Zhai et al. 2023) from ONNX exports of their two towers.

use crate::clip_tokens::Tokens;
use crate::crops::{self, Background};
use crate::encoder::{Encoder, TextEncoder, normalise};
use crate::pull::{MODEL_PAIRS, ModelPair};
use crate::runtime::{Array, Model};
use crate::{Error, Result};
use fastlgs_core::{LabelMap, fs};
use image::RgbImage;
use std::path::Path;
use std::sync::Arc;

/// Mean and standard deviation of CLIP's training pictures, RGB in [0, 1]. A
/// `preprocessor_config.json` of the model overrides them.
const CLIP_MEAN: [f32; 3] = [0.481_454_66, 0.457_827_5, 0.408_210_73];
const DEVIATION: [f32; 3] = [0.268_629_54, 0.261_302_6, 0.275_777_1];
/// Input size in pixels if neither the model nor a configuration file gives one.
const CLIP_SIDE: usize = 224;
/// Number of crops or texts in one inference.
const BATCH: usize = 8;
/// Prompts of a text; the embeddings of all of them are averaged.
const TEMPLATES: [&str; 4] = [
    "{}",
    "a photo of a {}.",
    "a photo of the {}.",
    "a close-up photo of a {}.",
];

/// Output names that exporters use for the embedding, in order of preference.
const IMAGE_OUTPUTS: [&str; 4] = [
    "image_embeds",
    "image_features",
    "image_embedding",
    "embeddings",
];
const TEXT_OUTPUTS: [&str; 4] = [
    "text_embeds",
    "text_features",
    "text_embedding",
    "embeddings",
];
/// Output with SigLIP's embedding. CLIP's output of this name is not yet projected into the joint
/// space of texts and pictures.
const POOLED: &str = "pooler_output";

/// The image tower.
#[derive(Clone)]
pub struct ClipImage {
    model: Arc<Model>,
    input: String,
    output: String,
    size: usize,
    mean: [f32; 3],
    deviation: [f32; 3],
    background: Background,
}

/// The text tower.
pub struct ClipText {
    model: Model,
    tokens: Tokens,
    ids: String,
    mask: Option<String>,
    output: String,
    context: usize,
}

/// Reads the JSON file `name` in the model's folder or its parent folder; null if there is none.
fn settings(model: &Path, name: &str) -> Result<serde_json::Value> {
    let found = model
        .ancestors()
        .skip(1)
        .take(2)
        .map(|folder| folder.join(name))
        .find(|file| file.is_file());
    Ok(found
        .map(|file| fs::read_json(&file))
        .transpose()?
        .unwrap_or_default())
}

/// Returns whether the configuration describes a SigLIP model.
fn is_siglip(configuration: &serde_json::Value) -> bool {
    configuration["model_type"]
        .as_str()
        .is_some_and(|kind| kind.starts_with("siglip"))
}

/// Returns whether a tower is one of OpenAI's: `config.json` in its folder or its parent folder
/// names it so, or `models pull` fetched it, which offers only those.
pub fn is_openai(tower: &Path) -> bool {
    let configured = settings(tower, "config.json").unwrap_or_default();
    let name = configured["_name_or_path"].as_str().unwrap_or_default();
    let pulled = |model: &ModelPair| {
        model.repository.starts_with("Xenova/clip-") && tower.starts_with(model.folder())
    };
    name.starts_with("openai/") || MODEL_PAIRS.iter().any(pulled)
}

/// Returns the embedding output: the first of `names` that exists, SigLIP's pooled output, or the
/// only output.
fn embedding_output(
    model: &Model,
    names: &[&str],
    configuration: &serde_json::Value,
) -> Result<String> {
    let pooled = || model.output(&[POOLED]).filter(|_| is_siglip(configuration));
    let only = || {
        model
            .outputs
            .first()
            .filter(|_| model.outputs.len() == 1)
            .map(String::as_str)
    };
    let found = model.output(names).or_else(pooled).or_else(only);
    found.map(str::to_owned).ok_or_else(|| {
        model.error(format!(
            "none of its outputs is an embedding: {}",
            model.outputs.join(", ")
        ))
    })
}

impl ClipImage {
    /// Loads the tower.
    ///
    /// Size and normalisation come from `preprocessor_config.json` in the model's folder or its
    /// parent folder, if there is one. A size that the model fixes has priority. `config.json`
    /// there identifies SigLIP.
    ///
    /// # Errors
    /// When the file is missing or is not an image tower.
    pub fn load(path: &Path) -> Result<Self> {
        let model = Model::load(path)?;
        let [slot] = &model.inputs[..] else {
            let names: Vec<&str> = model.inputs.iter().map(|i| i.name.as_str()).collect();
            return Err(model.error(format!(
                "it is not an image tower, which has one input; its inputs are {}",
                names.join(", ")
            )));
        };
        if slot.shape.len() != 4 {
            return Err(model.error(format!(
                "its input '{}' does not take pictures, which have four dimensions",
                slot.name
            )));
        }
        let (fixed, input) = (slot.shape[2], slot.name.clone());
        let configuration = settings(path, "preprocessor_config.json")?;
        let triple = |name: &str, otherwise: [f32; 3]| {
            let values = configuration[name].as_array().filter(|a| a.len() == 3);
            values.map_or(otherwise, |a| {
                std::array::from_fn(|k| a[k].as_f64().unwrap_or(f64::from(otherwise[k])) as f32)
            })
        };
        let side = |v: &serde_json::Value| {
            v.as_u64()
                .or_else(|| v["height"].as_u64())
                .or_else(|| v["shortest_edge"].as_u64())
        };
        let configured = side(&configuration["crop_size"])
            .or_else(|| side(&configuration["size"]))
            .map(|s| s as usize);
        let output = embedding_output(&model, &IMAGE_OUTPUTS, &settings(path, "config.json")?)?;
        let (mean, deviation) = (
            triple("image_mean", CLIP_MEAN),
            triple("image_std", DEVIATION),
        );
        let (size, background) = (
            fixed.or(configured).unwrap_or(CLIP_SIDE),
            Background::default(),
        );
        Ok(Self {
            model: Arc::new(model),
            input,
            output,
            size,
            mean,
            deviation,
            background,
        })
    }

    /// Sets the background of masks in their crops.
    #[must_use]
    pub fn with_background(self, background: Background) -> Self {
        Self { background, ..self }
    }
}

impl Encoder for ClipImage {
    fn embed_masks(
        &self,
        _view: &str,
        photo: &RgbImage,
        masks: &LabelMap,
    ) -> Result<Vec<Vec<f32>>> {
        let boxes = masks.boxes();
        let present: Vec<u16> = (1..=masks.max())
            .filter(|l| boxes[usize::from(*l)].is_some())
            .collect();
        let plane = self.size * self.size;
        let mut out = vec![Vec::new(); usize::from(masks.max())];
        let mut dimension = 0;
        // A model with a fixed batch size takes one crop at a time.
        let fixed = self.model.input(&[&self.input]).and_then(|s| s.shape[0]);
        for batch in present.chunks(fixed.map_or(BATCH, |_| 1)) {
            let mut values = Vec::with_capacity(batch.len() * 3 * plane);
            for &label in batch {
                let bounds = boxes[usize::from(label)].expect("filtered above");
                let crop = crops::bicubic(photo, masks, label, bounds, self.size, self.background);
                values.extend(
                    crop.planar.iter().enumerate().map(|(i, v)| {
                        (v / 255.0 - self.mean[i / plane]) / self.deviation[i / plane]
                    }),
                );
            }
            let input = Array::new([batch.len(), 3, self.size, self.size], values);
            let embeddings = self
                .model
                .run(vec![(&self.input, input)], &[&self.output])?
                .remove(0);
            if embeddings.shape.len() != 2 || embeddings.shape[0] != batch.len() {
                return Err(self.model.error(format!("for {} crops it returned embeddings of shape {:?}; expected one row for each crop", batch.len(), embeddings.shape)));
            }
            dimension = embeddings.shape[1];
            for (label, row) in batch.iter().zip(embeddings.values.chunks_exact(dimension)) {
                let mut row = row.to_vec();
                normalise(&mut row);
                out[usize::from(*label) - 1] = row;
            }
        }
        out.iter_mut()
            .filter(|e| e.is_empty())
            .for_each(|e| e.resize(dimension, 0.0));
        Ok(out)
    }
}

impl ClipText {
    /// Loads the tower and its tokenizer.
    ///
    /// # Errors
    /// When a file is missing or is not a text tower.
    pub fn load(path: &Path) -> Result<Self> {
        let model = Model::load(path)?;
        let ids = model
            .input(&["input_ids", "text", "tokens", "input"])
            .map(|s| (s.name.clone(), s.shape.last().copied().flatten()));
        let (ids, context) =
            ids.ok_or_else(|| model.error("it is no text tower: it has no input for token ids"))?;
        let mask = model.input(&["attention_mask"]).map(|s| s.name.clone());
        let configuration = settings(path, "config.json")?;
        let output = embedding_output(&model, &TEXT_OUTPUTS, &configuration)?;
        let configured_context = configuration["text_config"]["max_position_embeddings"]
            .as_u64()
            .map(|longest| longest as usize);
        let tokens = if is_siglip(&configuration) {
            Tokens::load_siglip(path)?
        } else {
            Tokens::load_clip(path)?
        };
        Ok(Self {
            context: context.or(configured_context).unwrap_or(tokens.context()),
            tokens,
            ids,
            mask,
            output,
            model,
        })
    }

    /// Returns the L2-normalised embeddings of complete sentences.
    pub(crate) fn sentences(&self, sentences: &[String]) -> Result<Vec<Vec<f32>>> {
        let mut out = Vec::with_capacity(sentences.len());
        let fixed = self.model.input(&[&self.ids]).and_then(|s| s.shape[0]);
        for batch in sentences.chunks(fixed.map_or(BATCH, |_| 1)) {
            let (mut ids, mut mask) = (Vec::new(), Vec::new());
            for sentence in batch {
                let row = self.tokens.encode(sentence, self.context)?;
                let padding = self.tokens.padding(self.mask.is_some());
                ids.extend(
                    (0..self.context).map(|k| row.get(k).copied().unwrap_or(padding) as f32),
                );
                mask.extend((0..self.context).map(|k| f32::from(u8::from(k < row.len()))));
            }
            let shape = [batch.len(), self.context];
            let mut inputs = vec![(self.ids.as_str(), Array::new(shape, ids))];
            if let Some(name) = &self.mask {
                inputs.push((name, Array::new(shape, mask)));
            }
            let embeddings = self.model.run(inputs, &[&self.output])?.remove(0);
            if embeddings.shape.len() != 2 || embeddings.shape[0] != batch.len() {
                return Err(self.model.error(format!("for {} texts it returned embeddings of shape {:?}; expected one row for each text", batch.len(), embeddings.shape)));
            }
            out.extend(
                embeddings
                    .values
                    .chunks_exact(embeddings.shape[1])
                    .map(|row| {
                        let mut row = row.to_vec();
                        normalise(&mut row);
                        row
                    }),
            );
        }
        Ok(out)
    }
}

impl TextEncoder for ClipText {
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        let fill = |text: &&str| TEMPLATES.map(|t| t.replace("{}", text));
        let sentences: Vec<String> = texts.iter().flat_map(fill).collect();
        let embeddings = self.sentences(&sentences)?;
        let mean = |rows: &[Vec<f32>]| {
            let mut sum: Vec<f32> = (0..rows[0].len())
                .map(|k| rows.iter().map(|r| r[k]).sum())
                .collect();
            normalise(&mut sum);
            sum
        };
        Ok(embeddings.chunks_exact(TEMPLATES.len()).map(mean).collect())
    }

    fn embed_alone(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        let sentences: Vec<String> = texts.iter().map(|text| (*text).to_owned()).collect();
        self.sentences(&sentences)
    }
}

/// Checks that the embeddings of both towers have the same length.
///
/// # Errors
/// When the lengths differ; the error gives both.
pub fn check_pair(image: &ClipImage, text: &ClipText) -> Result<()> {
    let gray = RgbImage::from_pixel(8, 8, image::Rgb([127; 3]));
    let pixel = LabelMap {
        width: 8,
        height: 8,
        labels: vec![1; 64],
    };
    let (a, b) = (
        image.embed_masks("", &gray, &pixel)?[0].len(),
        text.sentences(&["object".to_owned()])?[0].len(),
    );
    if a == b {
        return Ok(());
    }
    Err(Error::Invalid(format!(
        "the CLIP towers do not belong together: embeddings of the image tower have length {a}, those of the text tower {b}; use two towers of one model"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy_models;
    use image::Rgb;

    fn has_runtime() -> bool {
        let found = crate::model_paths::runtime_library()
            .inspect_err(|e| crate::skip::skip(format_args!("{e}")));
        assert!(
            found.is_ok() || std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(),
            "FASTLGS_REQUIRE_MODELS is set, but ONNX Runtime is missing"
        );
        found.is_ok()
    }

    #[test]
    fn crops_are_nearest_to_their_texts() {
        let dir = tempfile::tempdir().unwrap();
        let (image, text) = (dir.path().join("image.onnx"), dir.path().join("text.onnx"));
        toy_models::clip(&image, &text, 32);
        if !has_runtime() {
            return;
        }
        let (image, text) = (
            ClipImage::load(&image).unwrap(),
            ClipText::load(&text).unwrap(),
        );
        assert_eq!(image.size, 32);
        check_pair(&image, &text).unwrap();
        // Label 1 is red, label 2 is absent, label 3 is blue. The green between them is in no mask.
        let photo = RgbImage::from_fn(60, 40, |x, _| {
            Rgb(if x < 20 {
                [220, 30, 30]
            } else if x < 40 {
                [30, 220, 30]
            } else {
                [30, 30, 220]
            })
        });
        let labels = (0..2400).map(|i| match i % 60 {
            0..20 => 1,
            40..60 => 3,
            _ => 0,
        });
        let masks = LabelMap {
            width: 60,
            height: 40,
            labels: labels.collect(),
        };
        let crops = image.embed_masks("", &photo, &masks).unwrap();
        let texts = text.embed(&["red", "green", "blue"]).unwrap();
        let cosine = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
        for (crop, own) in [(0, 0), (2, 2)] {
            let best = (0..3).max_by(|a, b| {
                cosine(&crops[crop], &texts[*a]).total_cmp(&cosine(&crops[crop], &texts[*b]))
            });
            assert_eq!(best, Some(own));
            assert!(cosine(&crops[crop], &texts[own]) > 0.9);
        }
        assert_eq!(crops[1], vec![0.0; 3]);
    }

    #[test]
    fn pooler_output_is_used_only_for_siglip() {
        let dir = tempfile::tempdir().unwrap();
        let image = dir.path().join("vision_model.onnx");
        toy_models::image_tower(&image, 16, &["last_hidden_state", "pooler_output"]);
        if !has_runtime() {
            return;
        }
        let refused = ClipImage::load(&image).err().unwrap().to_string();
        assert!(
            refused.contains("vision_model.onnx") && refused.contains("pooler_output"),
            "{refused}"
        );
        let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
        write(
            "config.json",
            r#"{"model_type": "siglip", "text_config": {"max_position_embeddings": 64}}"#,
        );
        write(
            "preprocessor_config.json",
            r#"{"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}"#,
        );
        let tower = ClipImage::load(&image).unwrap();
        let masks = LabelMap {
            width: 20,
            height: 20,
            labels: vec![1; 400],
        };
        let red = tower
            .embed_masks("", &RgbImage::from_pixel(20, 20, Rgb([255, 0, 0])), &masks)
            .unwrap()
            .remove(0);
        assert!(
            red.iter()
                .zip([2.0, -1.0, -1.0])
                .all(|(own, wanted)| (own - wanted / 6.0f32.sqrt()).abs() < 0.01),
            "{red:?}"
        );
    }

    #[test]
    fn openai_models_are_known_by_their_configuration_or_place() {
        let dir = tempfile::tempdir().unwrap();
        let tower = dir.path().join("onnx/text_model.onnx");
        assert!(!is_openai(&tower));
        let configure = |name: &str| {
            let text = format!(r#"{{"_name_or_path": "{name}"}}"#);
            std::fs::write(dir.path().join("config.json"), text).unwrap();
        };
        configure("laion/CLIP-ViT-B-16-laion2B-s34B-b88K");
        assert!(!is_openai(&tower));
        configure("openai/clip-vit-base-patch16");
        assert!(is_openai(&tower));
        let pulled = |name: &str| ModelPair::find(name).unwrap().folder().join("a.onnx");
        assert!(is_openai(&pulled("clip-vit-b16")) && !is_openai(&pulled("sam-vit-b")));
    }

    #[test]
    fn errors_for_the_wrong_tower_name_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let (image, text) = (dir.path().join("image.onnx"), dir.path().join("text.onnx"));
        toy_models::clip(&image, &text, 32);
        if !has_runtime() {
            return;
        }
        assert!(
            ClipImage::load(&text)
                .err()
                .unwrap()
                .to_string()
                .contains("text.onnx")
        );
        assert!(
            ClipText::load(&image)
                .err()
                .unwrap()
                .to_string()
                .contains("image.onnx")
        );
    }
}
