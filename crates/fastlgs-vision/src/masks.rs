//! Masks of segmenters: one boolean for each pixel of the bounding box.

use fastlgs_core::mask_list::RunLengths;

/// A mask, stored over its bounding box only.
#[derive(Clone, Debug, PartialEq)]
pub struct BitMask {
    /// Left, top, right, bottom in pixels; right and bottom are exclusive.
    pub bounds: [u32; 4],
    /// Whether each pixel of the box belongs to the mask, row-major.
    pub bits: Vec<bool>,
}

impl BitMask {
    /// Returns the mask of the pixels of `bounds` for which `member(x, y)` is true, cut to its own
    /// bounding box; `None` if it is empty.
    pub fn from_fn(bounds: [u32; 4], member: impl Fn(u32, u32) -> bool) -> Option<Self> {
        let [x0, y0, x1, y1] = bounds;
        let inside = |y: u32| (x0..x1).map(move |x| (x, y));
        let bits: Vec<bool> = (y0..y1)
            .flat_map(inside)
            .map(|(x, y)| member(x, y))
            .collect();
        Self { bounds, bits }.tight()
    }

    /// Returns the same mask over its smallest box; `None` if it is empty.
    fn tight(self) -> Option<Self> {
        let [x0, y0, x1, _] = self.bounds;
        let width = x1 - x0;
        let mut box_ = [u32::MAX, u32::MAX, 0, 0];
        for (i, _) in self.bits.iter().enumerate().filter(|b| *b.1) {
            let (x, y) = (x0 + i as u32 % width, y0 + i as u32 / width);
            box_ = [
                box_[0].min(x),
                box_[1].min(y),
                box_[2].max(x + 1),
                box_[3].max(y + 1),
            ];
        }
        if box_[0] == u32::MAX {
            return None;
        }
        let rows = box_[1]..box_[3];
        let bits = rows
            .flat_map(|y| (box_[0]..box_[2]).map(move |x| (x, y)))
            .map(|(x, y)| self.bits[((y - y0) * width + x - x0) as usize]);
        Some(Self {
            bounds: box_,
            bits: bits.collect(),
        })
    }

    fn width(&self) -> usize {
        (self.bounds[2] - self.bounds[0]) as usize
    }

    /// Returns the number of pixels of the mask.
    pub fn area(&self) -> usize {
        self.bits.iter().filter(|b| **b).count()
    }

    /// Returns whether a pixel of the picture belongs to the mask.
    pub fn at(&self, x: u32, y: u32) -> bool {
        let [x0, y0, x1, y1] = self.bounds;
        (x0..x1).contains(&x)
            && (y0..y1).contains(&y)
            && self.bits[(y - y0) as usize * self.width() + (x - x0) as usize]
    }

    /// Returns the run lengths of the mask in a picture of `width` x `height` pixels.
    pub fn runs(&self, width: u32, height: u32) -> RunLengths {
        RunLengths::from_fn(width, height, |x, y| self.at(x, y))
    }

    /// Returns the number of pixels that both masks contain.
    pub fn common(&self, other: &Self) -> usize {
        let [x0, y0, x1, y1] = box_intersection(self.bounds, other.bounds);
        (y0..y1)
            .flat_map(|y| (x0..x1).map(move |x| (x, y)))
            .filter(|&(x, y)| self.at(x, y) && other.at(x, y))
            .count()
    }

    /// Returns the intersection over union, 0 to 1.
    pub fn iou(&self, other: &Self) -> f32 {
        let common = self.common(other);
        common as f32 / (self.area() + other.area() - common).max(1) as f32
    }

    /// Fills holes and removes islands of fewer than `least` pixels (8-connected). Returns `None`
    /// if nothing is left.
    pub fn without_specks(mut self, least: usize) -> Option<Self> {
        let (width, height) = (self.width(), self.bits.len() / self.width());
        for filled in [false, true] {
            for part in components(&self.bits, width, filled) {
                // A component at the border of the box is the surroundings, not a hole.
                let border = |i: &usize| {
                    [0, width - 1].contains(&(i % width)) || [0, height - 1].contains(&(i / width))
                };
                if part.len() < least && (filled || !part.iter().any(border)) {
                    part.iter().for_each(|i| self.bits[*i] = !filled);
                }
            }
        }
        self.tight()
    }
}

/// Returns the intersection of two boxes; empty if they do not overlap.
fn box_intersection(a: [u32; 4], b: [u32; 4]) -> [u32; 4] {
    let (x0, y0) = (a[0].max(b[0]), a[1].max(b[1]));
    [x0, y0, a[2].min(b[2]).max(x0), a[3].min(b[3]).max(y0)]
}

/// Returns the intersection over union of two boxes, 0 to 1.
pub fn box_iou(a: [u32; 4], b: [u32; 4]) -> f32 {
    let area = |r: [u32; 4]| ((r[2] - r[0]) * (r[3] - r[1])) as f32;
    let common = area(box_intersection(a, b));
    common / (area(a) + area(b) - common).max(1.0)
}

/// Returns the 8-connected groups of pixels with `value`, as row-major indices.
fn components(bits: &[bool], width: usize, value: bool) -> Vec<Vec<usize>> {
    let height = bits.len() / width;
    let mut seen = vec![false; bits.len()];
    let mut out = Vec::new();
    for start in 0..bits.len() {
        if seen[start] || bits[start] != value {
            continue;
        }
        let (mut part, mut next) = (Vec::new(), vec![start]);
        seen[start] = true;
        while let Some(i) = next.pop() {
            part.push(i);
            let (x, y) = (i % width, i / width);
            for v in y.saturating_sub(1)..(y + 2).min(height) {
                for u in x.saturating_sub(1)..(x + 2).min(width) {
                    let j = v * width + u;
                    if !seen[j] && bits[j] == value {
                        seen[j] = true;
                        next.push(j);
                    }
                }
            }
        }
        out.push(part);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> BitMask {
        let (w, h) = (rows[0].len() as u32, rows.len() as u32);
        BitMask::from_fn([0, 0, w, h], |x, y| {
            rows[y as usize].as_bytes()[x as usize] == b'#'
        })
        .unwrap()
    }

    #[test]
    fn boxes_are_tight_and_overlap_is_counted() {
        let a = mask(&["....", ".##.", ".##."]);
        assert_eq!((a.bounds, a.area()), ([1, 1, 3, 3], 4));
        let b = mask(&["....", "..##", "..##"]);
        assert!((a.iou(&b) - 2.0 / 6.0).abs() < 1e-6);
        assert!((box_iou(a.bounds, b.bounds) - 2.0 / 6.0).abs() < 1e-6);
        assert_eq!(box_iou([0, 0, 1, 1], [5, 5, 6, 6]), 0.0);
        assert!(BitMask::from_fn([0, 0, 3, 3], |_, _| false).is_none());
    }

    #[test]
    fn small_islands_and_holes_are_removed() {
        let with = mask(&["#####..#", "#.###...", "####....", "#####..."]);
        let without = with.clone().without_specks(2).unwrap();
        assert_eq!(
            without,
            mask(&["#####...", "#####...", "####....", "#####..."])
        );
        assert!(with.without_specks(50).is_none());
    }
}
