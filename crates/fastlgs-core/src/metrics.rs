//! Metrics of masks and images. `docs/research/evaluation.md` states the rules.

/// Returns the intersection over union; 1 for two empty masks.
pub fn iou(a: &[bool], b: &[bool]) -> f64 {
    let (mut both, mut either) = (0usize, 0usize);
    for (&a, &b) in a.iter().zip(b) {
        both += usize::from(a && b);
        either += usize::from(a || b);
    }
    if either == 0 {
        1.0
    } else {
        both as f64 / either as f64
    }
}

/// Returns the share of the true pixels that were found; 1 if there are none.
pub fn recall(found: &[bool], truth: &[bool]) -> f64 {
    let total = truth.iter().filter(|t| **t).count();
    let hit = found.iter().zip(truth).filter(|(f, t)| **f && **t).count();
    if total == 0 {
        1.0
    } else {
        hit as f64 / total as f64
    }
}

/// Returns the boundary IoU (Cheng et al. 2021): the IoU of the bands within `distance` pixels
/// inside each mask's border.
pub fn boundary_iou(a: &[bool], b: &[bool], width: u32, height: u32, distance: u32) -> f64 {
    iou(
        &inner_band(a, width, height, distance),
        &inner_band(b, width, height, distance),
    )
}

fn inner_band(mask: &[bool], width: u32, height: u32, distance: u32) -> Vec<bool> {
    let inside = erode(mask, width, height, distance);
    mask.iter().zip(inside).map(|(&m, i)| m && !i).collect()
}

/// Erodes a mask with a square of radius `r` pixels. Pixels beyond the image count as outside.
pub fn erode(mask: &[bool], width: u32, height: u32, r: u32) -> Vec<bool> {
    let outside: Vec<bool> = mask.iter().map(|m| !m).collect();
    dilated(&outside, width, height, [r, r], true)
        .into_iter()
        .map(|m| !m)
        .collect()
}

/// Dilates a mask with a rectangle of `rx` pixels left and right and `ry` pixels up and down.
pub fn dilate(mask: &[bool], width: u32, height: u32, [rx, ry]: [u32; 2]) -> Vec<bool> {
    dilated(mask, width, height, [rx, ry], false)
}

/// Dilates a mask; `beyond` is the value of pixels beyond the image.
fn dilated(mask: &[bool], width: u32, height: u32, [rx, ry]: [u32; 2], beyond: bool) -> Vec<bool> {
    let (w, h, rx, ry) = (width as i64, height as i64, i64::from(rx), i64::from(ry));
    let line = |n: i64, r: i64, len: i64, get: &dyn Fn(i64) -> bool| {
        (n - r..=n + r).any(|k| {
            if (0..len).contains(&k) {
                get(k)
            } else {
                beyond
            }
        })
    };
    let mut rows = vec![false; mask.len()];
    for y in 0..h {
        for x in 0..w {
            rows[(y * w + x) as usize] = line(x, rx, w, &|k| mask[(y * w + k) as usize]);
        }
    }
    let mut out = vec![false; mask.len()];
    for y in 0..h {
        for x in 0..w {
            out[(y * w + x) as usize] = line(y, ry, h, &|k| rows[(k * w + x) as usize]);
        }
    }
    out
}

/// Upper bound of the PSNR in dB, and the value of identical images. A finite bound keeps means
/// finite.
const MAX_PSNR: f64 = 100.0;

/// Returns the peak signal-to-noise ratio of values in [0, 1], in dB, at most 100.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let mse = sum / a.len().max(1) as f64;
    // `min` would return the bound for NaN; `clamp` keeps NaN.
    if mse == 0.0 {
        MAX_PSNR
    } else {
        (-10.0 * mse.log10()).clamp(f64::MIN, MAX_PSNR)
    }
}

/// Half width of the SSIM window in pixels.
pub const SSIM_RADIUS: usize = 5;

/// Returns the 11 normalised weights of the Gaussian SSIM window (sigma 1.5 pixels).
pub fn ssim_window() -> [f32; 2 * SSIM_RADIUS + 1] {
    let raw: [f64; 11] =
        std::array::from_fn(|i| (-((i as f64 - 5.0).powi(2)) / (2.0 * 1.5 * 1.5)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|w| (w / sum) as f32)
}

/// Returns the mean SSIM of planar images `[channels][h][w]` in [0, 1] over the windows around
/// pixels with `is_valid` `[h][w]`. Pixels beyond the image are zero, as in 3DGS.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize, is_valid: &[bool]) -> f64 {
    let n = width * height;
    let counting = a.len() / n * is_valid.iter().filter(|c| **c).count();
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let mut total = 0.0;
    for (a, b) in a.chunks_exact(n).zip(b.chunks_exact(n)) {
        let product =
            |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| x * y).collect::<Vec<_>>();
        let blur = |x: &[f32]| blur(x, width, height);
        let (ma, mb) = (blur(a), blur(b));
        let (aa, bb, ab) = (
            blur(&product(a, a)),
            blur(&product(b, b)),
            blur(&product(a, b)),
        );
        for i in (0..n).filter(|&i| is_valid[i]) {
            let (ma, mb) = (f64::from(ma[i]), f64::from(mb[i]));
            let (va, vb, cov) = (
                f64::from(aa[i]) - ma * ma,
                f64::from(bb[i]) - mb * mb,
                f64::from(ab[i]) - ma * mb,
            );
            total += (2.0 * ma * mb + c1) * (2.0 * cov + c2)
                / ((ma * ma + mb * mb + c1) * (va + vb + c2));
        }
    }
    total / counting.max(1) as f64
}

/// Blurs `[h][w]` values with the separable SSIM window. Values beyond the image are zero.
pub fn blur(x: &[f32], width: usize, height: usize) -> Vec<f32> {
    let window = ssim_window();
    let mut rows = vec![0.0; x.len()];
    for j in 0..height {
        for i in 0..width {
            let (from, to) = (
                i.saturating_sub(SSIM_RADIUS),
                (i + SSIM_RADIUS).min(width - 1),
            );
            rows[j * width + i] = (from..=to)
                .map(|k| window[k + SSIM_RADIUS - i] * x[j * width + k])
                .sum();
        }
    }
    let mut out = vec![0.0; x.len()];
    for j in 0..height {
        let (from, to) = (
            j.saturating_sub(SSIM_RADIUS),
            (j + SSIM_RADIUS).min(height - 1),
        );
        for i in 0..width {
            out[j * width + i] = (from..=to)
                .map(|k| window[k + SSIM_RADIUS - j] * rows[k * width + i])
                .sum();
        }
    }
    out
}

/// Returns whether the peak of the relevancy after a 29x29 box filter lies inside a box (LERF's
/// rule). Any of several equal peaks suffices.
pub fn peak_in_box(relevancy: &[f32], width: u32, height: u32, boxes: &[[f64; 4]]) -> bool {
    let (w, h) = (width as usize, height as usize);
    // Mirrors at the border without repeating the edge, like OpenCV's filter2D by default.
    let mirrored = |k: isize, n: usize| {
        let period = 2 * (n as isize - 1).max(1);
        let k = k.rem_euclid(period);
        k.min(period - k) as usize
    };
    // Running sums: when the window moves by one pixel, one value enters and one leaves. The sums
    // start with the window around pixel -1.
    let moved = |k: usize, n: usize| (mirrored(k as isize + 14, n), mirrored(k as isize - 15, n));
    let mut rows = vec![0.0f64; w * h];
    for (row, values) in rows.chunks_exact_mut(w).zip(relevancy.chunks_exact(w)) {
        let mut sum: f64 = (-15..14).map(|d| f64::from(values[mirrored(d, w)])).sum();
        for (x, out) in row.iter_mut().enumerate() {
            let (enters, leaves) = moved(x, w);
            sum += f64::from(values[enters]) - f64::from(values[leaves]);
            *out = sum;
        }
    }
    let mut sums: Vec<f64> = (0..w)
        .map(|x| (-15..14).map(|d| rows[mirrored(d, h) * w + x]).sum())
        .collect();
    let mut values = Vec::with_capacity(w * h);
    for y in 0..h {
        let (enters, leaves) = moved(y, h);
        let pairs = rows[enters * w..][..w].iter().zip(&rows[leaves * w..][..w]);
        sums.iter_mut()
            .zip(pairs)
            .for_each(|(sum, (enters, leaves))| *sum += enters - leaves);
        values.extend_from_slice(&sums);
    }
    let peak = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (0..w * h).filter(|&p| values[p] >= peak - 1e-9).any(|p| {
        let (x, y) = ((p % w) as f64 + 0.5, (p / w) as f64 + 0.5);
        boxes
            .iter()
            .any(|b| b[0] <= x && x <= b[2] && b[1] <= y && y <= b[3])
    })
}

/// Returns the area under the ROC curve: the probability that a present score exceeds an absent
/// one. Ties count half; NaN if a list is empty.
pub fn auroc(present: &[f64], absent: &[f64]) -> f64 {
    if present.is_empty() || absent.is_empty() {
        return f64::NAN;
    }
    let wins: f64 = present
        .iter()
        .flat_map(|p| {
            absent.iter().map(move |a| {
                if p > a {
                    1.0
                } else if p == a {
                    0.5
                } else {
                    0.0
                }
            })
        })
        .sum();
    wins / (present.len() * absent.len()) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_masks_by_hand() {
        let a = [true, true, false, false];
        let b = [true, false, true, false];
        assert!((iou(&a, &b) - 1.0 / 3.0).abs() < 1e-12);
        assert!((recall(&a, &b) - 0.5).abs() < 1e-12);
        assert_eq!(iou(&[false; 3], &[false; 3]), 1.0);
        assert!((auroc(&[0.9, 0.4], &[0.1, 0.4]) - 0.875).abs() < 1e-12);
    }

    #[test]
    fn boundary_band_of_a_square() {
        let square = |from: usize, to: usize| -> Vec<bool> {
            (0..400)
                .map(|p| (from..to).contains(&(p % 20)) && (from..to).contains(&(p / 20)))
                .collect()
        };
        // Bands of one pixel: the 8x8 square has 28 pixels in its ring and the 6x6 square 20. They
        // are disjoint.
        assert_eq!(
            inner_band(&square(4, 12), 20, 20, 1)
                .iter()
                .filter(|b| **b)
                .count(),
            28
        );
        assert_eq!(boundary_iou(&square(4, 12), &square(4, 12), 20, 20, 1), 1.0);
        assert_eq!(boundary_iou(&square(4, 12), &square(5, 11), 20, 20, 1), 0.0);
    }

    #[test]
    fn dilation_stays_in_the_picture() {
        let mut mask = vec![false; 7 * 5];
        mask[2 * 7 + 3] = true;
        let count = |r: [u32; 2]| dilate(&mask, 7, 5, r).iter().filter(|m| **m).count();
        assert_eq!(
            (count([0, 0]), count([1, 1]), count([2, 0]), count([10, 1])),
            (1, 9, 5, 21)
        );
    }

    #[test]
    fn ssim_and_psnr_of_known_pictures() {
        let a: Vec<f32> = (0..32 * 24)
            .map(|i| ((i * 37) % 101) as f32 / 100.0)
            .collect();
        let (inverse, all): (Vec<f32>, _) =
            (a.iter().map(|v| 1.0 - v).collect(), vec![true; a.len()]);
        assert!((ssim(&a, &a, 32, 24, &all) - 1.0).abs() < 1e-6);
        assert!(ssim(&a, &inverse, 32, 24, &all) < 0.2);
        // Changes far from the counted pixels have no effect.
        let left = |k: usize| k % 32 < 8;
        let half: Vec<f32> = a
            .iter()
            .zip(&inverse)
            .enumerate()
            .map(|(k, (v, other))| if k % 32 < 16 { *v } else { *other })
            .collect();
        assert!(
            (ssim(
                &a,
                &half,
                32,
                24,
                &(0..32 * 24).map(left).collect::<Vec<_>>()
            ) - 1.0)
                .abs()
                < 1e-6
        );
        assert!((psnr(&[0.5, 0.5], &[0.6, 0.4]) - 20.0).abs() < 1e-4);
    }

    #[test]
    fn localisation_follows_the_peak() {
        let mut map = vec![0.0; 64 * 64];
        map[20 * 64 + 40] = 1.0;
        assert!(peak_in_box(&map, 64, 64, &[[30.0, 10.0, 50.0, 30.0]]));
        assert!(!peak_in_box(&map, 64, 64, &[[0.0, 45.0, 10.0, 60.0]]));
        // Reference: sums each mirrored window anew. The peak must be the same.
        for (seed, (w, h)) in [(40, 31), (33, 64), (9, 12)].into_iter().enumerate() {
            let mut rng = crate::rng::Rng::new(seed as u64, "localised");
            let map: Vec<f32> = (0..w * h).map(|_| rng.uniform().powi(6)).collect();
            let back = |k: i32, n: i32| if k < 0 { -k } else { 2 * (n - 1) - k };
            let mirrored = |k: i32, n: i32| {
                std::iter::successors(Some(k), |k| Some(back(*k, n)))
                    .find(|k| (0..n).contains(k))
                    .unwrap()
            };
            let window = |c: i32, n: i32| (c - 14..=c + 14).map(move |k| mirrored(k, n));
            let sum = |p: &i32| -> f64 {
                let pixels = window(p / w, h)
                    .flat_map(|y| window(p % w, w).map(move |x| (y * w + x) as usize));
                pixels.map(|p| f64::from(map[p])).sum()
            };
            let best = (0..w * h).max_by(|a, b| sum(a).total_cmp(&sum(b))).unwrap();
            let (x, y, right, bottom) = (
                f64::from(best % w),
                f64::from(best / w),
                f64::from(w),
                f64::from(h),
            );
            let is_in = |boxes: &[[f64; 4]]| peak_in_box(&map, w as u32, h as u32, boxes);
            assert!(is_in(&[[x, y, x + 1.0, y + 1.0]]), "{w}x{h}");
            assert!(!is_in(&[
                [0.0, 0.0, right, y],
                [0.0, y + 1.0, right, bottom],
                [0.0, 0.0, x, bottom],
                [x + 1.0, 0.0, right, bottom]
            ]));
        }
    }
}
