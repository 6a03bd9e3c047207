//! Finds blurred photos and photos that repeat the one before them.

use fastlgs_core::stats;
use image::imageops::{FilterType, grayscale, resize};
use image::{GrayImage, RgbImage};

/// A photo is blurred if its sharpness, relative to the median, is below this value.
const BLURRED: f32 = 0.2;
/// Smallest weight of a photo's masks, see [`weights`].
const MIN_SHARPNESS_WEIGHT: f32 = 0.1;
/// Mean difference of grey values, 0 to 255, below which two thumbnails count as the same photo.
const SAME: f32 = 1.0;
/// Side of the thumbnails, in pixels.
const THUMB: u32 = 32;

/// Sharpness and thumbnail of a photo.
#[derive(Clone)]
pub struct PhotoStats {
    /// Mean squared Laplacian divided by the variance of the grey values. It depends on the content
    /// and its size in the photo.
    pub sharpness: f32,
    thumb: Vec<u8>,
}

impl PhotoStats {
    /// Measures a photo. The division by the variance prevents plain and dark photos from being
    /// classified as blurred.
    pub fn of(photo: &RgbImage) -> Self {
        Self::of_gray(&grayscale(photo))
    }

    /// Measures a grey photo, as `Self::of`.
    pub fn of_gray(gray: &GrayImage) -> Self {
        let (w, h) = gray.dimensions();
        let at = |x: u32, y: u32| f32::from(gray.get_pixel(x, y)[0]);
        let (mut edges, mut sum, mut squares, mut count) = (0.0f64, 0.0f64, 0.0f64, 1e-6f64);
        for (x, y) in
            (1..h.saturating_sub(1)).flat_map(|y| (1..w.saturating_sub(1)).map(move |x| (x, y)))
        {
            let laplacian =
                4.0 * at(x, y) - at(x - 1, y) - at(x + 1, y) - at(x, y - 1) - at(x, y + 1);
            edges += f64::from(laplacian * laplacian);
            sum += f64::from(at(x, y));
            squares += f64::from(at(x, y) * at(x, y));
            count += 1.0;
        }
        let spread = squares / count - (sum / count).powi(2);
        let thumb = resize(gray, THUMB, THUMB, FilterType::Triangle).into_raw();
        Self {
            sharpness: (edges / count / spread.max(1.0)) as f32,
            thumb,
        }
    }
}

/// Returns the sharpness of each photo, relative to the median.
fn relative(photos: &[PhotoStats]) -> impl Iterator<Item = f32> {
    let median = stats::median(photos.iter().map(|p| p.sharpness));
    let middle = median.unwrap_or(0.0).max(1e-12);
    photos.iter().map(move |p| p.sharpness / middle)
}

/// Returns the indices of blurred photos.
pub fn blurred(photos: &[PhotoStats]) -> Vec<usize> {
    relative(photos)
        .enumerate()
        .filter(|s| s.1 < BLURRED)
        .map(|s| s.0)
        .collect()
}

/// Returns the weight that the masks of each photo have when objects are found: the relative
/// sharpness of the photo, from `MIN_SHARPNESS_WEIGHT` to 1.
pub fn weights(photos: &[PhotoStats]) -> Vec<f32> {
    relative(photos)
        .map(|sharpness| sharpness.clamp(MIN_SHARPNESS_WEIGHT, 1.0))
        .collect()
}

/// Returns the indices of photos that repeat the one before them.
pub fn repeated(photos: &[PhotoStats]) -> Vec<usize> {
    let difference = |a: &[u8], b: &[u8]| {
        a.iter()
            .zip(b)
            .map(|(x, y)| f32::from(x.abs_diff(*y)))
            .sum::<f32>()
            / a.len() as f32
    };
    (1..photos.len())
        .filter(|&i| difference(&photos[i - 1].thumb, &photos[i].thumb) < SAME)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn the_blurred_and_the_repeated_one_are_found() {
        let photo = |shift: u32| {
            RgbImage::from_fn(96, 64, |x, y| {
                Rgb([if ((x + 5 * shift) / 9 + y / 7).is_multiple_of(2) {
                    30
                } else {
                    220
                }; 3])
            })
        };
        let mut photos: Vec<RgbImage> = (0..5).map(photo).collect();
        photos[2] = image::imageops::blur(&photos[2], 3.0);
        photos.push(photos[4].clone());
        let seen: Vec<PhotoStats> = photos.iter().map(PhotoStats::of).collect();
        assert_eq!(blurred(&seen), [2]);
        assert_eq!(repeated(&seen), [5]);
        let weights = weights(&seen);
        assert!(
            weights[2] < BLURRED && [0, 1, 3, 4].iter().all(|&i| weights[i] > 0.9),
            "{weights:?}"
        );
        assert!(blurred(&[]).is_empty() && repeated(&[]).is_empty());
    }
}
