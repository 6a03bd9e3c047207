//! Mask logits on the decoder's coarse grid, cut to the window around the mask.

use crate::masks::BitMask;

/// A rectangle of a grid of logits.
#[derive(Clone, Debug)]
pub struct Window {
    left: usize,
    top: usize,
    width: usize,
    logits: Vec<f32>,
    /// Cells per pixel of the image, along x and y.
    scale: [f32; 2],
}

/// A grid of logits, row-major with `columns` cells per row. Only the first `shown` cells along x
/// and y cover the image; `scale` is the number of cells per pixel.
#[derive(Clone, Copy, Debug)]
pub struct Grid<'a> {
    pub logits: &'a [f32],
    pub columns: usize,
    pub covered_cells: [usize; 2],
    pub scale: [f32; 2],
}

impl Grid<'_> {
    fn row(&self, y: usize) -> &[f32] {
        &self.logits[y * self.columns..][..self.covered_cells[0]]
    }

    /// Returns the number of cells above a threshold.
    pub fn area(&self, threshold: f32) -> usize {
        (0..self.covered_cells[1])
            .map(|y| self.row(y).iter().filter(|v| **v > threshold).count())
            .sum()
    }

    /// Returns the smallest window around all cells above a threshold, with a margin of one cell
    /// for interpolation. Returns `None` if there are none.
    pub fn window(&self, threshold: f32) -> Option<Window> {
        let [width, height] = self.covered_cells;
        let mut b = [usize::MAX, usize::MAX, 0, 0];
        for y in 0..height {
            for (x, _) in self.row(y).iter().enumerate().filter(|v| *v.1 > threshold) {
                b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
            }
        }
        if b[2] == 0 {
            return None;
        }
        let (left, top, right, bottom) = (
            b[0].saturating_sub(1),
            b[1].saturating_sub(1),
            (b[2] + 1).min(width),
            (b[3] + 1).min(height),
        );
        let logits = (top..bottom)
            .flat_map(|y| self.row(y)[left..right].iter().copied())
            .collect();
        Some(Window {
            left,
            top,
            width: right - left,
            logits,
            scale: self.scale,
        })
    }
}

impl Window {
    fn height(&self) -> usize {
        self.logits.len() / self.width
    }

    /// Returns the logit at the centre of a pixel of the image, by bilinear interpolation.
    fn at(&self, x: u32, y: u32) -> f32 {
        let place = |pixel: u32, scale: f32, first: usize, count: usize| {
            let v =
                ((pixel as f32 + 0.5) * scale - 0.5 - first as f32).clamp(0.0, (count - 1) as f32);
            (v as usize, (v as usize + 1).min(count - 1), v.fract())
        };
        let (x0, x1, fx) = place(x, self.scale[0], self.left, self.width);
        let (y0, y1, fy) = place(y, self.scale[1], self.top, self.height());
        let row = |y: usize| {
            self.logits[y * self.width + x0] * (1.0 - fx) + self.logits[y * self.width + x1] * fx
        };
        row(y0) * (1.0 - fy) + row(y1) * fy
    }

    /// Returns left, top, right and bottom, in pixels of an image of that size, of the area that
    /// the window covers.
    fn bounds(&self, picture: [u32; 2]) -> [u32; 4] {
        let pixel = |cell: usize, k: usize| ((cell as f32 / self.scale[k]) as u32).min(picture[k]);
        let ends = [
            pixel(self.left + self.width, 0) + 1,
            pixel(self.top + self.height(), 1) + 1,
        ];
        [
            pixel(self.left, 0),
            pixel(self.top, 1),
            ends[0].min(picture[0]),
            ends[1].min(picture[1]),
        ]
    }

    /// Returns the number of pixels above a threshold in an image of that size.
    pub fn area(&self, picture: [u32; 2], threshold: f32) -> usize {
        let [x0, y0, x1, y1] = self.bounds(picture);
        (y0..y1)
            .map(|y| (x0..x1).filter(|x| self.at(*x, y) > threshold).count())
            .sum()
    }

    /// Returns the mask at the size of the image; `None` if no pixel is above 0.
    pub fn mask(&self, picture: [u32; 2]) -> Option<BitMask> {
        BitMask::from_fn(self.bounds(picture), |x, y| self.at(x, y) > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_grow_with_the_picture() {
        // Two of 4x3 cells are the mask; the last column and row are padding.
        let logits = [
            -1.0, 1.0, 1.0, 9.0, -1.0, -1.0, -1.0, 9.0, 9.0, 9.0, 9.0, 9.0,
        ];
        let grid = Grid {
            logits: &logits,
            columns: 4,
            covered_cells: [3, 2],
            scale: [0.25, 0.25],
        };
        assert_eq!((grid.area(0.0), grid.area(-2.0)), (2, 6));
        let window = grid.window(0.0).unwrap();
        let mask = window.mask([12, 8]).unwrap();
        // Halfway between cells of +1 and -1, the logit is 0.
        assert_eq!(mask.bounds, [4, 0, 12, 4]);
        assert_eq!(
            (mask.area(), window.area([12, 8], 0.0)),
            (31, 31),
            "bilinear interpolation cuts one corner pixel"
        );
        assert!(grid.window(10.0).is_none());
    }
}
