//! Draws answers as images.

use fastlgs_core::turbo;
use image::{GrayImage, Luma, Rgb, RgbImage};

/// Highlights the pixels of a mask in an image, and darkens all others.
pub fn overlay(color: &RgbImage, mask: &[bool]) -> RgbImage {
    RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let c = color.get_pixel(x, y).0;
        Rgb(if mask[(y * color.width() + x) as usize] {
            [c[0] / 2 + 127, c[1] / 2 + 40, c[2] / 2]
        } else {
            c.map(|v| v / 3)
        })
    })
}

/// Blends the relevancy of each pixel (0 to 1), in turbo colours, with an image at 3 : 1.
pub fn heatmap(color: &RgbImage, relevancy: &[f32]) -> RgbImage {
    RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let heat = turbo::turbo(relevancy[(y * color.width() + x) as usize]);
        let c = color.get_pixel(x, y).0;
        Rgb(std::array::from_fn(|k| {
            ((u16::from(heat[k]) * 3 + u16::from(c[k])) / 4) as u8
        }))
    })
}

/// Converts a mask to an image: 255 inside, 0 outside.
pub fn mask_picture(mask: &[bool], width: u32, height: u32) -> GrayImage {
    GrayImage::from_fn(width, height, |x, y| {
        Luma([if mask[(y * width + x) as usize] {
            255
        } else {
            0
        }])
    })
}
