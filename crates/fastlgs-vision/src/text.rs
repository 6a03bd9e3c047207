//! The offline text encoder: all-MiniLM-L6-v2.

use crate::appearance;
use crate::attributes;
use crate::encoder::{TextEncoder, normalise};
use crate::runtime::{Array, Model};
use crate::{Error, Result, model_paths};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokenizers::Tokenizer;

/// Largest length of a text in tokens; longer texts are truncated.
const MAX_TOKENS: usize = 128;
/// Largest number of cached embeddings: 6 MB.
const CACHE_SIZE: usize = 4096;

/// all-MiniLM-L6-v2 (mean pooling, 384 dimensions).
pub struct MiniLm {
    model: Model,
    tokenizer: Tokenizer,
    /// Cache of embeddings that were computed alone. In a batch, an embedding may differ in the
    /// last digit, and results must not depend on earlier queries.
    cache: Mutex<HashMap<String, Vec<f32>>>,
}

impl MiniLm {
    /// Returns the encoder of this process, and loads it on first use. All scenes of the process
    /// share it and its cache.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn shared() -> Result<Arc<Self>> {
        static SHARED: Mutex<Option<Arc<MiniLm>>> = Mutex::new(None);
        let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = shared.as_ref() {
            return Ok(known.clone());
        }
        Ok(shared.insert(Arc::new(Self::load()?)).clone())
    }

    /// Loads the encoder from the cache folder.
    ///
    /// # Errors
    /// A file that is missing or invalid.
    pub fn load() -> Result<Self> {
        let folder = model_paths::offline_dir();
        let model = Model::load(&folder.join("text.onnx"))?;
        let path = folder.join("tokenizer.json");
        let mut tokenizer = Tokenizer::from_file(&path)
            .map_err(|e| Error::Missing(format!("{}: {e}", path.display())))?;
        tokenizer.with_padding(None);
        let truncation = tokenizers::TruncationParams {
            max_length: MAX_TOKENS,
            ..Default::default()
        };
        tokenizer
            .with_truncation(Some(truncation))
            .map_err(|e| Error::Invalid(format!("{}: {e}", path.display())))?;
        Ok(Self {
            model,
            tokenizer,
            cache: Mutex::default(),
        })
    }
}

impl TextEncoder for MiniLm {
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        let cache = || self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let [text] = texts
            && let Some(embedding) = cache().get(*text)
        {
            return Ok(vec![embedding.clone()]);
        }
        let mut out = Vec::with_capacity(texts.len());
        for batch in texts.chunks(64) {
            let encoded = self
                .tokenizer
                .encode_batch(batch.to_vec(), true)
                .map_err(|e| Error::Invalid(format!("a text cannot be tokenised: {e}")))?;
            let length = encoded.iter().map(|e| e.get_ids().len()).max().unwrap_or(1);
            let (mut ids, mut mask) = (Vec::new(), Vec::new());
            for e in &encoded {
                let row = e.get_ids();
                ids.extend((0..length).map(|k| row.get(k).map_or(0.0, |v| *v as f32)));
                mask.extend((0..length).map(|k| f32::from(u8::from(k < row.len()))));
            }
            let shape = [batch.len(), length];
            let inputs = vec![
                ("ids", Array::new(shape, ids)),
                ("mask", Array::new(shape, mask)),
            ];
            let embeddings = self.model.run(inputs, &["embedding"])?.remove(0);
            out.extend(
                embeddings
                    .values
                    .chunks_exact(embeddings.shape[1])
                    .map(<[f32]>::to_vec),
            );
        }
        if let ([text], [embedding]) = (texts, out.as_slice()) {
            let mut cache = cache();
            if cache.len() == CACHE_SIZE {
                cache.clear();
            }
            cache.insert((*text).to_owned(), embedding.clone());
        }
        Ok(out)
    }
}

/// Text encoder of the offline models: MiniLM embedding, then the colours and materials that the
/// text names, then zeros for appearance.
pub struct OfflineText(Arc<MiniLm>);

impl OfflineText {
    /// Uses MiniLM from the cache folder, which is loaded once per process.
    ///
    /// # Errors
    /// A file that is missing or invalid.
    pub fn load() -> Result<Self> {
        Ok(Self(MiniLm::shared()?))
    }
}

impl TextEncoder for OfflineText {
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        let (named, rest): (Vec<_>, Vec<String>) =
            texts.iter().map(|t| attributes::of_text(t)).unzip();
        // "orange juice" is more than orange-coloured juice. If a text names an attribute, its
        // embedding is the mean direction of the text with and without that name.
        let colored: Vec<usize> = (0..texts.len()).filter(|k| rest[*k] != texts[*k]).collect();
        let mut meanings = self
            .0
            .embed(&rest.iter().map(String::as_str).collect::<Vec<_>>())?;
        let whole = self
            .0
            .embed(&colored.iter().map(|k| texts[*k]).collect::<Vec<_>>())?;
        for (k, whole) in colored.into_iter().zip(whole) {
            meanings[k]
                .iter_mut()
                .zip(whole)
                .for_each(|(rest, whole)| *rest += whole);
            normalise(&mut meanings[k]);
        }
        Ok(meanings
            .into_iter()
            .zip(named)
            .map(|(meaning, named)| {
                [meaning.as_slice(), &named, &[0.0; appearance::COUNT]].concat()
            })
            .collect())
    }

    fn baseline_shift(&self, text: &str) -> f32 {
        attributes::baseline_shift(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_names_set_attributes_and_stay_in_the_embedding() {
        let text = match OfflineText::load() {
            Ok(text) => text,
            Err(e) if std::env::var_os("FASTLGS_REQUIRE_MODELS").is_some() => panic!("{e}"),
            Err(e) => return crate::skip::skip(format_args!("{e}")),
        };
        let embedded = text
            .embed(&[
                "orange juice",
                "juice",
                "golden retriever",
                "yellow retriever",
            ])
            .unwrap();
        let ends = embedded[0].len() - appearance::COUNT;
        let meaning = |k: usize| &embedded[k][..ends - attributes::COUNT];
        let named = |k: usize| &embedded[k][ends - attributes::COUNT..ends];
        let cosine = |a: usize, b: usize| {
            meaning(a)
                .iter()
                .zip(meaning(b))
                .map(|(x, y)| x * y)
                .sum::<f32>()
        };
        assert!((0..4).all(|k| (cosine(k, k) - 1.0).abs() < 1e-4));
        assert!(
            cosine(0, 1) < 0.99 && cosine(2, 3) < 0.99,
            "{} {}",
            cosine(0, 1),
            cosine(2, 3)
        );
        assert!(
            named(1).iter().all(|named| *named == 0.0) && named(0).iter().any(|named| *named > 0.0)
        );
        assert!(
            embedded.iter().all(|e| e[ends..].iter().all(|v| *v == 0.0)),
            "texts must have no appearance values"
        );
        // Cached embeddings must equal those of a newly loaded encoder.
        let fresh = MiniLm::load().unwrap();
        for texts in [["juice"], ["a bowl of ripe oranges"], ["juice"]] {
            assert_eq!(text.0.embed(&texts).unwrap(), fresh.embed(&texts).unwrap());
        }
        assert_eq!(
            (
                fresh.cache.lock().unwrap().len(),
                fresh.embed(&["juice", "tea"]).unwrap().len()
            ),
            (2, 2)
        );
    }
}
