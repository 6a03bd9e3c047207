//! Relevancy of an embedding to a text (paper eq. 4, after LERF).

/// Phrases that stand for "anything".
pub const CANONICAL: [&str; 3] = ["object", "stuff", "texture"];

/// The cosine that unrelated things reach with the offline encoder: a sentence model has no picture of "object" or "stuff" whose
/// likeness would tell anything.
pub const OFFLINE_ANYTHING: f32 = 0.6;

/// The cosine that pictures of unrelated things reach; not calibrated.
pub const IMAGE_ANYTHING: f32 = 0.6;

/// Factor on the cosines before the softmax: LERF's code has it, its paper does not.
pub const TEMPERATURE: f32 = 10.0;

/// A text ready to be compared: its embedding and those of the canonical phrases.
#[derive(Clone, Debug)]
pub struct TextQuery {
    /// Embedding of the text, L2-normalised.
    pub text: Vec<f32>,
    /// Embeddings of [`CANONICAL`], or of what else stands for "anything"; may be empty.
    pub canonical: Vec<Vec<f32>>,
    /// Least cosine that "anything" has.
    pub anything: f32,
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

impl TextQuery {
    /// S = min_i exp(t phi.q) / (exp(t phi.c_i) + exp(t phi.q)); 0.5 means as near to "anything" as to the text.
    pub fn relevancy(&self, embedding: &[f32]) -> f32 {
        let query = dot(embedding, &self.text);
        let canonical = self.canonical.iter().map(|c| dot(embedding, c)).fold(self.anything, f32::max);
        1.0 / (1.0 + (TEMPERATURE * (canonical - query)).exp())
    }

    /// Cosine of an embedding with the text.
    pub fn cosine(&self, embedding: &[f32]) -> f32 {
        dot(embedding, &self.text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_strongest_canonical_phrase_counts() {
        let query = TextQuery { text: vec![1.0, 0.0], canonical: vec![vec![0.0, 1.0], vec![0.6, 0.8]], anything: -1.0 };
        assert!((query.relevancy(&[1.0, 0.0]) - 1.0 / (1.0 + (-4.0f32).exp())).abs() < 1e-6);
        let plain = TextQuery { text: vec![1.0, 0.0], canonical: Vec::new(), anything: 0.4 };
        assert_eq!(plain.relevancy(&[0.4, 0.0]), 0.5);
        assert!((query.relevancy(&[0.8, 0.6]) - 1.0 / (1.0 + (1.6f32).exp())).abs() < 1e-5);
    }
}
