//! Colour histograms of masks (C in the paper's feature similarity comparison).

use fastlgs_core::LabelMap;
use image::{RgbImage, imageops::FilterType};

/// Number of bins for each of R, G and B.
const BINS_PER_CHANNEL: usize = 8;
/// Length of a histogram.
pub const BINS: usize = BINS_PER_CHANNEL * BINS_PER_CHANNEL * BINS_PER_CHANNEL;

/// Returns the normalised joint RGB histogram of each label 1..=max.
///
/// Each pixel is shared linearly between the two nearest bins of each channel. With hard bins, a
/// small change of brightness would move most pixels to other bins. The similarity of colours would
/// then be so small that Algorithm 1 could match no masks, whatever their embeddings.
pub fn histograms(photo: &RgbImage, masks: &LabelMap) -> Vec<Vec<f32>> {
    let photo = image::imageops::resize(photo, masks.width, masks.height, FilterType::Triangle);
    let mut out = vec![vec![0.0f32; BINS]; usize::from(masks.max())];
    for (pixel, &label) in photo.pixels().zip(&masks.labels) {
        if label > 0 {
            let along = pixel.0.map(nearest_bins);
            for corner in 0..8usize {
                let of = |c: usize| along[c][corner >> c & 1];
                let bin = (0..3).fold(0, |b, c| b * BINS_PER_CHANNEL + of(c).0);
                out[usize::from(label) - 1][bin] += (0..3).map(|c| of(c).1).product::<f32>();
            }
        }
    }
    for histogram in &mut out {
        let sum: f32 = histogram.iter().sum();
        histogram.iter_mut().for_each(|v| *v /= sum.max(1.0));
    }
    out
}

/// Returns the two bins nearest to a value, each with its weight.
fn nearest_bins(value: u8) -> [(usize, f32); 2] {
    let at = ((f32::from(value) + 0.5) * BINS_PER_CHANNEL as f32 / 256.0 - 0.5)
        .clamp(0.0, (BINS_PER_CHANNEL - 1) as f32);
    let below = (at as usize).min(BINS_PER_CHANNEL - 2);
    [
        (below, 1.0 - (at - below as f32)),
        (below + 1, at - below as f32),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn small_brightness_changes_keep_histograms_similar() {
        let masks = LabelMap {
            width: 2,
            height: 1,
            labels: vec![1, 1],
        };
        let of = |v: u8| histograms(&RgbImage::from_pixel(2, 1, Rgb([v, v, v])), &masks).remove(0);
        let alike = |a: u8, b: u8| {
            of(a)
                .iter()
                .zip(of(b))
                .map(|(x, y)| (x * y).sqrt())
                .sum::<f32>()
        };
        for v in [0, 31, 32, 100, 255] {
            assert!(
                (of(v).iter().sum::<f32>() - 1.0).abs() < 1e-5 && (alike(v, v) - 1.0).abs() < 1e-5
            );
        }
        assert!(
            alike(30, 33) > 0.97,
            "values on both sides of a bin border: {}",
            alike(30, 33)
        );
        assert!(alike(20, 120) < 0.01);
    }
}
