//! Appearance of masks: the classifier's logits in fewer dimensions, to compare objects with
//! examples and pictures.
//!
//! ConSE keeps only the names of the ten likeliest classes, so objects of one kind have equal
//! embeddings. All logits together also distinguish objects of one kind.
//! Embeddings of the offline encoder end with the appearance; for texts it is zero.

use crate::encoder::normalise;
use fastlgs_core::rng::Rng;

/// Number of appearance values at the end of an embedding. A random projection preserves inner
/// products approximately. With 64 values, 91 % of an object's other views are recognised; with all
/// logits, 96 %.
pub const COUNT: usize = 64;

/// Mean projection of 3,086 masks of three scenes. Subtracting it removes what all crops have in
/// common. It must be measured again if the axes of `Appearance::new` change.
const DESCRIPTOR_MEAN: [f32; COUNT] = [
    -2.2, 24.2, -18.5, -5.7, -3.5, 28.2, 37.6, -2.6, 18.4, 14.4, 6.7, -39.7, -7.8, 3.9, 35.8, 34.5,
    -6.3, -49.0, -14.6, 9.1, -3.4, -19.4, -16.1, -17.6, -11.8, 32.5, -31.7, 0.3, 3.4, -13.7, -27.3,
    -3.5, -9.6, -38.9, 13.2, 11.0, -4.6, -15.1, -26.1, -32.9, 34.4, -10.0, -13.6, -24.8, 22.6,
    19.0, 14.1, 2.9, -32.0, -27.3, 34.8, -5.2, -26.5, 21.7, -38.6, 10.3, 12.2, 39.5, 0.1, 13.7,
    -4.1, 1.2, -0.4, -12.4,
];

/// Weight of the cosine of appearances, relative to that of ConSE embeddings. Appearance alone does
/// not recognise an object of the same kind in another scene.
pub const WEIGHT: f32 = 2.0;

/// Random projection axes of each class of a classifier.
pub struct Appearance(Vec<[f32; COUNT]>);

impl Appearance {
    /// Makes the axes of `classes` classes, with a fixed seed.
    pub fn new(classes: usize) -> Self {
        let mut rng = Rng::new(0, "likeness");
        Self(
            (0..classes)
                .map(|_| std::array::from_fn(|_| rng.normal()))
                .collect(),
        )
    }

    /// Returns the appearance of class logits. The inner product of two appearances is [`WEIGHT`]
    /// times their cosine.
    pub fn project(&self, logits: &[f32]) -> [f32; COUNT] {
        let mean = logits.iter().sum::<f32>() / logits.len().max(1) as f32;
        let mut sum = DESCRIPTOR_MEAN.map(|m| -m);
        for (logit, axes) in logits.iter().zip(&self.0) {
            sum.iter_mut()
                .zip(axes)
                .for_each(|(s, a)| *s += (logit - mean) * a);
        }
        normalise(&mut sum);
        sum.map(|v| v * WEIGHT.sqrt())
    }
}

/// Returns the values of an offline embedding that are compared with texts: all but the appearance.
pub fn text_part(embedding: &mut [f32]) -> &mut [f32] {
    let count = embedding.len().saturating_sub(COUNT);
    &mut embedding[..count]
}

/// Returns an offline embedding with its appearance set to zero, so that only the values shared
/// with texts count.
pub fn without_appearance(mut embedding: Vec<f32>) -> Vec<f32> {
    let count = text_part(&mut embedding).len();
    embedding[count..].fill(0.0);
    embedding
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn appearance_ignores_a_constant_offset_of_logits() {
        let appearance = Appearance::new(1000);
        let mut rng = Rng::new(3, "logits");
        let mut logits = || -> Vec<f32> { (0..1000).map(|_| 3.0 * rng.normal()).collect() };
        let dot =
            |a: [f32; COUNT], b: [f32; COUNT]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
        let (a, b) = (logits(), logits());
        let raised: Vec<f32> = a.iter().map(|v| v + 2.0).collect();
        assert!((dot(appearance.project(&a), appearance.project(&raised)) - WEIGHT).abs() < 1e-4);
        assert!(
            dot(appearance.project(&a), appearance.project(&b)) < 0.6 * WEIGHT,
            "{}",
            dot(appearance.project(&a), appearance.project(&b))
        );
    }

    #[test]
    fn mean_was_measured_with_these_axes() {
        let axes = Appearance::new(1000).0;
        let sum: f32 = axes.iter().flatten().sum();
        assert!(
            (axes[0][0] - -1.09525).abs() < 1e-5 && (sum - 311.36).abs() < 0.05,
            "{} {sum}: the axes have changed, so DESCRIPTOR_MEAN must be measured again",
            axes[0][0]
        );
    }

    #[test]
    fn without_appearance_zeroes_the_last_values() {
        let whole: Vec<f32> = (1..=COUNT + 3).map(|v| v as f32).collect();
        let worded = without_appearance(whole.clone());
        assert_eq!(
            (&worded[..3], &worded[3..]),
            (&whole[..3], [0.0; COUNT].as_slice())
        );
    }
}
