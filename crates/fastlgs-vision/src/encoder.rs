//! What embeds masks and texts into one space.

use crate::Result;
use fastlgs_core::LabelMap;
use image::RgbImage;

/// Embeds the masks of a photo.
pub trait Encoder: Sync {
    /// Name recorded in the scene; a query must use the text tower of the same encoder.
    fn name(&self) -> &'static str;
    /// One embedding for each label 1..=max of the map of a view, in order; zeros for labels that do not occur. What texts are compared with has length 1;
    /// between examples further numbers may count ([`crate::appearance`]).
    ///
    /// # Errors
    /// When inference fails, or embeddings that were made elsewhere are missing.
    fn embed_masks(&self, view: &str, photo: &RgbImage, masks: &LabelMap) -> Result<Vec<Vec<f32>>>;
}

/// Embeds texts.
pub trait TextEncoder: Send {
    /// One embedding a text, to be multiplied with those of masks.
    ///
    /// # Errors
    /// When inference fails.
    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>>;

    /// By how much the cosine that unrelated masks reach with this text exceeds what they reach with others.
    fn advantage(&self, _text: &str) -> f32 {
        0.0
    }
}

/// Scales a vector to length 1; a zero vector stays.
pub fn normalise(vector: &mut [f32]) {
    let length = vector.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|v| *v /= length);
    }
}
