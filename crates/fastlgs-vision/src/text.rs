//! The offline text tower: all-MiniLM-L6-v2.

use crate::encoder::TextEncoder;
use crate::runtime::{Input, Model};
use crate::{Error, Result, models};
use tokenizers::Tokenizer;

/// Longest text in tokens.
const MAX_TOKENS: usize = 128;

/// all-MiniLM-L6-v2 (mean pooling, 384 dimensions).
pub struct MiniLm {
    model: Model,
    tokenizer: Tokenizer,
}

impl MiniLm {
    /// Loads it from the cache folder.
    ///
    /// # Errors
    /// When it is not installed.
    pub fn load() -> Result<Self> {
        let folder = models::offline_dir();
        let model = Model::load(&folder.join("text.onnx"))?;
        let path = folder.join("tokenizer.json");
        let mut tokenizer = Tokenizer::from_file(&path).map_err(|e| Error::Missing(format!("{}: {e}", path.display())))?;
        tokenizer.with_padding(None);
        let truncation = tokenizers::TruncationParams { max_length: MAX_TOKENS, ..Default::default() };
        tokenizer.with_truncation(Some(truncation)).map_err(|e| Error::Invalid(format!("{}: {e}", path.display())))?;
        Ok(Self { model, tokenizer })
    }
}

impl TextEncoder for MiniLm {
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
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
                ids.extend((0..length).map(|k| row.get(k).map_or(0, |v| i64::from(*v))));
                mask.extend((0..length).map(|k| i64::from(k < row.len())));
            }
            let shape = vec![batch.len(), length];
            let (shape, values) =
                self.model.run(vec![("ids", Input::Int(shape.clone(), ids)), ("mask", Input::Int(shape, mask))], "embedding")?;
            out.extend(values.chunks_exact(shape[1]).map(<[f32]>::to_vec));
        }
        Ok(out)
    }
}
