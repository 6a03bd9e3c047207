//! Photos and pictures on disk.

use crate::{Error, Result, fs};
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage, ImageDecoder, ImageFormat, ImageReader, RgbImage, imageops::FilterType};
use std::io::Cursor;
use std::path::Path;

/// Reads a picture as 8-bit RGB, the way up that its file says.
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
    let (mut picture, way_up) = stored(path, data)?;
    picture.apply_orientation(way_up);
    Ok(picture)
}

/// Pixels as they are stored, and what makes of them the picture that is meant (EXIF).
fn stored(path: &Path, data: &[u8]) -> Result<(DynamicImage, Orientation)> {
    let reader = ImageReader::new(Cursor::new(data)).with_guessed_format().map_err(Error::io(path))?;
    let failed = |e: image::ImageError| Error::format(path, format!("the picture cannot be read ({e}); export it again or remove it"));
    if reader.format() == Some(ImageFormat::Jpeg) && !is_whole_jpeg(data) {
        return Err(Error::format(path, "the picture is cut off: its JPEG data end too early; copy it again or remove it"));
    }
    let mut decoder = reader.into_decoder().map_err(failed)?;
    let way_up = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok((DynamicImage::from_decoder(decoder).map_err(failed)?, way_up))
}

/// Whether JPEG data have an end. Decoders show grey for what was cut off.
///
/// After each marker (0xff and a code) comes a segment of a stated length; the picture itself has no length, and ends at the next marker.
fn is_whole_jpeg(data: &[u8]) -> bool {
    const END: u8 = 0xd9;
    const SCAN: u8 = 0xda;
    // Restarts, the start of the picture, and a private marker stand alone.
    let stands_alone = |code: u8| matches!(code, 0x01 | 0xd0..=0xd8);
    let mut at = 0;
    loop {
        // Within a picture 0xff00 is a byte of it, and restarts do not end it; 0xff may be repeated before a code.
        let marker = (at..data.len().saturating_sub(1)).find(|k| data[*k] == 0xff && !matches!(data[k + 1], 0x00 | 0xff));
        let Some(marker) = marker else { return false };
        let code = data[marker + 1];
        at = marker + 2;
        if code == END {
            return true;
        }
        if stands_alone(code) {
            continue;
        }
        let Some([high, low]) = data.get(at..at + 2).and_then(|length| <[u8; 2]>::try_from(length).ok()) else { return false };
        at += usize::from(u16::from_be_bytes([high, low]));
        if at > data.len() || (code == SCAN && at == data.len()) {
            return false;
        }
    }
}

/// A photo with what it says about itself.
pub struct Photo {
    /// Colours, not multiplied by alpha.
    pub pixels: RgbImage,
    /// Coverage, 0 to 255, of photos with an alpha channel that is not opaque everywhere.
    pub alpha: Option<GrayImage>,
}

/// Which way up a photo is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WayUp {
    /// As its EXIF data say: photos without poses.
    Upright,
    /// As its pose counts pixels, which was found for a photo of these sides. COLMAP and nerfstudio count pixels as they are stored, so that squares
    /// and photos that are upside down stay as they are; one whose sides are swapped was turned before its pose was found.
    AsPosed(u32, u32),
}

/// Reads a photo as 8-bit RGB, and its alpha channel.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_photo(path: &Path, way_up: WayUp) -> Result<Photo> {
    let (mut decoded, orientation) = stored(path, &fs::read(path)?)?;
    let is_tall = |(width, height): (u32, u32)| height > width;
    let sides = (decoded.width(), decoded.height());
    let turns = match way_up {
        WayUp::Upright => true,
        WayUp::AsPosed(width, height) => {
            use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
            let on_its_side = matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH);
            on_its_side && sides.0 != sides.1 && is_tall((width, height)) != is_tall(sides)
        }
    };
    if turns {
        decoded.apply_orientation(orientation);
    }
    let alpha = decoded.color().has_alpha().then(|| {
        let rgba = decoded.to_rgba8();
        GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| image::Luma([rgba.get_pixel(x, y)[3]]))
    });
    let transparent = |a: &GrayImage| a.pixels().any(|p| p[0] < 255);
    Ok(Photo { pixels: decoded.into_rgb8(), alpha: alpha.filter(transparent) })
}

/// Reads a picture as brightness, 0 to 255; [`mask_image`](crate::mask_image) reads masks of other programs.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_gray(path: &Path) -> Result<GrayImage> {
    Ok(decode(path)?.into_luma8())
}

/// Decodes a picture with all its channels and bits, the way up that its file says.
///
/// # Errors
/// As [`load_rgb`].
pub fn load_any(path: &Path) -> Result<DynamicImage> {
    decode(path)
}

/// Width and height without decoding the pixels.
///
/// # Errors
/// As [`load_rgb`].
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let reader = ImageReader::open(path).map_err(Error::io(path))?.with_guessed_format().map_err(Error::io(path))?;
    reader.into_dimensions().map_err(|e| Error::format(path, format!("the photo cannot be read ({e})")))
}

/// Channels and bits of a picture, without decoding its pixels.
///
/// # Errors
/// As [`load_rgb`].
pub fn color_type(path: &Path) -> Result<image::ColorType> {
    let reader = ImageReader::open(path).map_err(Error::io(path))?.with_guessed_format().map_err(Error::io(path))?;
    let decoder = reader.into_decoder().map_err(|e| Error::format(path, format!("the picture cannot be read ({e})")))?;
    Ok(decoder.color_type())
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

/// Most pixels of a picture that came as bytes: few of these may stand for very many.
const MOST_PIXELS: u64 = 100_000_000;

/// Decodes a photo that is already in memory as 8-bit RGB; `name` is what errors call it.
///
/// # Errors
/// [`Error::Format`] when it cannot be decoded, or is larger than 100 million pixels.
pub fn decode_rgb(name: &str, data: &[u8]) -> Result<RgbImage> {
    let path = Path::new(name);
    let sides = ImageReader::new(Cursor::new(data)).with_guessed_format().ok().and_then(|reader| reader.into_dimensions().ok());
    if let Some((width, height)) = sides.filter(|(w, h)| u64::from(*w) * u64::from(*h) > MOST_PIXELS) {
        return Err(Error::format(path, format!("{width}x{height} is too large: at most {} million pixels", MOST_PIXELS / 1_000_000)));
    }
    Ok(decode_bytes(path, data)?.into_rgb8())
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG whose EXIF states an orientation: 6 is to be turned by a quarter, clockwise, 3 by a half.
    fn turned(width: u32, height: u32, orientation: u8) -> (tempfile::TempDir, std::path::PathBuf) {
        // Left half red, right half blue, as stored.
        let picture = RgbImage::from_fn(width, height, |x, _| image::Rgb(if x < width / 2 { [250, 0, 0] } else { [0, 0, 250] }));
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95).encode_image(&picture).expect("a JPEG");
        let entry = [1, 0x12, 0, 3, 0, 0, 0, 1, 0, orientation, 0, 0, 0, 0, 0, 0];
        let tiff = [b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01".as_slice(), &entry].concat();
        let segment = [&[0xff, 0xe1], (tiff.len() as u16 + 2).to_be_bytes().as_slice(), &tiff].concat();
        jpeg.splice(2..2, segment);
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("photo.jpg");
        std::fs::write(&path, jpeg).expect("a file");
        (dir, path)
    }

    #[test]
    fn photos_stand_upright_unless_their_poses_count_stored_pixels() {
        let (_dir, path) = turned(64, 32, 6);
        assert_eq!(load_rgb(&path).unwrap().dimensions(), (32, 64));
        let upright = load_photo(&path, WayUp::Upright).unwrap().pixels;
        assert_eq!(upright.dimensions(), (32, 64));
        let (top, bottom) = (upright.get_pixel(16, 10), upright.get_pixel(16, 54));
        assert!(top[0] > 200 && bottom[2] > 200, "what was left is above: {top:?}, {bottom:?}");
        for ((w, h), sides) in [((3024, 4032), (32, 64)), ((4032, 3024), (64, 32))] {
            assert_eq!(load_photo(&path, WayUp::AsPosed(w, h)).unwrap().pixels.dimensions(), sides, "{w}x{h}");
        }
        // Squares, and what is upside down: their sides do not change.
        for (orientation, red) in [(6, (16, 4)), (8, (16, 28)), (3, (28, 16))] {
            let (_dir, square) = turned(32, 32, orientation);
            let upright = load_photo(&square, WayUp::Upright).unwrap().pixels;
            assert!(upright.get_pixel(red.0, red.1)[0] > 200, "orientation {orientation}");
            let stored = load_photo(&square, WayUp::AsPosed(32, 32)).unwrap().pixels;
            assert!(stored.get_pixel(4, 16)[0] > 200, "poses count stored pixels, orientation {orientation}");
        }
    }

    #[test]
    fn a_jpeg_that_was_cut_off_is_refused() {
        let (_dir, path) = turned(64, 48, 1);
        let whole = std::fs::read(&path).unwrap();
        for data in [whole.clone(), [whole.as_slice(), &[0; 100]].concat(), [whole.as_slice(), b"a film behind it"].concat()] {
            std::fs::write(&path, data).unwrap();
            load_rgb(&path).unwrap();
        }
        let zeros = [&whole[..whole.len() / 2], &vec![0; whole.len() / 2]].concat();
        for data in [whole[..whole.len() - 2].to_vec(), whole[..whole.len() * 2 / 3].to_vec(), whole[..300].to_vec(), zeros] {
            std::fs::write(&path, data).unwrap();
            let refused = load_photo(&path, WayUp::Upright).err().expect("refused").to_string();
            assert!(refused.contains("photo.jpg") && refused.contains("cut off"), "{refused}");
        }
    }
}
