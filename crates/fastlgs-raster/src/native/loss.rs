//! L1 + D-SSIM and its gradient, row by row.

use super::Picture;
use super::simd::{madd, vectorised};
use crate::engine::Losses;
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};
use rayon::prelude::*;

/// Intermediate pictures of the loss, kept between steps.
#[derive(Default)]
pub struct Scratch {
    /// Row-blurred x, y, x^2, y^2, x y: `[h][5][w]`.
    rows: Vec<f32>,
    /// Derivatives of SSIM by its moments, and then blurred along rows: `[h][3][w]`.
    partials: Vec<f32>,
    blurred: Vec<f32>,
}

/// Weights of SSIM's window.
type Window = [f32; 2 * SSIM_RADIUS + 1];

vectorised! {
    /// Weighted sums of the same places of some rows: of neighbours along a row, the rows are that row shifted.
    fn blur(window: &Window, rows: &[&[f32]; 2 * SSIM_RADIUS + 1], out: &mut [f32]) = blur_body
}

#[inline(always)]
fn blur_body<const FMA: bool>(window: &Window, rows: &[&[f32]; 2 * SSIM_RADIUS + 1], out: &mut [f32]) {
    let rows = rows.map(|row| &row[..out.len()]);
    for i in 0..out.len() {
        let mut sum = 0.0;
        for k in 0..window.len() {
            sum = madd::<FMA>(window[k], rows[k][i], sum);
        }
        out[i] = sum;
    }
}

/// Blurs a row; `padded` holds it with SSIM_RADIUS zeros on both sides.
fn blur_row(window: &Window, padded: &[f32], out: &mut [f32]) {
    blur(window, &std::array::from_fn(|k| &padded[k..k + out.len()]), out);
}

/// Blurs `lines` maps along columns into `out`, for row `j` of `rows` `[h][lines * w]`.
fn blur_columns(window: &Window, rows: &[f32], line: usize, h: usize, j: usize, out: &mut [f32]) {
    let inside = |k: usize| Some((j + k).wrapping_sub(SSIM_RADIUS)).filter(|row| *row < h);
    let row = |k: usize| {
        let row = inside(k).unwrap_or(j);
        &rows[row * line..(row + 1) * line]
    };
    // Beyond the picture there are zeros.
    let window = std::array::from_fn(|k| inside(k).map_or(0.0, |_| window[k]));
    blur(&window, &std::array::from_fn(row), out);
}

/// What is compared in row `j`: x, y and the weight of each pixel.
fn compared(plane: &Plane, frame: &Picture<8>, targets: &[u32], j: usize) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let [w, h] = plane.size.map(|s| s as usize);
    let channel = plane.channel as usize;
    let x: Vec<f32> = frame.row(channel, j)[..w].iter().map(|v| plane.gain * v + plane.offset).collect();
    let packed = &targets[(channel / 3 * h + j) * w..][..w];
    let shift = 8 * (plane.channel % 3);
    let y = packed.iter().zip(&x).map(|(p, x)| if *p >= 0x8000_0000 { (p >> shift & 255) as f32 / 255.0 } else { *x }).collect();
    (x, y, packed.iter().map(|p| if *p >= 0x8000_0000 { 1.0 } else { 0.0 }).collect())
}

impl Scratch {
    /// Floats held.
    pub fn words(&self) -> usize {
        self.rows.len() + self.partials.len() + self.blurred.len()
    }

    /// Writes dL/d frame of one channel into `gradient` and adds to `losses`; `targets` is `[2][h][w]`, not padded.
    pub fn plane(&mut self, plane: &Plane, frame: &Picture<8>, targets: &[u32], gradient: &mut Picture<6>, losses: &mut Losses) {
        let [w, h] = plane.size.map(|s| s as usize);
        let window = ssim_window();
        self.rows.resize(5 * w * h, 0.0);
        self.partials.resize(3 * w * h, 0.0);
        self.blurred.resize(3 * w * h, 0.0);
        self.rows.par_chunks_exact_mut(5 * w).enumerate().for_each(|(j, out)| {
            let (x, y, _) = compared(plane, frame, targets, j);
            let mut padded = vec![0.0; w + 2 * SSIM_RADIUS];
            for (m, out) in out.chunks_exact_mut(w).enumerate() {
                let (a, b) = match m {
                    0 => (&x, None),
                    1 => (&y, None),
                    2 => (&x, Some(&x)),
                    3 => (&y, Some(&y)),
                    _ => (&x, Some(&y)),
                };
                let middle = &mut padded[SSIM_RADIUS..SSIM_RADIUS + w];
                middle.copy_from_slice(a);
                if let Some(b) = b {
                    middle.iter_mut().zip(b).for_each(|(p, b)| *p *= b);
                }
                blur_row(&window, &padded, out);
            }
        });
        let rows = &self.rows;
        let ssim: Vec<f64> = self
            .partials
            .par_chunks_exact_mut(3 * w)
            .enumerate()
            .map(|(j, out)| {
                let mut moments = vec![0.0; 5 * w];
                blur_columns(&window, rows, 5 * w, h, j, &mut moments);
                derivatives(&moments, out)
            })
            .collect();
        let partials = &self.partials;
        self.blurred.par_chunks_exact_mut(3 * w).zip(partials.par_chunks_exact(3 * w)).for_each(|(out, row)| {
            let mut padded = vec![0.0; w + 2 * SSIM_RADIUS];
            for (out, row) in out.chunks_exact_mut(w).zip(row.chunks_exact(w)) {
                padded[SSIM_RADIUS..SSIM_RADIUS + w].copy_from_slice(row);
                blur_row(&window, &padded, out);
            }
        });
        let blurred = &self.blurred;
        let channel = plane.channel as usize;
        let sums: Vec<[f64; 4]> = gradient
            .rows_mut()
            .take(h)
            .enumerate()
            .map(|(j, row)| {
                let mut by = vec![0.0; 3 * w];
                blur_columns(&window, blurred, 3 * w, h, j, &mut by);
                let (x, y, weight) = compared(plane, frame, targets, j);
                let (rendered, transmittance) = (frame.row(channel, j), frame.row(6, j));
                let out = &mut row[channel * frame.width..][..w];
                let mut sums = [0.0f32; 4];
                for i in 0..w {
                    let sign = f32::from(u8::from(x[i] > y[i])) - f32::from(u8::from(x[i] < y[i]));
                    let d_ssim = by[i] + 2.0 * x[i] * by[w + i] + y[i] * by[2 * w + i];
                    let value = weight[i] * plane.scale * ((1.0 - plane.lambda) * sign - plane.lambda * d_ssim);
                    out[i] = plane.gain * value;
                    sums[0] += weight[i] * (x[i] - y[i]).abs();
                    sums[1] += value * rendered[i];
                    sums[2] += value;
                    sums[3] += plane.gain * value * transmittance[i];
                }
                sums.map(f64::from)
            })
            .collect();
        let total = |k: usize| sums.iter().map(|s| s[k]).sum::<f64>();
        let per_value = 1.0 / (3 * w * h) as f64;
        losses.by_background[channel] = total(3);
        if channel < 3 {
            losses.color_l1 += total(0) * per_value;
            losses.color_ssim += ssim.iter().sum::<f64>() * per_value;
            (losses.by_gain[channel], losses.by_offset[channel]) = (total(1), total(2));
        } else {
            losses.feature_l1 += total(0) * per_value;
        }
    }
}

/// SSIM of a row from its five local moments `[5][w]`; `out` `[3][w]` gets its derivatives.
fn derivatives(moments: &[f32], out: &mut [f32]) -> f64 {
    let w = moments.len() / 5;
    let [mx, my, xx, yy, xy] = [0, 1, 2, 3, 4].map(|m| &moments[m * w..(m + 1) * w]);
    let (by_mean, rest) = out.split_at_mut(w);
    let (by_square, by_product) = rest.split_at_mut(w);
    let mut sum = 0.0f32;
    for i in 0..w {
        let a = 2.0 * mx[i] * my[i] + 0.0001;
        let b = 2.0 * (xy[i] - mx[i] * my[i]) + 0.0009;
        let c = mx[i] * mx[i] + my[i] * my[i] + 0.0001;
        let d = (xx[i] - mx[i] * mx[i]) + (yy[i] - my[i] * my[i]) + 0.0009;
        let inverse = 1.0 / (c * d);
        let ssim = a * b * inverse;
        sum += ssim;
        by_mean[i] = 2.0 * my[i] * (b - a) * inverse - 2.0 * mx[i] * ssim * (d - c) * inverse;
        by_square[i] = -ssim / d;
        by_product[i] = 2.0 * a * inverse;
    }
    f64::from(sum)
}
