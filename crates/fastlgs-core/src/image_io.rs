//! Photos and pictures on disk.

use crate::{Error, Result, fs};
use image::{DynamicImage, GrayImage, ImageFormat, ImageReader, RgbImage, imageops::FilterType};
use std::io::Cursor;
use std::path::Path;

/// Reads a photo as 8-bit RGB.
///
/// # Errors
/// [`Error::Io`], or [`Error::Format`] when it cannot be decoded.
pub fn load_rgb(path: &Path) -> Result<RgbImage> {
    Ok(decode(path)?.into_rgb8())
}

fn decode(path: &Path) -> Result<DynamicImage> {
    decode_bytes(path, &fs::read(path)?)
}

fn decode_bytes(path: &Path, data: &[u8]) -> Result<DynamicImage> {
    let reader = ImageReader::new(Cursor::new(data)).with_guessed_format().map_err(Error::io(path))?;
    reader.decode().map_err(|e| Error::format(path, format!("the picture cannot be read ({e}); export it again or remove it")))
}

/// A photo with what it says about itself.
pub struct Photo {
    /// Colours, not multiplied by alpha.
    pub pixels: RgbImage,
    /// Coverage, 0 to 255, of photos with an alpha channel that is not opaque everywhere.
    pub alpha: Option<GrayImage>,
}

/// Reads a photo as 8-bit RGB, and its alpha channel.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_photo(path: &Path) -> Result<Photo> {
    let decoded = decode(path)?;
    let alpha = decoded.color().has_alpha().then(|| {
        let rgba = decoded.to_rgba8();
        GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| image::Luma([rgba.get_pixel(x, y)[3]]))
    });
    let transparent = |a: &GrayImage| a.pixels().any(|p| p[0] < 255);
    Ok(Photo { pixels: decoded.into_rgb8(), alpha: alpha.filter(transparent) })
}

/// Reads a mask: brightness, 0 to 255.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_gray(path: &Path) -> Result<GrayImage> {
    Ok(decode(path)?.into_luma8())
}

/// Width and height without decoding the pixels.
///
/// # Errors
/// As [`load_rgb`].
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let reader = ImageReader::open(path).map_err(Error::io(path))?.with_guessed_format().map_err(Error::io(path))?;
    reader.into_dimensions().map_err(|e| Error::format(path, format!("the photo cannot be read ({e})")))
}

/// Area-like downscaling (triangle filter over the footprint).
pub fn resize(photo: &RgbImage, width: u32, height: u32) -> RgbImage {
    if photo.dimensions() == (width, height) {
        return photo.clone();
    }
    image::imageops::resize(photo, width, height, FilterType::Triangle)
}

/// As [`resize`], for masks.
pub fn resize_gray(mask: &GrayImage, width: u32, height: u32) -> GrayImage {
    image::imageops::resize(mask, width, height, FilterType::Triangle)
}

/// A picture as PNG.
///
/// # Errors
/// [`Error::Invalid`] for a picture without pixels.
pub fn encode_png(picture: impl Into<DynamicImage>) -> Result<Vec<u8>> {
    let mut data = Vec::new();
    let encode = picture.into().write_to(&mut Cursor::new(&mut data), ImageFormat::Png);
    encode.map_err(|e| Error::Invalid(format!("a picture cannot be encoded as PNG: {e}")))?;
    Ok(data)
}

/// Decodes a photo that is already in memory as 8-bit RGB; `name` is what errors call it.
///
/// # Errors
/// [`Error::Format`] when it cannot be decoded.
pub fn decode_rgb(name: &str, data: &[u8]) -> Result<RgbImage> {
    Ok(decode_bytes(Path::new(name), data)?.into_rgb8())
}

/// Writes a PNG atomically.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn save_png(path: &Path, picture: impl Into<DynamicImage>) -> Result<()> {
    let data = encode_png(picture)?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// 8-bit RGB to planar float `[3][h][w]` in [0, 1].
pub fn to_planar(photo: &RgbImage) -> Vec<f32> {
    let n = (photo.width() * photo.height()) as usize;
    let mut planar = vec![0.0; 3 * n];
    for (i, pixel) in photo.pixels().enumerate() {
        for k in 0..3 {
            planar[k * n + i] = f32::from(pixel[k]) / 255.0;
        }
    }
    planar
}

/// Planar float `[3][h][w]` in [0, 1] to 8-bit RGB, rounded and clamped.
pub fn from_planar(planar: &[f32], width: u32, height: u32) -> RgbImage {
    let n = (width * height) as usize;
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    RgbImage::from_fn(width, height, |i, j| {
        let p = (j * width + i) as usize;
        image::Rgb([byte(planar[p]), byte(planar[n + p]), byte(planar[2 * n + p])])
    })
}
