//! Cross-view grid mapping (paper, Algorithm 1): which masks of different photos show the same object.

use std::collections::BTreeMap;

/// One mask of one photo.
#[derive(Clone, Debug)]
pub struct Mask {
    /// Index of the photo in the sequence.
    pub view: usize,
    /// Label in that photo's map.
    pub label: u16,
    /// Share of the photo that it covers.
    pub area: f32,
    /// Embedding L, L2-normalised; zeros where there is none.
    pub embedding: Vec<f32>,
    /// Colour distribution C, summing to 1.
    pub histogram: Vec<f32>,
}

/// Constants of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperConfig {
    /// Fewest key-point pairs that make two masks one object (tau).
    pub tau: u32,
    /// Least similarity that makes two masks one object (theta).
    pub theta: f32,
    /// Weight of colour against the embedding (alpha).
    pub alpha: f32,
}

impl Default for PaperConfig {
    fn default() -> Self {
        Self { tau: 4, theta: 0.95, alpha: 0.3 }
    }
}

/// Key-point pairs between masks: (later mask, earlier mask) -> number. Masks are indices into the mask list.
pub type Correspondences = BTreeMap<(usize, usize), u32>;

/// sim = alpha * Bhattacharyya coefficient of C + (1 - alpha) * cosine of L.
///
/// The paper's prose swaps the two names; its formulas are meant like this.
pub fn similarity(a: &Mask, b: &Mask, alpha: f32) -> f32 {
    let color: f32 = a.histogram.iter().zip(&b.histogram).map(|(x, y)| (x * y).sqrt()).sum();
    let cosine: f32 = a.embedding.iter().zip(&b.embedding).map(|(x, y)| x * y).sum();
    alpha * color + (1.0 - alpha) * cosine
}

/// Algorithm 1. `masks` are sorted by view; returns the object of each mask, 1..=K, and K.
///
/// Photos are taken in sequence; masks of the first photo are objects of their own.
pub fn paper(masks: &[Mask], pairs: &Correspondences, config: &PaperConfig) -> (Vec<u16>, u16) {
    let mut object: Vec<u16> = Vec::with_capacity(masks.len());
    let mut count = 0u16;
    for (j, mask) in masks.iter().enumerate() {
        let earlier = masks.partition_point(|m| m.view < mask.view);
        let most_corresponding = pairs.range((j, 0)..(j, earlier)).map(|(&(_, k), &n)| (n, std::cmp::Reverse(k))).max();
        let by_key_points = most_corresponding.filter(|(n, _)| *n >= config.tau).map(|(_, k)| k.0);
        let same = by_key_points.or_else(|| {
            let sims = (0..earlier).map(|k| (similarity(mask, &masks[k], config.alpha), k));
            sims.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1))).filter(|(sim, _)| *sim >= config.theta).map(|(_, k)| k)
        });
        object.push(match same {
            Some(k) => object[k],
            None => {
                count += 1;
                count
            }
        });
    }
    (object, count)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(view: usize, label: u16, embedding: [f32; 2], histogram: [f32; 2]) -> Mask {
        Mask { view, label, area: 0.1, embedding: embedding.to_vec(), histogram: histogram.to_vec() }
    }

    /// View 0 shows a cup and a book; view 1 the cup (by key points), a book of the same look (by similarity), and
    /// something new; view 2 a thing with three pairs only, which is not enough.
    #[test]
    fn algorithm_1_by_hand() {
        let masks = [
            mask(0, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 2, [0.0, 1.0], [0.5, 0.5]),
            mask(1, 1, [0.6, 0.8], [0.0, 1.0]),
            mask(1, 2, [0.0, 1.0], [0.45, 0.55]),
            mask(1, 3, [-1.0, 0.0], [1.0, 0.0]),
            mask(2, 1, [0.8, -0.6], [0.2, 0.8]),
        ];
        let pairs = Correspondences::from([((2, 0), 4), ((2, 1), 2), ((5, 0), 3)]);
        let (object, count) = paper(&masks, &pairs, &PaperConfig::default());
        assert_eq!((object, count), (vec![1, 2, 1, 2, 3, 4], 4));
        let (object, _) = paper(&masks, &pairs, &PaperConfig { tau: 3, ..PaperConfig::default() });
        assert_eq!(object[5], 1, "tau is an option");
        assert!((similarity(&masks[1], &masks[3], 0.3) - (0.7 + 0.3 * (0.225f32.sqrt() + 0.275f32.sqrt()))).abs() < 1e-6);
    }
}
