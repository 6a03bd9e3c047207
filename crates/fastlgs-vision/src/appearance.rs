//! What masks look like to the classifier, beyond the names of its classes: by this, too, objects are compared with examples and pictures.
//!
//! ConSE keeps of the classifier's logits what the ten likeliest names mean, so that two things of one kind are the same to it. All logits together tell
//! single things apart. Both together do both: by one view of an object of three photographed scenes, its other views are told from all objects of
//! the other scenes in 90 % of all cases instead of 43 % (where 7 % of these are taken for it), and a lamp of one generated scene is still known by
//! that of another.
//! Embeddings of the offline encoder end with what logits look like, in fewer dimensions; for texts that is zero.

use crate::encoder::normalise;
use fastlgs_core::rng::Rng;

/// Numbers at the end of an embedding. A random projection keeps inner products: by these numbers alone it is 91 %, by 32 86, by 128 93, by all logits 96.
pub const COUNT: usize = 64;

/// What 3,086 masks of a fox, an office and a bonsai project to in the mean: a cut-out is rather like this than like nothing. By all logits it is 79 %
/// without it and 96 with that of two scenes for the third.
const MEAN: [f32; COUNT] = [
    -2.2, 24.2, -18.5, -5.7, -3.5, 28.2, 37.6, -2.6, 18.4, 14.4, 6.7, -39.7, -7.8, 3.9, 35.8, 34.5, -6.3, -49.0, -14.6, 9.1, -3.4, -19.4,
    -16.1, -17.6, -11.8, 32.5, -31.7, 0.3, 3.4, -13.7, -27.3, -3.5, -9.6, -38.9, 13.2, 11.0, -4.6, -15.1, -26.1, -32.9, 34.4, -10.0, -13.6,
    -24.8, 22.6, 19.0, 14.1, 2.9, -32.0, -27.3, 34.8, -5.2, -26.5, 21.7, -38.6, 10.3, 12.2, 39.5, 0.1, 13.7, -4.1, 1.2, -0.4, -12.4,
];

/// What the cosine of appearances counts against that of meanings. With 1 it is 88 % instead of 90. With nothing but appearance it is 91, but the mug of
/// one generated table is not known by that of another.
pub const WEIGHT: f32 = 2.0;

/// Where each class of a classifier lies.
pub struct Appearance(Vec<[f32; COUNT]>);

impl Appearance {
    /// For so many classes.
    pub fn new(classes: usize) -> Self {
        let mut rng = Rng::new(0, "likeness");
        Self((0..classes).map(|_| std::array::from_fn(|_| rng.normal())).collect())
    }

    /// What logits look like; the inner product with that of others is [`WEIGHT`] times their cosine.
    pub fn of(&self, logits: &[f32]) -> [f32; COUNT] {
        let mean = logits.iter().sum::<f32>() / logits.len().max(1) as f32;
        let mut sum = MEAN.map(|m| -m);
        for (logit, axes) in logits.iter().zip(&self.0) {
            sum.iter_mut().zip(axes).for_each(|(s, a)| *s += (logit - mean) * a);
        }
        normalise(&mut sum);
        sum.map(|v| v * WEIGHT.sqrt())
    }
}

/// The numbers of an offline embedding that texts are compared by.
pub fn words(embedding: &mut [f32]) -> &mut [f32] {
    let count = embedding.len().saturating_sub(COUNT);
    &mut embedding[..count]
}

/// An offline embedding for what knows nothing but words: without the numbers that count only between examples.
pub fn for_words(mut embedding: Vec<f32>) -> Vec<f32> {
    let count = words(&mut embedding).len();
    embedding[count..].fill(0.0);
    embedding
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logits_that_differ_in_nothing_but_their_level_are_alike() {
        let appearance = Appearance::new(1000);
        let mut rng = Rng::new(3, "logits");
        let mut logits = || -> Vec<f32> { (0..1000).map(|_| 3.0 * rng.normal()).collect() };
        let dot = |a: [f32; COUNT], b: [f32; COUNT]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
        let (a, b) = (logits(), logits());
        let raised: Vec<f32> = a.iter().map(|v| v + 2.0).collect();
        assert!((dot(appearance.of(&a), appearance.of(&raised)) - WEIGHT).abs() < 1e-4);
        assert!(dot(appearance.of(&a), appearance.of(&b)) < 0.6 * WEIGHT, "{}", dot(appearance.of(&a), appearance.of(&b)));
    }

    #[test]
    fn the_mean_is_of_these_axes() {
        let axes = Appearance::new(1000).0;
        let sum: f32 = axes.iter().flatten().sum();
        assert!((axes[0][0] - -1.09525).abs() < 1e-5 && (sum - 311.36).abs() < 0.05, "{} {sum}: MEAN must be measured anew", axes[0][0]);
    }

    #[test]
    fn what_is_for_words_has_no_appearance() {
        let whole: Vec<f32> = (1..=COUNT + 3).map(|v| v as f32).collect();
        let worded = for_words(whole.clone());
        assert_eq!((&worded[..3], &worded[3..]), (&whole[..3], [0.0; COUNT].as_slice()));
    }
}
