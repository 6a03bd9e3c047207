//! The loss (1 - lambda) L1 + lambda (1 - SSIM) and its gradient, computed row by row.

use super::picture::TiledPlanes;
use super::simd::{madd, vectorised};
use crate::engine::Losses;
use crate::view::Plane;
use fastlgs_core::metrics::{SSIM_RADIUS, ssim_window};
use rayon::prelude::*;

/// Intermediate images of the loss, reused between steps.
#[derive(Default)]
pub struct Scratch {
    /// Rendered value x, target value y and weight of each pixel, `[h][3][w]`.
    samples: Vec<f32>,
    /// Derivatives of SSIM by three local moments, blurred along rows, `[h][3][w]`.
    blurred: Vec<f32>,
}

/// Weights of the SSIM window.
type Window = [f32; 2 * SSIM_RADIUS + 1];

vectorised! {
    /// Writes out[i] = sum over k of window[k] rows[k][i]. For a blur along a row, `rows` are
    /// shifted slices of that row.
    fn blur(window: &Window, rows: &[&[f32]; 2 * SSIM_RADIUS + 1], out: &mut [f32]) = blur_body
}

#[inline(always)]
fn blur_body<const FMA: bool>(
    window: &Window,
    rows: &[&[f32]; 2 * SSIM_RADIUS + 1],
    out: &mut [f32],
) {
    let rows = rows.map(|row| &row[..out.len()]);
    for i in 0..out.len() {
        let mut sum = 0.0;
        for k in 0..window.len() {
            sum = madd::<FMA>(window[k], rows[k][i], sum);
        }
        out[i] = sum;
    }
}

/// Blurs a row. `padded` is the row with SSIM_RADIUS zeros on both sides.
fn blur_row(window: &Window, padded: &[f32], out: &mut [f32]) {
    blur(
        window,
        &std::array::from_fn(|k| &padded[k..k + out.len()]),
        out,
    );
}

/// Returns the weight and the row of each tap of the window around row `j`. `rows` holds rows of
/// `line` floats. Taps outside the image have weight 0.
fn taps<'a>(
    window: &Window,
    rows: &'a [f32],
    line: usize,
    j: usize,
) -> (Window, [&'a [f32]; 2 * SSIM_RADIUS + 1]) {
    let row_at = |k: usize| {
        (j + k)
            .checked_sub(SSIM_RADIUS)
            .and_then(|row| rows.get(row * line..(row + 1) * line))
    };
    let taps: [_; 2 * SSIM_RADIUS + 1] = std::array::from_fn(row_at);
    let own = &rows[j * line..(j + 1) * line];
    (
        std::array::from_fn(|k| taps[k].map_or(0.0, |_| window[k])),
        taps.map(|row| row.unwrap_or(own)),
    )
}

vectorised! {
    /// Writes the weighted sums over `rows` of x, y, x^2 + y^2 and x y to the four lines of `out`.
    /// Each row holds x, then y. The values of a line start at SSIM_RADIUS.
    fn moments(window: &Window, rows: &[&[f32]; 2 * SSIM_RADIUS + 1], w: usize, out: &mut [f32]) = moments_body
}

#[inline(always)]
fn moments_body<const FMA: bool>(
    window: &Window,
    rows: &[&[f32]; 2 * SSIM_RADIUS + 1],
    w: usize,
    out: &mut [f32],
) {
    let (x, y) = (rows.map(|row| &row[..w]), rows.map(|row| &row[w..2 * w]));
    let mut lines = out
        .chunks_exact_mut(w + 2 * SSIM_RADIUS)
        .map(|line| &mut line[SSIM_RADIUS..SSIM_RADIUS + w]);
    let [mx, my, squares, xy] = std::array::from_fn(|_| lines.next().expect("four lines"));
    for i in 0..w {
        let mut sums = [0.0; 4];
        for k in 0..window.len() {
            let (x, y) = (x[k][i], y[k][i]);
            let (wx, wy) = (window[k] * x, window[k] * y);
            sums = [
                sums[0] + wx,
                sums[1] + wy,
                madd::<FMA>(wx, x, madd::<FMA>(wy, y, sums[2])),
                madd::<FMA>(wx, y, sums[3]),
            ];
        }
        [mx[i], my[i], squares[i], xy[i]] = sums;
    }
}

vectorised! {
    /// Writes x, y and the weights of a row of pixels to `out` `[3][w]`. x is the rendered value
    /// with exposure applied, y the target.
    fn compare(plane: &Plane, rendered: &[f32], packed: &[u32], out: &mut [f32]) = compare_body
}

#[inline(always)]
fn compare_body<const FMA: bool>(plane: &Plane, rendered: &[f32], packed: &[u32], out: &mut [f32]) {
    let (shift, w) = (8 * (plane.channel % 3), rendered.len());
    let (x, rest) = out.split_at_mut(w);
    let (y, weight) = rest.split_at_mut(w);
    let (packed, weight) = (&packed[..w], &mut weight[..w]);
    for i in 0..w {
        x[i] = plane.gain * rendered[i] + plane.offset;
        let valid = packed[i] >= 0x8000_0000;
        y[i] = if valid {
            (packed[i] >> shift & 255) as i32 as f32 / 255.0
        } else {
            x[i]
        };
        weight[i] = if valid { 1.0 } else { 0.0 };
    }
}

/// Number of values of a row that are processed together.
const LANES: usize = 16;

/// Returns `LANES` values of each row from index `first` on, with zeros beyond the end of a row. A
/// loop is used because `map` over an array is not compiled with the caller's vector instructions.
#[inline(always)]
fn lanes<const ROWS: usize>(rows: [&[f32]; ROWS], first: usize) -> [[f32; LANES]; ROWS] {
    let mut values = [[0.0; LANES]; ROWS];
    for (values, row) in values.iter_mut().zip(rows) {
        let rest = &row[first..];
        match rest.first_chunk() {
            Some(all) => *values = *all,
            None => values[..rest.len()].copy_from_slice(rest),
        }
    }
    values
}

/// Writes values to a row from index `first` on, up to the end of the row.
#[inline(always)]
fn store_lanes(row: &mut [f32], first: usize, values: &[f32; LANES]) {
    let rest = &mut row[first..];
    match rest.first_chunk_mut() {
        Some(all) => *all = *values,
        None => rest.copy_from_slice(&values[..rest.len()]),
    }
}

impl Scratch {
    /// Returns the number of floats held.
    pub fn words(&self) -> usize {
        self.samples.len() + self.blurred.len()
    }

    /// Writes dL/d frame of one channel to `gradient` and its part of the loss to `losses`.
    /// `targets` is `[2][h][w]` without padding.
    pub fn plane(
        &mut self,
        plane: &Plane,
        frame: &TiledPlanes<8>,
        targets: &[u32],
        gradient: &mut TiledPlanes<6>,
        losses: &mut Losses,
    ) {
        let [w, h] = plane.size.map(|s| s as usize);
        let channel = plane.channel as usize;
        let window = ssim_window();
        self.samples.resize(3 * w * h, 0.0);
        self.samples
            .par_chunks_exact_mut(3 * w)
            .enumerate()
            .for_each(|(j, out)| {
                compare(
                    plane,
                    &frame.row(channel, j)[..w],
                    &targets[(channel / 3 * h + j) * w..][..w],
                    out,
                );
            });
        let compared = &self.samples;
        self.blurred.resize(3 * w * h, 0.0);
        let per_row = self.blurred.par_chunks_exact_mut(3 * w).enumerate();
        let ssim: Vec<f64> = per_row
            .map_init(
                || Moments::new(w),
                |moments, (row, out)| {
                    let (weights, rows) = taps(&window, compared, 3 * w, row);
                    moments.ssim(&window, &weights, &rows, out)
                },
            )
            .collect();
        let blurred = &self.blurred;
        let sums: Vec<[f64; 4]> = gradient
            .rows_mut()
            .take(h)
            .enumerate()
            .map_init(
                || vec![0.0; 3 * w],
                |by, (j, row)| {
                    let (weights, rows) = taps(&window, blurred, 3 * w, j);
                    blur(&weights, &rows, by);
                    let light = [channel, 6].map(|c| &frame.row(c, j)[..w]);
                    let mut sums = [0.0; 4];
                    gradients(
                        plane,
                        &compared[3 * w * j..][..3 * w],
                        by,
                        light,
                        &mut row[channel * frame.width..][..w],
                        &mut sums,
                    );
                    sums
                },
            )
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

/// Buffers for the SSIM windows of one row of pixels. Lines of `padded` have SSIM_RADIUS zeros on
/// both sides.
struct Moments {
    padded: Vec<f32>,
    moments: Vec<f32>,
    partials: Vec<f32>,
}

impl Moments {
    fn new(w: usize) -> Self {
        Self {
            padded: vec![0.0; 4 * (w + 2 * SSIM_RADIUS)],
            moments: vec![0.0; 4 * w],
            partials: vec![0.0; 3 * w],
        }
    }

    /// Returns the sum of SSIM over a row of pixels. Writes its derivatives by the moments, blurred
    /// along the row, to `out` `[3][w]`.
    fn ssim(
        &mut self,
        window: &Window,
        weights: &Window,
        rows: &[&[f32]; 2 * SSIM_RADIUS + 1],
        out: &mut [f32],
    ) -> f64 {
        let w = out.len() / 3;
        let Self {
            padded,
            moments: blurred,
            partials,
        } = self;
        moments(weights, rows, w, padded);
        let lines = |padded: &mut [f32], out: &mut [f32]| {
            let lines = padded
                .chunks_exact(w + 2 * SSIM_RADIUS)
                .zip(out.chunks_exact_mut(w));
            lines.for_each(|(line, out)| blur_row(window, line, out));
        };
        lines(padded, blurred);
        let mut ssim = 0.0;
        derivatives(blurred, partials, &mut ssim);
        for (line, row) in padded
            .chunks_exact_mut(w + 2 * SSIM_RADIUS)
            .zip(partials.chunks_exact(w))
        {
            line[SSIM_RADIUS..SSIM_RADIUS + w].copy_from_slice(row);
        }
        lines(padded, out);
        ssim
    }
}

vectorised! {
    /// Computes the SSIM of a row from its four local moments `[4][w]`. Writes its derivatives by
    /// the mean of x, of x^2 + y^2 and of x y to `out` `[3][w]`, and its sum to `sum`.
    fn derivatives(moments: &[f32], out: &mut [f32], sum: &mut f64) = derivatives_body
}

#[inline(always)]
fn derivatives_body<const FMA: bool>(moments: &[f32], out: &mut [f32], sum: &mut f64) {
    let w = moments.len() / 4;
    let [mx, my, squares, xy] = [0, 1, 2, 3].map(|m| &moments[m * w..(m + 1) * w]);
    let (by_mean, rest) = out.split_at_mut(w);
    let (by_square, by_product) = rest.split_at_mut(w);
    let by_product = &mut by_product[..w];
    let mut sums = [0.0; LANES];
    for first in (0..w).step_by(LANES) {
        let [mx, my, squares, xy] = lanes([mx, my, squares, xy], first);
        let mut by = [[0.0; LANES]; 3];
        for i in 0..LANES {
            let a = 2.0 * mx[i] * my[i] + 0.0001;
            let b = 2.0 * (xy[i] - mx[i] * my[i]) + 0.0009;
            let of_means = mx[i] * mx[i] + my[i] * my[i];
            let c = of_means + 0.0001;
            let d = squares[i] - of_means + 0.0009;
            let inverse = 1.0 / (c * d);
            let ssim = a * b * inverse;
            by[0][i] = 2.0 * my[i] * (b - a) * inverse - 2.0 * mx[i] * ssim * (d - c) * inverse;
            by[1][i] = -ssim * (c * inverse);
            by[2][i] = 2.0 * a * inverse;
            // Lanes beyond the row compare zeros, so they are left out of the sum.
            sums[i] += if first + i < w { ssim } else { 0.0 };
        }
        [&mut *by_mean, by_square, by_product]
            .into_iter()
            .zip(&by)
            .for_each(|(row, values)| store_lanes(row, first, values));
    }
    *sum = sums.iter().map(|s| f64::from(*s)).sum();
}

vectorised! {
    /// Writes dL/d frame of a row to `out`. `sums` receives the sums of |x - y| and of dL/d gain,
    /// dL/d offset and dL/d background.
    /// `by` `[3][w]` holds the blurred derivatives of SSIM by its moments, `light` the rendered
    /// values and the transmittance.
    fn gradients(plane: &Plane, compared: &[f32], by: &[f32], light: [&[f32]; 2], out: &mut [f32], sums: &mut [f64; 4]) = gradients_body
}

#[inline(always)]
fn gradients_body<const FMA: bool>(
    plane: &Plane,
    compared: &[f32],
    by: &[f32],
    light: [&[f32]; 2],
    out: &mut [f32],
    sums: &mut [f64; 4],
) {
    let w = out.len();
    let [x, y, weight] = [0, 1, 2].map(|m| &compared[m * w..(m + 1) * w]);
    let [rendered, transmittance] = light.map(|row| &row[..w]);
    let [by_mean, by_square, by_product] = [0, 1, 2].map(|m| &by[m * w..(m + 1) * w]);
    let mut totals = [[0.0; LANES]; 4];
    for first in (0..w).step_by(LANES) {
        // Lanes beyond the row have weight 0.
        let [x, y, weight, rendered, transmittance] =
            lanes([x, y, weight, rendered, transmittance], first);
        let [by_mean, by_square, by_product] = lanes([by_mean, by_square, by_product], first);
        let mut values = [0.0; LANES];
        for i in 0..LANES {
            let sign = if x[i] > y[i] { 1.0 } else { 0.0 } - if x[i] < y[i] { 1.0 } else { 0.0 };
            let d_ssim = by_mean[i] + 2.0 * x[i] * by_square[i] + y[i] * by_product[i];
            let value =
                weight[i] * plane.scale * ((1.0 - plane.lambda) * sign - plane.lambda * d_ssim);
            totals[0][i] += weight[i] * (x[i] - y[i]).abs();
            totals[1][i] += value * rendered[i];
            totals[2][i] += value;
            totals[3][i] += plane.gain * value * transmittance[i];
            values[i] = plane.gain * value;
        }
        store_lanes(out, first, &values);
    }
    *sums = totals.map(|lanes| lanes.iter().map(|sum| f64::from(*sum)).sum());
}
