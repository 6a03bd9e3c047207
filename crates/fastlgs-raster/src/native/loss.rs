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

/// What is compared in a row: x, y and the weight of each pixel.
#[derive(Default)]
struct Compared {
    x: Vec<f32>,
    y: Vec<f32>,
    weight: Vec<f32>,
}

impl Compared {
    /// Row `j` of a plane.
    fn load(&mut self, plane: &Plane, frame: &Picture<8>, targets: &[u32], j: usize) {
        let [w, h] = plane.size.map(|s| s as usize);
        let channel = plane.channel as usize;
        [&mut self.x, &mut self.y, &mut self.weight].into_iter().for_each(|row| row.resize(w, 0.0));
        compare(plane, &frame.row(channel, j)[..w], &targets[(channel / 3 * h + j) * w..][..w], self);
    }
}

vectorised! {
    fn compare(plane: &Plane, rendered: &[f32], packed: &[u32], out: &mut Compared) = compare_body
}

#[inline(always)]
fn compare_body<const FMA: bool>(plane: &Plane, rendered: &[f32], packed: &[u32], out: &mut Compared) {
    let (shift, w) = (8 * (plane.channel % 3), rendered.len());
    let (x, y, weight) = (&mut out.x[..w], &mut out.y[..w], &mut out.weight[..w]);
    for i in 0..w {
        x[i] = plane.gain * rendered[i] + plane.offset;
        let counts = packed[i] >= 0x8000_0000;
        y[i] = if counts { (packed[i] >> shift & 255) as i32 as f32 / 255.0 } else { x[i] };
        weight[i] = if counts { 1.0 } else { 0.0 };
    }
}

/// A sum that processors can take in many lanes.
#[inline(always)]
fn sum_of(count: usize, value: impl Fn(usize) -> f32) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0; LANES];
    for first in (0..count - count % LANES).step_by(LANES) {
        for k in 0..LANES {
            sums[k] += value(first + k);
        }
    }
    sums.iter().sum::<f32>() + (count - count % LANES..count).map(value).sum::<f32>()
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
        self.rows.par_chunks_exact_mut(5 * w).enumerate().for_each_init(Compared::default, |compared, (j, out)| {
            compared.load(plane, frame, targets, j);
            let Compared { x, y, .. } = compared;
            let mut padded = vec![0.0; w + 2 * SSIM_RADIUS];
            for (m, out) in out.chunks_exact_mut(w).enumerate() {
                let (a, b) = match m {
                    0 => (&*x, None),
                    1 => (&*y, None),
                    2 => (&*x, Some(&*x)),
                    3 => (&*y, Some(&*y)),
                    _ => (&*x, Some(&*y)),
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
            .map_init(Vec::new, |moments, (j, out)| {
                moments.resize(5 * w, 0.0);
                blur_columns(&window, rows, 5 * w, h, j, moments);
                let mut ssim = 0.0;
                derivatives(moments, out, &mut ssim);
                ssim
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
            .map_init(Default::default, |(compared, by): &mut (Compared, Vec<f32>), (j, row)| {
                by.resize(3 * w, 0.0);
                blur_columns(&window, blurred, 3 * w, h, j, by);
                compared.load(plane, frame, targets, j);
                let light = [channel, 6].map(|c| &frame.row(c, j)[..w]);
                let mut sums = [0.0; 4];
                gradients(plane, compared, by, light, &mut row[channel * frame.width..][..w], &mut sums);
                sums
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

vectorised! {
    /// SSIM of a row from its five local moments `[5][w]`, summed; `out` `[3][w]` gets its derivatives.
    fn derivatives(moments: &[f32], out: &mut [f32], sum: &mut f64) = derivatives_body
}

#[inline(always)]
fn derivatives_body<const FMA: bool>(moments: &[f32], out: &mut [f32], sum: &mut f64) {
    let w = moments.len() / 5;
    let [mx, my, xx, yy, xy] = [0, 1, 2, 3, 4].map(|m| &moments[m * w..(m + 1) * w]);
    let (by_mean, rest) = out.split_at_mut(w);
    let (by_square, by_product) = rest.split_at_mut(w);
    let by_product = &mut by_product[..w];
    for i in 0..w {
        let a = 2.0 * mx[i] * my[i] + 0.0001;
        let b = 2.0 * (xy[i] - mx[i] * my[i]) + 0.0009;
        let c = mx[i] * mx[i] + my[i] * my[i] + 0.0001;
        let d = (xx[i] - mx[i] * mx[i]) + (yy[i] - my[i] * my[i]) + 0.0009;
        let inverse = 1.0 / (c * d);
        let ssim = a * b * inverse;
        by_mean[i] = 2.0 * my[i] * (b - a) * inverse - 2.0 * mx[i] * ssim * (d - c) * inverse;
        by_square[i] = -ssim * (c * inverse);
        by_product[i] = 2.0 * a * inverse;
    }
    // SSIM = a b / (c d), and what was stored last of it is -a b / (c d) / d.
    *sum = f64::from(sum_of(w, |i| -by_square[i] * ((xx[i] - mx[i] * mx[i]) + (yy[i] - my[i] * my[i]) + 0.0009)));
}

vectorised! {
    /// dL/d frame of a row into `out`, and sums of |x - y| and of dL/d gain, offset and background. `by` `[3][w]`: SSIM by its moments, blurred;
    /// `light`: what was rendered, and transmittance.
    fn gradients(plane: &Plane, compared: &Compared, by: &[f32], light: [&[f32]; 2], out: &mut [f32], sums: &mut [f64; 4]) = gradients_body
}

#[inline(always)]
fn gradients_body<const FMA: bool>(
    plane: &Plane,
    compared: &Compared,
    by: &[f32],
    light: [&[f32]; 2],
    out: &mut [f32],
    sums: &mut [f64; 4],
) {
    let w = out.len();
    let Compared { x, y, weight } = compared;
    let (x, y, weight, [rendered, transmittance]) = (&x[..w], &y[..w], &weight[..w], light.map(|row| &row[..w]));
    let [by_mean, by_square, by_product] = [0, 1, 2].map(|m| &by[m * w..(m + 1) * w]);
    for i in 0..w {
        let sign = if x[i] > y[i] { 1.0 } else { 0.0 } - if x[i] < y[i] { 1.0 } else { 0.0 };
        let d_ssim = by_mean[i] + 2.0 * x[i] * by_square[i] + y[i] * by_product[i];
        out[i] = weight[i] * plane.scale * ((1.0 - plane.lambda) * sign - plane.lambda * d_ssim);
    }
    *sums = [
        f64::from(sum_of(w, |i| weight[i] * (x[i] - y[i]).abs())),
        f64::from(sum_of(w, |i| out[i] * rendered[i])),
        f64::from(sum_of(w, |i| out[i])),
        f64::from(plane.gain * sum_of(w, |i| out[i] * transmittance[i])),
    ];
    out.iter_mut().for_each(|value| *value *= plane.gain);
}
