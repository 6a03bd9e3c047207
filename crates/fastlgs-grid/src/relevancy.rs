//! How much an embedding says for a text: LERF's relevancy (paper eq. 4), and the odds that an object is what a text means.

/// Phrases that stand for "anything".
pub const CANONICAL: [&str; 3] = ["object", "stuff", "texture"];

/// Factor on the cosines before the softmax: LERF's code has it, its paper does not.
const TEMPERATURE: f32 = 10.0;

/// What an encoder's cosines are worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Log-odds of a unit of cosine: by how much the cosines of things with their names exceed those of others, over the variance of the latter.
    pub temperature: f32,
    /// The cosine from which odds count, where no phrases stand for "anything".
    pub anything: f32,
    /// Mode and scale of the Gumbel distribution of the best log-odds in a scene, without sizes, that names of absent things reach.
    pub absent: [f32; 2],
    /// Whether all this was measured with the encoder; otherwise it follows from figures that are published about its kind.
    pub measured: bool,
}

impl Calibration {
    /// The offline encoder, measured on three photographed scenes and the generated room and table, whose temperatures are 14, 20, 22, 29 and
    /// 34. A sentence model has no picture of "object" or "stuff", so that a fixed cosine stands for "anything".
    pub const OFFLINE: Self = Self { temperature: 20.0, anything: 0.6, absent: [-2.56, 1.36], measured: true };

    /// CLIP's towers, from their published statistics (right 0.28 +- 0.02, wrong 0.20 +- 0.02, canonical phrases 0.21 +- 0.015) drawn for the objects
    /// of three scenes. Twice the temperature that follows: without a measurement the text decides unless it is nearly level.
    pub const CLIP: Self = Self { temperature: 400.0, anything: -1.0, absent: [17.0, 2.6], measured: false };

    /// The share of absent names whose best log-odds in a scene are lower.
    pub fn confidence(&self, log_odds: f32) -> f32 {
        let [mode, scale] = self.absent;
        (-(-(log_odds - mode) / scale).exp()).exp()
    }
}

/// A text ready to be compared: its embedding and those of the canonical phrases.
#[derive(Clone, Debug)]
pub struct TextQuery {
    /// Embedding of the text, L2-normalised.
    pub text: Vec<f32>,
    /// Embeddings of [`CANONICAL`]; may be empty.
    pub canonical: Vec<Vec<f32>>,
    /// Embeddings that an object must not be nearer to than to the text.
    pub negatives: Vec<Vec<f32>>,
    /// Least cosine that "anything" has.
    pub anything: f32,
    /// What the cosines are worth.
    pub calibration: Calibration,
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

impl TextQuery {
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
        let calibration = Calibration::CLIP;
        let query = TextQuery {
            text: vec![1.0, 0.0],
            canonical: vec![vec![0.0, 1.0], vec![0.6, 0.8]],
            negatives: Vec::new(),
            anything: -1.0,
            calibration,
        };
        assert!((query.relevancy(&[1.0, 0.0]) - 1.0 / (1.0 + (-4.0f32).exp())).abs() < 1e-6);
        let plain = TextQuery { text: vec![1.0, 0.0], canonical: Vec::new(), negatives: Vec::new(), anything: 0.4, calibration };
        assert_eq!(plain.relevancy(&[0.4, 0.0]), 0.5);
        assert!((query.relevancy(&[0.8, 0.6]) - 1.0 / (1.0 + (1.6f32).exp())).abs() < 1e-5);
    }

    #[test]
    fn confidence_is_the_share_of_absent_names() {
        let Calibration { absent: [mode, scale], .. } = Calibration::OFFLINE;
        for share in [0.05f32, 0.5, 0.95] {
            let at = mode - scale * (-share.ln()).ln();
            assert!((Calibration::OFFLINE.confidence(at) - share).abs() < 1e-3, "{share}");
        }
    }
}
