//! Traits of encoders, which embed masks and texts in one space.

use crate::Result;
use fastlgs_core::LabelMap;
use image::RgbImage;

/// Embeds the masks of a photo.
pub trait Encoder: Sync {
    /// Returns one embedding for each label 1..=max of a view's label map, in order; zeros for
    /// labels that do not occur. The values that are compared with texts have length 1. Values that
    /// are compared only with other masks may follow ([`crate::appearance`]).
    ///
    /// # Errors
    /// When inference fails, or imported embeddings are missing.
    fn embed_masks(&self, view: &str, photo: &RgbImage, masks: &LabelMap) -> Result<Vec<Vec<f32>>>;
}

/// Embeds texts.
pub trait TextEncoder: Send {
    /// Returns one embedding for each text. Its inner product with that of a mask is their
    /// similarity.
    ///
    /// # Errors
    /// When inference fails.
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>>;

    /// As [`Self::embed`], but each text is embedded alone, without prompts around it (paper).
    ///
    /// # Errors
    /// When inference fails.
    fn embed_alone(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        self.embed(texts)
    }

    /// Returns by how much this text raises the cosine of unrelated masks, compared with other
    /// texts.
    fn baseline_shift(&self, _text: &str) -> f32 {
        0.0
    }
}

/// Scales a vector to length 1; a zero vector stays zero.
pub fn normalise(vector: &mut [f32]) {
    let length = vector.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|v| *v /= length);
    }
}
