//! Reads, resizes and writes 8-bit images.

use crate::{Error, Result, fs};
use image::metadata::Orientation;
use image::{
    DynamicImage, GrayImage, ImageDecoder, ImageFormat, ImageReader, RgbImage, imageops::FilterType,
};
use std::io::Cursor;
use std::path::Path;

/// Reads an image as 8-bit RGB and applies its EXIF orientation.
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
    let (mut picture, orientation) = decode_stored(path, data)?;
    picture.apply_orientation(orientation);
    Ok(picture)
}

/// Decodes the pixels as stored. Also returns the EXIF orientation that turns them upright.
fn decode_stored(path: &Path, data: &[u8]) -> Result<(DynamicImage, Orientation)> {
    let reader = ImageReader::new(Cursor::new(data))
        .with_guessed_format()
        .map_err(Error::io(path))?;
    let failed = |e: image::ImageError| {
        Error::format(
            path,
            format!("the image cannot be read ({e}); export it again or remove it"),
        )
    };
    if reader.format() == Some(ImageFormat::Jpeg) && !is_whole_jpeg(data) {
        return Err(Error::format(
            path,
            "the image is cut off: its JPEG data have no end marker; copy it again or remove it",
        ));
    }
    let mut decoder = reader.into_decoder().map_err(failed)?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok((
        DynamicImage::from_decoder(decoder).map_err(failed)?,
        orientation,
    ))
}

/// Returns whether JPEG data have an end marker. Decoders fill missing data with grey instead of
/// failing.
///
/// A marker is the byte 0xff and a code. Most markers start a segment, which begins with its
/// length. The compressed data after a scan segment have no length; they end at the next marker.
fn is_whole_jpeg(data: &[u8]) -> bool {
    const END: u8 = 0xd9;
    const SCAN: u8 = 0xda;
    // Restart markers (RST), start of image (SOI) and TEM have no segment.
    let has_no_segment = |code: u8| matches!(code, 0x01 | 0xd0..=0xd8);
    let mut at = 0;
    loop {
        // In scan data, 0xff00 is a byte of data and restart markers do not end them. 0xff may be
        // repeated before a code.
        let marker = (at..data.len().saturating_sub(1))
            .find(|k| data[*k] == 0xff && !matches!(data[k + 1], 0x00 | 0xff));
        let Some(marker) = marker else { return false };
        let code = data[marker + 1];
        at = marker + 2;
        if code == END {
            return true;
        }
        if has_no_segment(code) {
            continue;
        }
        let Some([high, low]) = data
            .get(at..at + 2)
            .and_then(|length| <[u8; 2]>::try_from(length).ok())
        else {
            return false;
        };
        at += usize::from(u16::from_be_bytes([high, low]));
        if at > data.len() || (code == SCAN && at == data.len()) {
            return false;
        }
    }
}

/// A decoded photo.
pub struct Photo {
    /// Colours, not premultiplied by alpha.
    pub pixels: RgbImage,
    /// Alpha channel, 0 to 255; `None` without one or if it is opaque everywhere.
    pub alpha: Option<GrayImage>,
}

/// How the EXIF orientation of a photo is applied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OrientationRule {
    /// Always applies it. For photos without poses.
    Upright,
    /// Matches the pixels to a pose that was computed for a photo of this width and height. COLMAP
    /// and nerfstudio use pixels as stored, so square and upside-down photos stay as they are. If
    /// the sides are swapped, the photo was rotated before its pose was computed, and the
    /// orientation is applied.
    AsPosed(u32, u32),
}

/// Reads a photo as 8-bit RGB with its alpha channel.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_photo(path: &Path, rule: OrientationRule) -> Result<Photo> {
    let (mut decoded, orientation) = decode_stored(path, &fs::read(path)?)?;
    let is_tall = |(width, height): (u32, u32)| height > width;
    let sides = (decoded.width(), decoded.height());
    let turns = match rule {
        OrientationRule::Upright => true,
        OrientationRule::AsPosed(width, height) => {
            use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
            let on_its_side = matches!(
                orientation,
                Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH
            );
            on_its_side && sides.0 != sides.1 && is_tall((width, height)) != is_tall(sides)
        }
    };
    if turns {
        decoded.apply_orientation(orientation);
    }
    let alpha = decoded.color().has_alpha().then(|| {
        let rgba = decoded.to_rgba8();
        GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| {
            image::Luma([rgba.get_pixel(x, y)[3]])
        })
    });
    let transparent = |a: &GrayImage| a.pixels().any(|p| p[0] < 255);
    Ok(Photo {
        pixels: decoded.into_rgb8(),
        alpha: alpha.filter(transparent),
    })
}

/// Reads an image as brightness, 0 to 255. [`mask_image`](crate::mask_image) reads masks of other
/// programs.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_gray(path: &Path) -> Result<GrayImage> {
    Ok(decode(path)?.into_luma8())
}

/// Reads an image with its own channels and bit depth and applies its EXIF orientation.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_any(path: &Path) -> Result<DynamicImage> {
    decode(path)
}

/// Returns width and height without decoding the pixels. Ignores the EXIF orientation.
///
/// # Errors
/// As [`load_rgb`].
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let reader = ImageReader::open(path)
        .map_err(Error::io(path))?
        .with_guessed_format()
        .map_err(Error::io(path))?;
    reader.into_dimensions().map_err(|e| {
        Error::format(
            path,
            format!("the image cannot be read ({e}); copy or export it again"),
        )
    })
}

/// Returns channels and bit depth without decoding the pixels.
///
/// # Errors
/// As [`load_rgb`].
pub fn color_type(path: &Path) -> Result<image::ColorType> {
    let reader = ImageReader::open(path)
        .map_err(Error::io(path))?
        .with_guessed_format()
        .map_err(Error::io(path))?;
    let decoder = reader.into_decoder().map_err(|e| {
        Error::format(
            path,
            format!("the image cannot be read ({e}); copy or export it again"),
        )
    })?;
    Ok(decoder.color_type())
}

/// Resizes a photo with a triangle filter, which averages over the footprint when it shrinks.
pub fn resize(photo: &RgbImage, width: u32, height: u32) -> RgbImage {
    if photo.dimensions() == (width, height) {
        return photo.clone();
    }
    image::imageops::resize(photo, width, height, FilterType::Triangle)
}

/// As [`resize`], for grey images.
pub fn resize_gray(mask: &GrayImage, width: u32, height: u32) -> GrayImage {
    image::imageops::resize(mask, width, height, FilterType::Triangle)
}

/// Encodes an image as PNG.
///
/// # Errors
/// [`Error::Invalid`] when encoding fails, such as for an image without pixels.
pub fn encode_png(picture: impl Into<DynamicImage>) -> Result<Vec<u8>> {
    let mut data = Vec::new();
    let encode = picture
        .into()
        .write_to(&mut Cursor::new(&mut data), ImageFormat::Png);
    encode.map_err(|e| Error::Invalid(format!("an image cannot be encoded as PNG: {e}")))?;
    Ok(data)
}

/// Largest image that is decoded from memory, in pixels. A few compressed bytes can expand to a
/// huge image.
const MAX_PHOTO_PIXELS: u64 = 100_000_000;

/// Decodes an image in memory as 8-bit RGB. Errors call it `name`.
///
/// # Errors
/// [`Error::Format`] when it cannot be decoded or has more than 100 million pixels.
pub fn decode_rgb(name: &str, data: &[u8]) -> Result<RgbImage> {
    let path = Path::new(name);
    let sides = ImageReader::new(Cursor::new(data))
        .with_guessed_format()
        .ok()
        .and_then(|reader| reader.into_dimensions().ok());
    if let Some((width, height)) =
        sides.filter(|(w, h)| u64::from(*w) * u64::from(*h) > MAX_PHOTO_PIXELS)
    {
        return Err(Error::format(
            path,
            format!(
                "{width}x{height} pixels is too large; at most {} million pixels are accepted",
                MAX_PHOTO_PIXELS / 1_000_000
            ),
        ));
    }
    Ok(decode_bytes(path, data)?.into_rgb8())
}

/// Writes a PNG atomically.
///
/// # Errors
/// [`Error::Io`] with the path, or [`Error::Invalid`] when encoding fails.
pub fn save_png(path: &Path, picture: impl Into<DynamicImage>) -> Result<()> {
    let data = encode_png(picture)?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// Converts 8-bit RGB to planar floats `[3][h][w]` in [0, 1].
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

/// Converts planar floats `[3][h][w]` to 8-bit RGB. Values are clamped to [0, 1] and rounded.
pub fn from_planar(planar: &[f32], width: u32, height: u32) -> RgbImage {
    let n = (width * height) as usize;
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    RgbImage::from_fn(width, height, |i, j| {
        let p = (j * width + i) as usize;
        image::Rgb([
            byte(planar[p]),
            byte(planar[n + p]),
            byte(planar[2 * n + p]),
        ])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a JPEG with an EXIF orientation: 6 asks for a clockwise quarter turn, 3 for a half
    /// turn.
    fn turned(width: u32, height: u32, orientation: u8) -> (tempfile::TempDir, std::path::PathBuf) {
        // As stored, the left half is red and the right half blue.
        let picture = RgbImage::from_fn(width, height, |x, _| {
            image::Rgb(if x < width / 2 {
                [250, 0, 0]
            } else {
                [0, 0, 250]
            })
        });
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95)
            .encode_image(&picture)
            .expect("a JPEG");
        let entry = [1, 0x12, 0, 3, 0, 0, 0, 1, 0, orientation, 0, 0, 0, 0, 0, 0];
        let tiff = [b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01".as_slice(), &entry].concat();
        let segment = [
            &[0xff, 0xe1],
            (tiff.len() as u16 + 2).to_be_bytes().as_slice(),
            &tiff,
        ]
        .concat();
        jpeg.splice(2..2, segment);
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("photo.jpg");
        std::fs::write(&path, jpeg).expect("a file");
        (dir, path)
    }

    #[test]
    fn orientation_is_applied_unless_poses_refer_to_stored_pixels() {
        let (_dir, path) = turned(64, 32, 6);
        assert_eq!(load_rgb(&path).unwrap().dimensions(), (32, 64));
        let upright = load_photo(&path, OrientationRule::Upright).unwrap().pixels;
        assert_eq!(upright.dimensions(), (32, 64));
        let (top, bottom) = (upright.get_pixel(16, 10), upright.get_pixel(16, 54));
        assert!(
            top[0] > 200 && bottom[2] > 200,
            "the stored left half must be on top: {top:?}, {bottom:?}"
        );
        for ((w, h), sides) in [((3024, 4032), (32, 64)), ((4032, 3024), (64, 32))] {
            assert_eq!(
                load_photo(&path, OrientationRule::AsPosed(w, h))
                    .unwrap()
                    .pixels
                    .dimensions(),
                sides,
                "{w}x{h}"
            );
        }
        // The sides of square and upside-down photos do not change.
        for (orientation, red) in [(6, (16, 4)), (8, (16, 28)), (3, (28, 16))] {
            let (_dir, square) = turned(32, 32, orientation);
            let upright = load_photo(&square, OrientationRule::Upright)
                .unwrap()
                .pixels;
            assert!(
                upright.get_pixel(red.0, red.1)[0] > 200,
                "orientation {orientation}"
            );
            let stored = load_photo(&square, OrientationRule::AsPosed(32, 32))
                .unwrap()
                .pixels;
            assert!(
                stored.get_pixel(4, 16)[0] > 200,
                "poses refer to stored pixels, orientation {orientation}"
            );
        }
    }

    #[test]
    fn a_jpeg_that_was_cut_off_is_refused() {
        let (_dir, path) = turned(64, 48, 1);
        let whole = std::fs::read(&path).unwrap();
        for data in [
            whole.clone(),
            [whole.as_slice(), &[0; 100]].concat(),
            [whole.as_slice(), b"a film behind it"].concat(),
        ] {
            std::fs::write(&path, data).unwrap();
            load_rgb(&path).unwrap();
        }
        let zeros = [&whole[..whole.len() / 2], &vec![0; whole.len() / 2]].concat();
        for data in [
            whole[..whole.len() - 2].to_vec(),
            whole[..whole.len() * 2 / 3].to_vec(),
            whole[..300].to_vec(),
            zeros,
        ] {
            std::fs::write(&path, data).unwrap();
            let refused = load_photo(&path, OrientationRule::Upright)
                .err()
                .expect("refused")
                .to_string();
            assert!(
                refused.contains("photo.jpg") && refused.contains("cut off"),
                "{refused}"
            );
        }
    }
}
