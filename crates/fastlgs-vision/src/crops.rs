//! Crops of masks for image encoders.

use fastlgs_core::LabelMap;
use image::imageops::{FilterType, resize};
use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};

/// A square crop, `size` x `size`, planar RGB in [0, 255].
pub struct Crop {
    /// `[3][size][size]`.
    pub planar: Vec<f32>,
}

/// Treatment of the pixels outside of the mask in a crop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surround {
    /// Painted with mid grey.
    Neutral,
    /// Unchanged, with a wider margin around the box.
    Context,
}

/// Cuts the box of `label`, widened to a square with a margin. Scales it to `size` pixels: each
/// pixel is the mean of up to 4 x 4 samples. Pixels outside of the photo are mid grey.
///
/// `bounds` is the box of `label`: left, top, right and bottom in pixels of `masks`.
pub fn crop(
    photo: &RgbImage,
    masks: &LabelMap,
    label: u16,
    bounds: [u32; 4],
    size: usize,
    surround: Surround,
) -> Crop {
    let [x0, y0, x1, y1] = bounds.map(|v| v as f32);
    // Masks may be coarser than the photo.
    let (sx, sy) = (
        photo.width() as f32 / masks.width as f32,
        photo.height() as f32 / masks.height as f32,
    );
    let margin = if surround == Surround::Context {
        CONTEXT_MARGIN
    } else {
        MARGIN
    };
    let side = (((x1 - x0) * sx).max((y1 - y0) * sy) * margin).max(4.0);
    let (left, top) = (
        (x0 + x1) / 2.0 * sx - side / 2.0,
        (y0 + y1) / 2.0 * sy - side / 2.0,
    );
    let step = side / size as f32;
    let taps = (step.ceil() as usize).clamp(1, 4);
    let n = size * size;
    let mut planar = vec![127.0; 3 * n];
    for j in 0..size {
        for i in 0..size {
            let mut sum = [0.0f32; 3];
            for t in 0..taps * taps {
                let (u, v) = ((t % taps) as f32 + 0.5, (t / taps) as f32 + 0.5);
                let x = left + (i as f32 + u / taps as f32) * step;
                let y = top + (j as f32 + v / taps as f32) * step;
                let inside = x >= 0.0
                    && y >= 0.0
                    && (x as u32) < photo.width()
                    && (y as u32) < photo.height();
                let visible = inside && {
                    let (mx, my) = (
                        ((x / sx) as u32).min(masks.width - 1),
                        ((y / sy) as u32).min(masks.height - 1),
                    );
                    surround == Surround::Context || masks.at(mx, my) == label
                };
                let pixel = if visible {
                    photo.get_pixel(x as u32, y as u32).0.map(f32::from)
                } else {
                    [127.0; 3]
                };
                (0..3).for_each(|k| sum[k] += pixel[k]);
            }
            for k in 0..3 {
                planar[k * n + j * size + i] = sum[k] / (taps * taps) as f32;
            }
        }
    }
    Crop { planar }
}

/// Side of a crop, relative to the longer side of the mask's box.
const MARGIN: f32 = 1.05;
/// The same for crops with context.
const CONTEXT_MARGIN: f32 = 1.25;

/// Background of the mask in a crop for CLIP. The best choice depends on the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Mid grey.
    #[default]
    Grey,
    /// Black, as in LangSplat.
    Black,
    /// The photo, blurred.
    Blurred,
    /// The photo itself, with a wider margin around the box.
    Context,
}

impl Background {
    /// All backgrounds.
    pub const ALL: [Self; 4] = [Self::Grey, Self::Black, Self::Blurred, Self::Context];
    /// Names of all backgrounds, in the same order.
    pub const NAMES: [&str; 4] = ["grey", "black", "blurred", "context"];

    /// Returns the background of a name; `None` for an unknown one.
    pub fn by_name(name: &str) -> Option<Self> {
        let place = Self::NAMES.iter().position(|known| *known == name)?;
        Some(Self::ALL[place])
    }
}

/// Side in pixels to which a blurred background is reduced: it still shows the kind of place, but
/// no objects.
const BLUR_SIDE: u32 = 12;

/// Cuts the box of `label` with the given background, and scales it as CLIP's preprocessing does:
/// bicubic, antialiased. `bounds` is the box of `label`, as in [`crop`].
pub fn bicubic(
    photo: &RgbImage,
    masks: &LabelMap,
    label: u16,
    bounds: [u32; 4],
    size: usize,
    background: Background,
) -> Crop {
    let [x0, y0, x1, y1] = bounds.map(|v| v as f32);
    let (sx, sy) = (
        photo.width() as f32 / masks.width as f32,
        photo.height() as f32 / masks.height as f32,
    );
    let margin = if background == Background::Context {
        CONTEXT_MARGIN
    } else {
        MARGIN
    };
    let side = (((x1 - x0) * sx).max((y1 - y0) * sy) * margin)
        .round()
        .max(4.0) as u32;
    let corner =
        |a: f32, b: f32, scale: f32| ((a + b) / 2.0 * scale - side as f32 / 2.0).round() as i64;
    let (left, top) = (corner(x0, x1, sx), corner(y0, y1, sy));
    let source_pixel = |i: u32, j: u32| {
        let (x, y) = (
            u32::try_from(left + i64::from(i)).ok()?,
            u32::try_from(top + i64::from(j)).ok()?,
        );
        (x < photo.width() && y < photo.height()).then_some((x, y))
    };
    let inside = |(x, y): &(u32, u32)| {
        let mask = |v: u32, scale: f32, end: u32| ((v as f32 / scale) as u32).min(end - 1);
        masks.at(mask(*x, sx, masks.width), mask(*y, sy, masks.height)) == label
    };
    let plain = Rgb(if background == Background::Black {
        [0; 3]
    } else {
        [127; 3]
    });
    let backdrop = (background == Background::Blurred).then(|| {
        let all = RgbImage::from_fn(side, side, |i, j| {
            source_pixel(i, j).map_or(plain, |(x, y)| *photo.get_pixel(x, y))
        });
        let blurred = resize(
            &all,
            BLUR_SIDE.min(side),
            BLUR_SIDE.min(side),
            FilterType::Triangle,
        );
        resize(&blurred, side, side, FilterType::Triangle)
    });
    let shown = |pixel: &(u32, u32)| background == Background::Context || inside(pixel);
    let cut = RgbImage::from_fn(side, side, |i, j| match source_pixel(i, j).filter(shown) {
        Some((x, y)) => *photo.get_pixel(x, y),
        None => backdrop
            .as_ref()
            .map_or(plain, |around| *around.get_pixel(i, j)),
    });
    let scaled = resize(&cut, size as u32, size as u32, FilterType::CatmullRom);
    let mut planar = vec![0.0; 3 * size * size];
    for (p, pixel) in scaled.pixels().enumerate() {
        (0..3).for_each(|k| planar[k * size * size + p] = f32::from(pixel[k]));
    }
    Crop { planar }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crops_show_their_mask_and_hide_the_rest() {
        // A red block in a green picture; the mask is taller than the block.
        let within = |v: u32| (24..40).contains(&v);
        let photo = RgbImage::from_fn(64, 64, |x, y| {
            Rgb(if within(x) && within(y) {
                [255, 0, 0]
            } else {
                [0, 255, 0]
            })
        });
        let labels = (0..64 * 64)
            .map(|p| u16::from(within(p % 64) && (20..44).contains(&(p / 64))))
            .collect();
        let masks = LabelMap {
            width: 64,
            height: 64,
            labels,
        };
        let bounds = masks.boxes()[1].expect("a mask");
        let at =
            |crop: &Crop, x: usize, y: usize| [0, 1, 2].map(|k| crop.planar[k * 1024 + y * 32 + x]);
        let [sampled, scaled] = [
            crop(&photo, &masks, 1, bounds, 32, Surround::Neutral),
            bicubic(&photo, &masks, 1, bounds, 32, Background::Grey),
        ];
        let surroundings = bicubic(&photo, &masks, 1, bounds, 32, Background::Context);
        assert_eq!(at(&surroundings, 1, 16), [0.0, 255.0, 0.0]);
        for crop in [&sampled, &scaled] {
            assert_eq!(
                [at(crop, 16, 16), at(crop, 16, 3), at(crop, 1, 16)],
                [[255.0, 0.0, 0.0], [0.0, 255.0, 0.0], [127.0; 3]]
            );
        }
        let [black, blurred] = [Background::Black, Background::Blurred]
            .map(|around| bicubic(&photo, &masks, 1, bounds, 32, around));
        assert_eq!(
            [at(&black, 16, 16), at(&black, 1, 16)],
            [[255.0, 0.0, 0.0], [0.0; 3]]
        );
        let [red, green, blue] = at(&blurred, 4, 16);
        assert_eq!((at(&blurred, 16, 16), blue), ([255.0, 0.0, 0.0], 0.0));
        assert!(
            red > 20.0 && green > 20.0,
            "the blurred background contains both colours: {red}, {green}"
        );
        let context = crop(&photo, &masks, 1, bounds, 32, Surround::Context);
        assert_eq!(at(&context, 1, 16), [0.0, 255.0, 0.0]);
    }
}
