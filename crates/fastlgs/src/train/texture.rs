//! Measures how much of the photos has no texture.

use crate::Result;
use fastlgs_raster::{TargetImage, Targets};
use rayon::prelude::*;

/// Number of cells along the longer side of an image, in which texture is measured.
const CELLS: usize = 128;
/// Standard deviation of grey values (0 to 255) from which an image has texture. Plane sweep stereo
/// has the same limit.
const MIN_DEVIATION: f32 = 3.0;

/// Returns the mean share of the training images that has no texture, 0 to 1.
///
/// # Errors
/// An image that cannot be read.
pub fn bare_share(targets: &Targets) -> Result<f32> {
    let share = |id: usize| Ok(bare_share_of(&targets.get(id)?.image));
    let shares: Vec<f32> = (0..targets.len())
        .into_par_iter()
        .map(share)
        .collect::<Result<_>>()?;
    Ok(shares.iter().sum::<f32>() / shares.len().max(1) as f32)
}

/// Returns the share of the cells of an image that have no texture, each together with the eight
/// cells around it.
fn bare_share_of(image: &TargetImage) -> f32 {
    let [width, height] = image.size.map(|side| side as usize);
    let side = width.max(height).div_ceil(CELLS);
    let [columns, rows] = [width, height].map(|pixels| pixels.div_ceil(side));
    // Number, sum and sum of squares of the grey values of each cell.
    let mut sums = vec![[0.0f32; 3]; columns * rows];
    for (pixel, color) in image.color.iter().enumerate() {
        let grey = grey(*color);
        let cell = pixel / width / side * columns + pixel % width / side;
        sums[cell]
            .iter_mut()
            .zip([1.0, grey, grey * grey])
            .for_each(|(sum, value)| *sum += value);
    }
    let is_bare = |cell: &usize| {
        let (x, y) = (cell % columns, cell / columns);
        let around = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
        let mut total = [0.0f32; 3];
        for y in around(y, rows) {
            for x in around(x, columns) {
                let cell = sums[y * columns + x];
                total
                    .iter_mut()
                    .zip(cell)
                    .for_each(|(sum, own)| *sum += own);
            }
        }
        let [n, sum, squares] = total;
        squares / n - (sum / n).powi(2) < MIN_DEVIATION * MIN_DEVIATION
    };
    (0..sums.len()).filter(is_bare).count() as f32 / sums.len() as f32
}

/// Returns the grey value of a packed pixel, 0 to 255.
fn grey(packed: u32) -> f32 {
    let [r, g, b, _] = packed.to_le_bytes().map(f32::from);
    0.299 * r + 0.587 * g + 0.114 * b
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_raster::pack;

    #[test]
    fn half_of_a_photo_is_bare() {
        let color = (0..256 * 64).map(|pixel| {
            let noisy = pixel % 256 < 128 && (pixel / 3 + pixel / 256) % 2 == 0;
            pack([if noisy { 120 } else { 100 }; 3], true)
        });
        let image = TargetImage {
            size: [256, 64],
            color: color.collect(),
            ..TargetImage::default()
        };
        let share = bare_share_of(&image);
        assert!((share - 0.5).abs() < 0.02, "{share}");
    }
}
