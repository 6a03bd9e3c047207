//! Scalar codebooks of 256 numbers, by k-means in one dimension.

/// Number of entries of a codebook (the values of a byte).
pub const CODES: usize = 256;
/// Iterations of Lloyd's algorithm; more hardly change the result.
const CODEBOOK_ROUNDS: usize = 12;

/// Computes a codebook for `values` with k-means, in ascending order. All entries are 0 without
/// values.
pub fn codebook(values: impl Iterator<Item = f32>) -> [f32; CODES] {
    let mut sorted: Vec<f32> = values.collect();
    sorted.sort_unstable_by(f32::total_cmp);
    if sorted.is_empty() {
        return [0.0; CODES];
    }
    let n = sorted.len();
    // Half of the initial entries are quantiles and half are evenly spaced, so that rare values get
    // entries too.
    let (low, high) = (sorted[0], sorted[n - 1]);
    let evenly = |k: usize| low + (high - low) * (k as f32 + 0.5) / (CODES / 2) as f32;
    let quantile = |k: usize| sorted[(2 * k + 1) * n / CODES];
    let mut codes: [f32; CODES] = std::array::from_fn(|k| {
        if k % 2 == 0 {
            evenly(k / 2)
        } else {
            quantile(k / 2)
        }
    });
    codes.sort_unstable_by(f32::total_cmp);
    let mut sums = vec![0.0f64; n + 1];
    for (k, v) in sorted.iter().enumerate() {
        sums[k + 1] = sums[k] + f64::from(*v);
    }
    for _ in 0..CODEBOOK_ROUNDS {
        let mut begin = 0;
        for k in 0..CODES {
            let end = if k + 1 == CODES {
                n
            } else {
                sorted
                    .partition_point(|v| *v <= 0.5 * (codes[k] + codes[k + 1]))
                    .max(begin)
            };
            if end > begin {
                codes[k] = ((sums[end] - sums[begin]) / (end - begin) as f64) as f32;
            }
            begin = end;
        }
    }
    codes
}

/// Returns the index of the nearest entry.
pub fn nearest(codes: &[f32; CODES], value: f32) -> u8 {
    let above = codes.partition_point(|c| *c < value).min(CODES - 1);
    let below = above.saturating_sub(1);
    if (value - codes[below]).abs() <= (codes[above] - value).abs() {
        below as u8
    } else {
        above as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn codebook_approximates_all_input_values() {
        let mut rng = Rng::new(3, "codebook");
        let mut values: Vec<f32> = (0..20_000).map(|_| rng.normal()).collect();
        values.extend([9.0, -12.0]);
        let codes = codebook(values.iter().copied());
        assert!(codes.is_sorted());
        let errors: Vec<f32> = values
            .iter()
            .map(|v| (codes[usize::from(nearest(&codes, *v))] - v).abs())
            .collect();
        let mean_square = errors.iter().map(|e| e * e).sum::<f32>() / errors.len() as f32;
        assert!(mean_square.sqrt() < 0.02, "{mean_square}");
        assert!(errors.iter().all(|e| *e < 0.12), "rare values as well");
        for value in [-20.0, -0.3, 0.0, 0.7, 20.0] {
            let best = codes
                .iter()
                .map(|c| (c - value).abs())
                .fold(f32::INFINITY, f32::min);
            assert_eq!(
                (codes[usize::from(nearest(&codes, value))] - value).abs(),
                best
            );
        }
        assert_eq!(codebook(std::iter::repeat_n(2.5, 9)), [2.5; CODES]);
        assert_eq!(codebook(std::iter::empty()), [0.0; CODES]);
    }
}
