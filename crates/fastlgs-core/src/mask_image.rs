//! Reads binary masks in the encodings of other programs: 0 and 255, 0 and 1, a palette, 16 bits,
//! or an alpha channel, with hard or soft edges.

use crate::{LabelMap, Result, image_io};
use image::{DynamicImage, GrayImage, Luma};
use std::path::Path;

/// A binary mask of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Whether each pixel is inside the mask, in row-major order.
    pub inside: Vec<bool>,
}

impl MaskImage {
    /// Reads a mask from the alpha channel if that varies, else from the brightness.
    ///
    /// Pixels above a threshold between the two clusters of values are inside. An image with a
    /// single value is inside everywhere, unless the value is 0.
    ///
    /// # Errors
    /// As [`image_io::load_rgb`].
    pub fn load(path: &Path) -> Result<Self> {
        let picture = image_io::load_any(path)?;
        let mut values = values(&picture);
        if is_flat(&values) {
            // All colours of a palette may be equal. Its indices then define the mask.
            if let Some(map) = LabelMap::load(path)
                .ok()
                .filter(|map| map.labels.len() == values.len())
            {
                values = map.labels;
            }
        }
        let level = threshold(&values);
        Ok(Self {
            width: picture.width(),
            height: picture.height(),
            inside: values.iter().map(|v| f64::from(*v) > level).collect(),
        })
    }

    /// Returns the number of pixels inside.
    pub fn area(&self) -> usize {
        self.inside.iter().filter(|inside| **inside).count()
    }

    /// Returns an image that is white inside and black outside.
    pub fn to_gray(&self) -> GrayImage {
        let value = |inside: bool| Luma([if inside { 255 } else { 0 }]);
        GrayImage::from_fn(self.width, self.height, |x, y| {
            value(self.inside[(y * self.width + x) as usize])
        })
    }
}

fn is_flat(values: &[u16]) -> bool {
    values.windows(2).all(|pair| pair[0] == pair[1])
}

/// Returns 16-bit alpha if it varies, else 16-bit brightness.
fn values(picture: &DynamicImage) -> Vec<u16> {
    if picture.color().has_alpha() {
        let alpha: Vec<u16> = picture.to_luma_alpha16().pixels().map(|p| p[1]).collect();
        if !is_flat(&alpha) {
            return alpha;
        }
    }
    picture.to_luma16().into_raw()
}

/// Returns the threshold between two clusters of values: halfway between the means above and below
/// it (Ridler and Calvard 1978). It starts at the middle of the range, so that a small cluster
/// counts as much as a large one.
fn threshold(values: &[u16]) -> f64 {
    let mut counts = vec![0u64; usize::from(u16::MAX) + 1];
    values
        .iter()
        .for_each(|value| counts[usize::from(*value)] += 1);
    let bins: Vec<(f64, f64)> = counts
        .iter()
        .enumerate()
        .filter(|(_, n)| **n > 0)
        .map(|(v, n)| (v as f64, *n as f64))
        .collect();
    let (Some(least), Some(most)) = (bins.first(), bins.last()) else {
        return 0.5;
    };
    if bins.len() == 1 {
        // A single value is above the threshold, unless it is 0.
        return 0.5;
    }
    let mut level = (least.0 + most.0) / 2.0;
    // Converges after a few steps; the limit guards against oscillation by rounding.
    for _ in 0..100 {
        let mean = |above: bool| {
            let (sum, count) = bins
                .iter()
                .filter(|k| (k.0 > level) == above)
                .fold((0.0, 0.0), |(s, n), k| (s + k.0 * k.1, n + k.1));
            sum / count
        };
        let next = (mean(true) + mean(false)) / 2.0;
        if next == level {
            break;
        }
        level = next;
    }
    level
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageBuffer, LumaA, Rgba};

    const SIDE: u32 = 20;

    /// Returns whether a pixel lies in the test disc.
    fn inside(x: u32, y: u32) -> bool {
        (x as f32 - 8.0).hypot(y as f32 - 9.0) < 5.2
    }

    fn area() -> usize {
        (0..SIDE * SIDE)
            .filter(|p| inside(p % SIDE, p / SIDE))
            .count()
    }

    /// Saves an image, reads it as a mask and returns the area.
    fn read(picture: impl Into<DynamicImage>, name: &str) -> usize {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        picture.into().save(&path).unwrap();
        MaskImage::load(&path).unwrap().area()
    }

    #[test]
    fn all_ways_to_save_a_mask_have_the_same_pixels() {
        for (low, high) in [(0, 255), (0, 1), (0, 128), (3, 9), (100, 101)] {
            let picture = GrayImage::from_fn(SIDE, SIDE, |x, y| {
                Luma([if inside(x, y) { high } else { low }])
            });
            assert_eq!(read(picture, "a.png"), area(), "{low} and {high}");
        }
        for (low, high) in [(0u16, 1u16), (0, 65535), (0, 255), (300, 301)] {
            let picture: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_fn(SIDE, SIDE, |x, y| {
                Luma([if inside(x, y) { high } else { low }])
            });
            assert_eq!(read(picture, "a.png"), area(), "16 bits, {low} and {high}");
        }
        let in_alpha: image::RgbaImage = ImageBuffer::from_fn(SIDE, SIDE, |x, y| {
            Rgba([7, 7, 7, if inside(x, y) { 255 } else { 0 }])
        });
        assert_eq!(read(in_alpha, "a.png"), area());
        let opaque: image::RgbaImage = ImageBuffer::from_fn(SIDE, SIDE, |x, y| {
            Rgba(if inside(x, y) {
                [200, 0, 0, 255]
            } else {
                [0, 0, 0, 255]
            })
        });
        assert_eq!(read(opaque, "a.png"), area());
        let gray: ImageBuffer<LumaA<u8>, _> = ImageBuffer::from_fn(SIDE, SIDE, |x, y| {
            LumaA([255, if inside(x, y) { 255 } else { 0 }])
        });
        assert_eq!(read(gray, "a.png"), area());
        // JPEG compression and soft edges may change a tenth of the area.
        let binary = GrayImage::from_fn(SIDE, SIDE, |x, y| {
            Luma([if inside(x, y) { 255 } else { 0 }])
        });
        let soft = image::imageops::blur(&binary, 0.7);
        for found in [read(binary, "a.jpg"), read(soft, "a.png")] {
            assert!(
                found.abs_diff(area()) * 10 <= area(),
                "{found} of {}",
                area()
            );
        }
    }

    #[test]
    fn palettes_are_read_by_colour_or_by_index() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        for (palette, name) in [
            ([0, 0, 0, 128, 0, 0], "DAVIS"),
            ([0, 0, 0, 255, 255, 255], "two colours"),
            ([9, 9, 9, 9, 9, 9], "one colour"),
        ] {
            let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), SIDE, SIDE);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_palette(palette.to_vec());
            let places: Vec<u8> = (0..SIDE * SIDE)
                .map(|p| u8::from(inside(p % SIDE, p / SIDE)))
                .collect();
            encoder
                .write_header()
                .unwrap()
                .write_image_data(&places)
                .unwrap();
            assert_eq!(MaskImage::load(&path).unwrap().area(), area(), "{name}");
        }
    }

    #[test]
    fn pictures_of_one_value_are_all_or_nothing() {
        for (value, expected) in [(0, 0), (1, SIDE * SIDE), (255, SIDE * SIDE)] {
            assert_eq!(
                read(GrayImage::from_pixel(SIDE, SIDE, Luma([value])), "a.png"),
                expected as usize
            );
        }
    }
}
