//! Compares embeddings with a query: LERF's relevancy (paper, eq. 4).

use crate::calibration::Calibration;
use crate::grid::Grid;
use serde::{Deserialize, Serialize};

/// Canonical phrases: those of LERF, without "things".
pub const CANONICAL: [&str; 3] = ["object", "stuff", "texture"];

/// Factor on cosines before the softmax. It is in LERF's code, not in its paper.
const TEMPERATURE: f32 = 10.0;

/// How objects are ranked and accepted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// By calibrated margin and share of the surface. Absent names are refused.
    #[default]
    Calibrated,
    /// By the largest relevancy of an object's embeddings, as in the paper: the first object is the
    /// target, and nothing is refused.
    Paper,
}

/// Source of the evidence for a name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Source {
    /// Cosines with the embedding of the text, or with those of examples.
    #[default]
    Embeddings,
    /// Votes of the detector for the classes of these names. A scene without votes is answered by
    /// embeddings.
    Detector(Vec<String>),
    /// None: neither detector nor encoder knows the name, so no object is found. A scene without
    /// votes is answered by embeddings.
    Unknown,
}

/// A query: positive, canonical and negative embeddings, with the calibration of their encoder.
#[derive(Clone, Debug)]
pub struct TextQuery {
    /// Positive embeddings: one of a text, or those of examples, of which the nearest counts.
    pub positive: Vec<Vec<f32>>,
    /// Whether the positive embeddings are from examples instead of a text.
    pub from_example: bool,
    /// Embeddings of [`CANONICAL`]; may be empty.
    pub canonical: Vec<Vec<f32>>,
    /// Negative embeddings. An object is excluded if it is at least as near to one of them as to
    /// the query.
    pub negatives: Vec<Vec<f32>>,
    /// Smallest canonical cosine.
    pub min_canonical: f32,
    /// Calibration of the encoder for this kind of query.
    pub calibration: Calibration,
    /// How objects are ranked and accepted.
    pub rule: Rule,
    /// Source of the evidence.
    pub source: Source,
}

/// Computes an inner product. Sixteen partial sums let the compiler vectorise it.
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
    /// Returns a text query without canonical and negative embeddings.
    pub fn new(positive: Vec<Vec<f32>>, calibration: Calibration) -> Self {
        Self {
            positive,
            from_example: false,
            canonical: Vec::new(),
            negatives: Vec::new(),
            min_canonical: calibration.anything,
            calibration,
            rule: Rule::default(),
            source: Source::default(),
        }
    }

    /// Returns a query from examples, without canonical and negative embeddings.
    pub fn of_examples(positive: Vec<Vec<f32>>, calibration: Calibration) -> Self {
        Self {
            from_example: true,
            ..Self::new(positive, calibration)
        }
    }

    /// Returns the source of evidence in this scene: embeddings if it has no votes of the detector.
    pub fn source_in(&self, grid: &Grid) -> &Source {
        if grid.has_detections() {
            &self.source
        } else {
            &Source::Embeddings
        }
    }

    /// Returns whether a source of evidence knows the name in this scene.
    pub fn is_known(&self, grid: &Grid) -> bool {
        *self.source_in(grid) != Source::Unknown
    }

    /// Returns the relevancy S = min_i exp(t phi.q) / (exp(t phi.c_i) + exp(t phi.q)), 0 to 1. At
    /// 0.5, the text is as near as the canonical phrases.
    pub fn relevancy(&self, embedding: &[f32]) -> f32 {
        1.0 / (1.0 + (-TEMPERATURE * self.margin(embedding)).exp())
    }

    /// Returns the margin: cosine with the query minus canonical cosine.
    pub fn margin(&self, embedding: &[f32]) -> f32 {
        self.cosine(embedding) - self.canonical(embedding)
    }

    /// Returns the largest cosine of an embedding with a canonical phrase; at least
    /// `min_canonical`.
    pub fn canonical(&self, embedding: &[f32]) -> f32 {
        self.canonical
            .iter()
            .map(|c| dot(embedding, c))
            .fold(self.min_canonical, f32::max)
    }

    /// Returns the largest cosine of an embedding with a negative; -1 if there is none.
    pub fn negative(&self, embedding: &[f32]) -> f32 {
        self.negatives
            .iter()
            .map(|n| dot(embedding, n))
            .fold(-1.0, f32::max)
    }

    /// Returns the largest inner product of an embedding with a positive one. It is a cosine for
    /// texts. Between examples, offline embeddings add a weighted cosine of appearance.
    pub fn cosine(&self, embedding: &[f32]) -> f32 {
        self.positive
            .iter()
            .map(|meant| dot(embedding, meant))
            .fold(-1.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_strongest_canonical_phrase_counts() {
        let canonical = vec![vec![0.0, 1.0], vec![0.6, 0.8]];
        let query = TextQuery {
            canonical,
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP)
        };
        assert!((query.relevancy(&[1.0, 0.0]) - 1.0 / (1.0 + (-4.0f32).exp())).abs() < 1e-6);
        let plain = TextQuery {
            min_canonical: 0.4,
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP)
        };
        assert_eq!(plain.relevancy(&[0.4, 0.0]), 0.5);
        let several = TextQuery::new(vec![vec![1.0, 0.0], vec![0.0, 1.0]], Calibration::CLIP);
        assert_eq!(
            (several.cosine(&[0.6, 0.8]), several.cosine(&[0.8, 0.6])),
            (0.8, 0.8),
            "the nearest example counts"
        );
        assert!((query.relevancy(&[0.8, 0.6]) - 1.0 / (1.0 + (1.6f32).exp())).abs() < 1e-5);
    }
}
