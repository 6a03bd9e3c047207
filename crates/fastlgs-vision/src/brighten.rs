//! Brightens dark photos to the level that the networks were trained on.

use image::RgbImage;

/// Target of the mean luminance of dark photos, as a share of white: about that of ImageNet.
const TARGET: f32 = 0.45;
/// Smallest gamma, which brightens most. Below it, mostly sensor noise becomes visible.
const LEAST_GAMMA: f32 = 0.45;

/// Returns the photo; if it is dark, its mid-tones are brightened by a gamma curve.
pub fn brightened(photo: &RgbImage) -> RgbImage {
    let pixels = (photo.width() * photo.height()).max(1) as f32;
    let luminance = |p: &image::Rgb<u8>| {
        0.2126 * f32::from(p[0]) + 0.7152 * f32::from(p[1]) + 0.0722 * f32::from(p[2])
    };
    let mean = photo.pixels().map(luminance).sum::<f32>() / pixels / 255.0;
    let gamma = (TARGET.ln() / mean.clamp(0.01, 0.99).ln()).clamp(LEAST_GAMMA, 1.0);
    let table: [u8; 256] =
        std::array::from_fn(|v| (255.0 * (v as f32 / 255.0).powf(gamma)).round() as u8);
    let mut out = photo.clone();
    out.pixels_mut()
        .for_each(|p| p.0 = p.0.map(|v| table[usize::from(v)]));
    out
}

#[cfg(test)]
mod tests {
    use super::brightened;
    use image::{Rgb, RgbImage};

    #[test]
    fn dark_photos_are_lifted_and_bright_ones_stay() {
        let dark = RgbImage::from_pixel(4, 4, Rgb([50, 50, 50]));
        assert!((i32::from(brightened(&dark).get_pixel(0, 0)[0]) - 115).abs() < 8);
        let bright = RgbImage::from_pixel(4, 4, Rgb([150, 120, 130]));
        assert_eq!(brightened(&bright), bright);
    }
}
