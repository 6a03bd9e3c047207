//! Vector quantisation: represents many rows of numbers by a palette of few, with k-means.

use rayon::prelude::*;

/// Largest palette, in rows. The format allows 65,536, but the time is proportional to palette rows
/// times input rows.
const MAX_ROWS: usize = 4096;
/// Input rows per palette row. A longer palette would dominate the file of a small scene. Four
/// times as many rows raise the PSNR of 47 dB by only 2.7 dB.
const INPUT_ROWS_PER_ROW: usize = 16;
/// Number of rows that train the palette; the others are only assigned to it.
const TRAINING_ROWS: usize = 65_536;
/// Iterations of Lloyd's algorithm.
const PALETTE_ROUNDS: usize = 8;
/// Number of independent partial sums, for vector instructions.
const LANES: usize = 8;

/// A palette and the assignment of rows to it.
pub struct Palette {
    /// Palette rows, one after the other.
    pub rows: Vec<f32>,
    /// Index of the palette row of each input row.
    pub labels: Vec<u16>,
}

/// Computes a palette for `rows` of `width` numbers each. Deterministic.
pub fn palette(rows: &[f32], width: usize) -> Palette {
    let n = rows.len() / width;
    let count = (n / INPUT_ROWS_PER_ROW).clamp(1, MAX_ROWS);
    let padded = Rows::new(rows.chunks_exact(width), width);
    let sample = Rows::new(
        rows.chunks_exact(width).step_by(n.div_ceil(TRAINING_ROWS)),
        width,
    );
    let learned = sample.len();
    let mut centres = Rows::new(
        (0..count).map(|k| &rows[(k * n / count) * width..][..width]),
        width,
    );
    for _ in 0..PALETTE_ROUNDS {
        let labels = centres.nearest(&sample);
        let mut sums = vec![0.0f64; count * width];
        let mut counts = vec![0u32; count];
        for (row, label) in (0..learned).map(|k| sample.row(k)).zip(&labels) {
            let label = usize::from(*label);
            counts[label] += 1;
            sums[label * width..][..width]
                .iter_mut()
                .zip(row)
                .for_each(|(s, v)| *s += f64::from(*v));
        }
        for (k, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
            let mean = sums[k * width..][..width]
                .iter()
                .map(|s| (s / f64::from(*count)) as f32);
            centres
                .row_mut(k)
                .iter_mut()
                .zip(mean)
                .for_each(|(v, mean)| *v = mean);
        }
    }
    let labels = centres.nearest(&padded);
    Palette {
        rows: (0..count)
            .flat_map(|k| centres.row(k)[..width].to_vec())
            .collect(),
        labels,
    }
}

/// Rows, padded with zeros to a multiple of `LANES` numbers.
struct Rows {
    values: Vec<f32>,
    stride: usize,
}

impl Rows {
    fn new<'a>(rows: impl Iterator<Item = &'a [f32]>, width: usize) -> Self {
        let stride = width.next_multiple_of(LANES);
        let fill = stride - width;
        Self {
            values: rows
                .flat_map(|row| row.iter().copied().chain(std::iter::repeat_n(0.0, fill)))
                .collect(),
            stride,
        }
    }

    fn len(&self) -> usize {
        self.values.len() / self.stride
    }

    fn row(&self, k: usize) -> &[f32] {
        &self.values[k * self.stride..][..self.stride]
    }

    fn row_mut(&mut self, k: usize) -> &mut [f32] {
        &mut self.values[k * self.stride..][..self.stride]
    }

    /// Returns, for each row of `others`, the index of the nearest row in `self`; the first one of
    /// ties.
    fn nearest(&self, others: &Self) -> Vec<u16> {
        // |x - c|^2 = |x|^2 - 2 (x c - |c|^2 / 2), and |x|^2 is the same for all c.
        let halves: Vec<f32> = (0..self.len())
            .map(|k| 0.5 * dot(self.row(k), self.row(k)))
            .collect();
        let of = |row: &[f32]| {
            let (mut best, mut place) = (f32::NEG_INFINITY, 0);
            for (k, (centre, half)) in self
                .values
                .chunks_exact(self.stride)
                .zip(&halves)
                .enumerate()
            {
                let near = dot(row, centre) - half;
                if near > best {
                    (best, place) = (near, k);
                }
            }
            place as u16
        };
        others
            .values
            .par_chunks_exact(self.stride)
            .map(of)
            .collect()
    }
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn palette_separates_clusters_of_rows() {
        let mut rng = Rng::new(5, "palette");
        let kinds: Vec<[f32; 9]> = (0..20)
            .map(|_| std::array::from_fn(|_| rng.normal()))
            .collect();
        let rows: Vec<f32> = (0..800)
            .flat_map(|_| kinds[(20.0 * rng.uniform()) as usize])
            .collect();
        let rows: Vec<f32> = rows.into_iter().map(|v| v + 0.001 * rng.normal()).collect();
        let Palette {
            rows: palette,
            labels,
        } = palette(&rows, 9);
        assert_eq!((palette.len(), labels.len()), (50 * 9, 800));
        for (row, label) in rows.chunks_exact(9).zip(labels) {
            let own = &palette[usize::from(label) * 9..][..9];
            assert!(row.iter().zip(own).all(|(a, b)| (a - b).abs() < 0.01));
        }
    }
}
