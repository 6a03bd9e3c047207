//! Blending and its gradients, a tile at a time, two of its rows in one vector of sixteen.

use super::simd::{exp2, madd, vectorised};
use crate::cpu::{ALPHA_MIN, BATCH, Splat, TRANSMITTANCE_MIN};
use crate::view::View;

/// Pixels along a tile's edge.
const EDGE: usize = crate::view::TILE as usize;

/// Pixels of two rows: what AVX-512 handles at once.
const LANES: usize = 2 * EDGE;

/// A value for each pixel of a tile, row by row.
pub type Tile = [[f32; LANES]; EDGE / 2];

/// What the forward pass makes of a tile.
#[derive(Clone)]
pub struct Blended {
    /// r, g, b, f0, f1, f2 without the background.
    pub sums: [Tile; 6],
    /// Transmittance left.
    pub transmittance: Tile,
    /// Pairs walked.
    pub walked: u32,
}

/// A tile's place and its list.
pub struct Job<'a> {
    /// Upper left pixel.
    pub x: f32,
    /// Upper left pixel.
    pub y: f32,
    /// Gaussians front to back.
    pub gaussians: &'a [u32],
    /// All splats.
    pub splats: &'a [Splat],
}

impl<'a> Job<'a> {
    /// The job of tile number `tile`.
    pub fn new(view: &View, tile: usize, gaussians: &'a [u32], splats: &'a [Splat]) -> Self {
        let (column, row) = (tile % view.tiles[0] as usize, tile / view.tiles[0] as usize);
        Self { x: (column * EDGE) as f32, y: (row * EDGE) as f32, gaussians, splats }
    }
}

/// 1 for the pixels of the picture, 0 for those of the padding.
pub fn shown(view: &View, job: &Job) -> Tile {
    let [w, h] = view.size.map(|s| s as f32);
    let at = |j: usize, i: usize| (job.x + (i % EDGE) as f32, job.y + (2 * j + i / EDGE) as f32);
    std::array::from_fn(|j| std::array::from_fn(|i| if at(j, i).0 < w && at(j, i).1 < h { 1.0 } else { 0.0 }))
}

/// Pairs of rows of the tile in which a splat can reach the least alpha: where its exponent's maximum over x allows it.
#[inline(always)]
fn rows_of(splat: &Splat, y: f32) -> std::ops::Range<usize> {
    let [[_, my, qx, qy], [qz, log_opacity, ..], _] = *splat;
    // Over x the exponent is at most (qz - qy^2 / 4 qx) dy^2 + log2(opacity).
    let bend = qz - 0.25 * qy * qy / qx;
    let reach = ((-8.0 - log_opacity) / bend).max(0.0).sqrt() + 0.01;
    let first = (my - reach - y - 0.5).ceil().clamp(0.0, EDGE as f32);
    let end = ((my + reach - y - 0.5).floor() + 1.0).clamp(first, EDGE as f32);
    first as usize / 2..(end as usize).div_ceil(2)
}

/// Offsets of the pixels of two rows from a splat's mean.
#[inline(always)]
fn offsets(x: f32) -> [f32; LANES] {
    std::array::from_fn(|i| x + (i % EDGE) as f32 + 0.5)
}

/// The same along y, `y` being the first of the two rows.
#[inline(always)]
fn row_offsets(y: f32) -> [f32; LANES] {
    std::array::from_fn(|i| y + (i / EDGE) as f32 + 0.5)
}

/// Alphas of a splat along two rows.
#[inline(always)]
fn alphas<const FMA: bool>(splat: &Splat, dx: &[f32; LANES], dy: &[f32; LANES]) -> [f32; LANES] {
    let [[_, _, qx, qy], [qz, log_opacity, ..], _] = *splat;
    let mut out = [0.0; LANES];
    for i in 0..LANES {
        let c0 = madd::<FMA>(qz * dy[i], dy[i], log_opacity);
        let alpha = exp2::<FMA>(madd::<FMA>(dx[i], madd::<FMA>(qx, dx[i], qy * dy[i]), c0));
        out[i] = if alpha >= ALPHA_MIN { alpha } else { 0.0 };
    }
    out
}

#[inline(always)]
fn values_of(splat: &Splat) -> [f32; 6] {
    [splat[1][2], splat[1][3], splat[2][0], splat[2][1], splat[2][2], splat[2][3]]
}

/// Channels of a step: colour 0..3, feature 3..6.
#[inline(always)]
fn channels<const COLOR: bool, const FEATURE: bool>() -> std::ops::Range<usize> {
    (if COLOR { 0 } else { 3 })..(if FEATURE { 6 } else { 3 })
}

vectorised! {
    /// Blends the list of a tile; `out.transmittance` must hold 1 for pixels of the picture and 0 for others.
    fn forward<const COLOR: bool, const FEATURE: bool>(job: &Job<'_>, out: &mut Blended) = forward_body
}

#[inline(always)]
fn forward_body<const FMA: bool, const COLOR: bool, const FEATURE: bool>(job: &Job<'_>, out: &mut Blended) {
    for batch in job.gaussians.chunks(BATCH) {
        for &g in batch {
            let splat = &job.splats[g as usize];
            let values = values_of(splat);
            let dx = offsets(job.x - splat[0][0]);
            for j in rows_of(splat, job.y) {
                let alpha = alphas::<FMA>(splat, &dx, &row_offsets(job.y + (2 * j) as f32 - splat[0][1]));
                let transmittance = &mut out.transmittance[j];
                let mut w = [0.0; LANES];
                for i in 0..LANES {
                    w[i] = alpha[i] * transmittance[i];
                    transmittance[i] -= w[i];
                }
                for c in channels::<COLOR, FEATURE>() {
                    let sums = &mut out.sums[c][j];
                    for i in 0..LANES {
                        sums[i] = madd::<FMA>(w[i], values[c], sums[i]);
                    }
                }
            }
        }
        out.walked += batch.len() as u32;
        if out.transmittance.iter().flatten().all(|t| *t < TRANSMITTANCE_MIN) {
            break;
        }
    }
}

vectorised! {
    /// Blending weights of a tile's Gaussians, summed by their ids: those that occur, in the order of the list.
    /// `transmittance` must hold 1 for pixels of the picture and 0 for others.
    fn by_id(job: &Job<'_>, ids: &[u16], transmittance: &mut Tile, sums: &mut Vec<(u16, Tile)>) = by_id_body
}

#[inline(always)]
fn by_id_body<const FMA: bool>(job: &Job<'_>, ids: &[u16], transmittance: &mut Tile, sums: &mut Vec<(u16, Tile)>) {
    sums.clear();
    for batch in job.gaussians.chunks(BATCH) {
        for &g in batch {
            let (splat, id) = (&job.splats[g as usize], ids[g as usize]);
            let place = sums.iter().position(|s| s.0 == id).unwrap_or_else(|| {
                sums.push((id, Tile::default()));
                sums.len() - 1
            });
            let dx = offsets(job.x - splat[0][0]);
            for j in rows_of(splat, job.y) {
                let alpha = alphas::<FMA>(splat, &dx, &row_offsets(job.y + (2 * j) as f32 - splat[0][1]));
                let (transmittance, sum) = (&mut transmittance[j], &mut sums[place].1[j]);
                for i in 0..LANES {
                    let w = alpha[i] * transmittance[i];
                    transmittance[i] -= w;
                    sum[i] += w;
                }
            }
        }
        if transmittance.iter().flatten().all(|t| *t < TRANSMITTANCE_MIN) {
            break;
        }
    }
}

vectorised! {
    /// Blending weights of each Gaussian of a tile, summed over the pixels of each of `masks` (1 inside, 0 outside):
    /// `[Gaussian of the list][mask]`, as far as the list is walked.
    fn by_mask(job: &Job<'_>, masks: &[Tile], transmittance: &mut Tile, sums: &mut Vec<f32>) = by_mask_body
}

#[inline(always)]
fn by_mask_body<const FMA: bool>(job: &Job<'_>, masks: &[Tile], transmittance: &mut Tile, sums: &mut Vec<f32>) {
    sums.clear();
    for batch in job.gaussians.chunks(BATCH) {
        for &g in batch {
            let splat = &job.splats[g as usize];
            let first = sums.len();
            sums.resize(first + masks.len(), 0.0);
            let dx = offsets(job.x - splat[0][0]);
            for j in rows_of(splat, job.y) {
                let alpha = alphas::<FMA>(splat, &dx, &row_offsets(job.y + (2 * j) as f32 - splat[0][1]));
                let transmittance = &mut transmittance[j];
                let mut w = [0.0; LANES];
                for i in 0..LANES {
                    w[i] = alpha[i] * transmittance[i];
                    transmittance[i] -= w[i];
                }
                for (sum, mask) in sums[first..].iter_mut().zip(masks) {
                    let mut inside = [0.0; LANES];
                    for i in 0..LANES {
                        inside[i] = w[i] * mask[j][i];
                    }
                    *sum += inside.iter().sum::<f32>();
                }
            }
        }
        if transmittance.iter().flatten().all(|t| *t < TRANSMITTANCE_MIN) {
            break;
        }
    }
}

/// What the backward pass starts from.
pub struct Given {
    /// dL/d(colour, feature).
    pub gradient: [Tile; 6],
    /// R.g of the light behind; docs/gradients.md, section 1.
    pub r_dot_g: Tile,
    /// 1 for pixels of the picture, 0 for others.
    pub transmittance: Tile,
    /// Pairs that the forward pass walked.
    pub walked: u32,
}

vectorised! {
    /// Gradient slots of a tile's pairs, in the order of its list.
    fn backward<const COLOR: bool, const FEATURE: bool, const MOVES: bool>(job: &Job<'_>, given: &mut Given, slots: &mut [[f32; 12]])
        = backward_body
}

#[inline(always)]
fn backward_body<const FMA: bool, const COLOR: bool, const FEATURE: bool, const MOVES: bool>(
    job: &Job<'_>,
    given: &mut Given,
    slots: &mut [[f32; 12]],
) {
    let walked = given.walked as usize;
    for (&g, slot) in job.gaussians[..walked].iter().zip(&mut *slots) {
        let splat = &job.splats[g as usize];
        let values = values_of(splat);
        let dx = offsets(job.x - splat[0][0]);
        let (mut p_sum, mut py_sum, mut pyy_sum) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        let mut sums = [[0.0; LANES]; 6];
        for j in rows_of(splat, job.y) {
            let dy = row_offsets(job.y + (2 * j) as f32 - splat[0][1]);
            let alpha = alphas::<FMA>(splat, &dx, &dy);
            let mut w = [0.0; LANES];
            for i in 0..LANES {
                w[i] = alpha[i] * given.transmittance[j][i];
                given.transmittance[j][i] -= w[i];
            }
            for c in channels::<COLOR, FEATURE>() {
                for i in 0..LANES {
                    sums[c][i] = madd::<FMA>(w[i], given.gradient[c][j][i], sums[c][i]);
                }
            }
            if COLOR {
                let mut c_dot_g = [0.0; LANES];
                for c in 0..if MOVES { 6 } else { 3 } {
                    for i in 0..LANES {
                        c_dot_g[i] = madd::<FMA>(values[c], given.gradient[c][j][i], c_dot_g[i]);
                    }
                }
                for i in 0..LANES {
                    let w_c_dot_g = w[i] * c_dot_g[i];
                    let r_dot_g = given.r_dot_g[j][i] - w_c_dot_g;
                    given.r_dot_g[j][i] = r_dot_g;
                    let p = w_c_dot_g - r_dot_g * (alpha[i] / (1.0 - alpha[i]));
                    p_sum[i] += p;
                    py_sum[i] = madd::<FMA>(p, dy[i], py_sum[i]);
                    pyy_sum[i] = madd::<FMA>(p * dy[i], dy[i], pyy_sum[i]);
                }
            }
        }
        let total = |values: &[f32; LANES]| values.iter().sum::<f32>();
        let by = |values: &[f32; LANES], factor: &[f32; LANES]| std::array::from_fn::<f32, LANES, _>(|i| values[i] * factor[i]);
        let px = by(&p_sum, &dx);
        *slot = [
            total(&px),
            total(&py_sum),
            total(&by(&px, &dx)),
            total(&by(&py_sum, &dx)),
            total(&pyy_sum),
            total(&p_sum),
            total(&sums[0]),
            total(&sums[1]),
            total(&sums[2]),
            total(&sums[3]),
            total(&sums[4]),
            total(&sums[5]),
        ];
    }
    slots[walked..].fill([0.0; 12]);
}
