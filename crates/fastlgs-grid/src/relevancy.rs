//! How much an embedding says for a text: LERF's relevancy (paper eq. 4).

use crate::calibration::Calibration;

/// Phrases that stand for "anything".
pub const CANONICAL: [&str; 3] = ["object", "stuff", "texture"];

/// Factor on the cosines before the softmax: LERF's code has it, its paper does not.
const TEMPERATURE: f32 = 10.0;

/// What is meant, ready to be compared: its embeddings and those of the canonical phrases.
#[derive(Clone, Debug)]
pub struct TextQuery {
    /// Embeddings: one of a text, or those of examples, of which the nearest counts.
    pub meant: Vec<Vec<f32>>,
    /// Whether they are of things that were shown, and not of words.
    pub shown: bool,
    /// Embeddings of [`CANONICAL`]; may be empty.
    pub canonical: Vec<Vec<f32>>,
    /// Embeddings that an object must not be nearer to than to the text.
    pub negatives: Vec<Vec<f32>>,
    /// Least cosine that "anything" has.
    pub anything: f32,
    /// What the cosines are worth.
    pub calibration: Calibration,
}

/// In sixteen sums, which the compiler may keep in vectors; one sum would have to be added up in order.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    debug_assert_eq!(a.len(), b.len(), "embeddings of one encoder");
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    let mut sums = [0.0; 16];
    for (a, b) in a.iter().zip(b) {
        (0..16).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum::<f32>()
}

impl TextQuery {
    /// What is meant by itself: without phrases that stand for "anything", and without negatives.
    pub fn new(meant: Vec<Vec<f32>>, calibration: Calibration) -> Self {
        Self { meant, shown: false, canonical: Vec::new(), negatives: Vec::new(), anything: calibration.anything, calibration }
    }

    /// What was shown, in the same way.
    pub fn of_examples(meant: Vec<Vec<f32>>, calibration: Calibration) -> Self {
        Self { shown: true, ..Self::new(meant, calibration) }
    }

    /// S = min_i exp(t phi.q) / (exp(t phi.c_i) + exp(t phi.q)); 0.5 means as near to "anything" as to the text.
    pub fn relevancy(&self, embedding: &[f32]) -> f32 {
        1.0 / (1.0 + (TEMPERATURE * (self.canonical(embedding) - self.cosine(embedding))).exp())
    }

    /// The highest cosine of an embedding with what stands for "anything".
    pub fn canonical(&self, embedding: &[f32]) -> f32 {
        self.canonical.iter().map(|c| dot(embedding, c)).fold(self.anything, f32::max)
    }

    /// The highest cosine of an embedding with what is not meant.
    pub fn negative(&self, embedding: &[f32]) -> f32 {
        self.negatives.iter().map(|n| dot(embedding, n)).fold(-1.0, f32::max)
    }

    /// Cosine of an embedding with what is meant; for encoders that compare examples by more than texts the sum of both cosines.
    pub fn cosine(&self, embedding: &[f32]) -> f32 {
        self.meant.iter().map(|meant| dot(embedding, meant)).fold(-1.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_strongest_canonical_phrase_counts() {
        let canonical = vec![vec![0.0, 1.0], vec![0.6, 0.8]];
        let query = TextQuery { canonical, ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP) };
        assert!((query.relevancy(&[1.0, 0.0]) - 1.0 / (1.0 + (-4.0f32).exp())).abs() < 1e-6);
        let plain = TextQuery { anything: 0.4, ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP) };
        assert_eq!(plain.relevancy(&[0.4, 0.0]), 0.5);
        let several = TextQuery::new(vec![vec![1.0, 0.0], vec![0.0, 1.0]], Calibration::CLIP);
        assert_eq!((several.cosine(&[0.6, 0.8]), several.cosine(&[0.8, 0.6])), (0.8, 0.8), "the nearest example counts");
        assert!((query.relevancy(&[0.8, 0.6]) - 1.0 / (1.0 + (1.6f32).exp())).abs() < 1e-5);
    }
}
