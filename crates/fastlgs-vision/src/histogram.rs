//! Colour distributions C of masks and their similarity (paper, feature similarity comparison).

use fastlgs_core::LabelMap;
use image::{RgbImage, imageops::FilterType};

/// Bins along each of R, G and B.
const SIDE: usize = 8;
/// Length of a histogram.
pub const BINS: usize = SIDE * SIDE * SIDE;

/// Normalised joint RGB histogram of each label 1..=max.
pub fn histograms(photo: &RgbImage, masks: &LabelMap) -> Vec<Vec<f32>> {
    let photo = image::imageops::resize(photo, masks.width, masks.height, FilterType::Triangle);
    let mut out = vec![vec![0.0f32; BINS]; usize::from(masks.max())];
    for (pixel, &label) in photo.pixels().zip(&masks.labels) {
        if label > 0 {
            let bin = pixel.0.iter().fold(0, |b, &v| b * SIDE + usize::from(v) * SIDE / 256);
            out[usize::from(label) - 1][bin] += 1.0;
        }
    }
    for histogram in &mut out {
        let sum: f32 = histogram.iter().sum();
        histogram.iter_mut().for_each(|v| *v /= sum.max(1.0));
    }
    out
}
