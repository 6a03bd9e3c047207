//! Crops of masks for image encoders.

use fastlgs_core::LabelMap;
use image::RgbImage;

/// A square crop, `size` x `size`, planar RGB in [0, 255].
pub struct Crop {
    /// `[3][size][size]`.
    pub planar: Vec<f32>,
}

/// How a crop treats what is not the mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surround {
    /// Painted with mid grey.
    Neutral,
    /// Left as it is, with some context around the box.
    Context,
}

/// Cuts the box of `label`, widened to a square, and scales it (bilinear, area-averaged by sampling).
pub fn crop(photo: &RgbImage, masks: &LabelMap, label: u16, bounds: [u32; 4], size: usize, surround: Surround) -> Crop {
    let [x0, y0, x1, y1] = bounds.map(|v| v as f32);
    // Masks may be coarser than the photo.
    let (sx, sy) = (photo.width() as f32 / masks.width as f32, photo.height() as f32 / masks.height as f32);
    let margin = if surround == Surround::Context { 1.25 } else { 1.05 };
    let side = (((x1 - x0) * sx).max((y1 - y0) * sy) * margin).max(4.0);
    let (left, top) = ((x0 + x1) / 2.0 * sx - side / 2.0, (y0 + y1) / 2.0 * sy - side / 2.0);
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
                let inside = x >= 0.0 && y >= 0.0 && (x as u32) < photo.width() && (y as u32) < photo.height();
                let shown = inside && {
                    let (mx, my) = (((x / sx) as u32).min(masks.width - 1), ((y / sy) as u32).min(masks.height - 1));
                    surround == Surround::Context || masks.at(mx, my) == label
                };
                let pixel = if shown { photo.get_pixel(x as u32, y as u32).0.map(f32::from) } else { [127.0; 3] };
                (0..3).for_each(|k| sum[k] += pixel[k]);
            }
            for k in 0..3 {
                planar[k * n + j * size + i] = sum[k] / (taps * taps) as f32;
            }
        }
    }
    Crop { planar }
}
