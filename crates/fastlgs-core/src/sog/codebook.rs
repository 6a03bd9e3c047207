//! Numbers as one of 256 that stand for all: a codebook in one dimension.

/// Numbers that a byte can tell apart.
pub const CODES: usize = 256;
/// Rounds of Lloyd's algorithm; later ones hardly move anything.
const ROUNDS: usize = 12;

/// 256 numbers in rising order, so chosen that the nearest of them is near most of `values` (k-means in one dimension).
pub fn codebook(values: impl Iterator<Item = f32>) -> [f32; CODES] {
    let mut sorted: Vec<f32> = values.collect();
    sorted.sort_unstable_by(f32::total_cmp);
    if sorted.is_empty() {
        return [0.0; CODES];
    }
    let n = sorted.len();
    // Half from where values are many and half from all over their range, so that rare ones count as well.
    let (low, high) = (sorted[0], sorted[n - 1]);
    let evenly = |k: usize| low + (high - low) * (k as f32 + 0.5) / (CODES / 2) as f32;
    let often = |k: usize| sorted[(2 * k + 1) * n / CODES];
    let mut codes: [f32; CODES] = std::array::from_fn(|k| if k % 2 == 0 { evenly(k / 2) } else { often(k / 2) });
    codes.sort_unstable_by(f32::total_cmp);
    let mut sums = vec![0.0f64; n + 1];
    for (k, v) in sorted.iter().enumerate() {
        sums[k + 1] = sums[k] + f64::from(*v);
    }
    for _ in 0..ROUNDS {
        let mut begin = 0;
        for k in 0..CODES {
            let end = if k + 1 == CODES { n } else { sorted.partition_point(|v| *v <= 0.5 * (codes[k] + codes[k + 1])).max(begin) };
            if end > begin {
                codes[k] = ((sums[end] - sums[begin]) / (end - begin) as f64) as f32;
            }
            begin = end;
        }
    }
    codes
}

/// The place of the nearest code.
pub fn nearest(codes: &[f32; CODES], value: f32) -> u8 {
    let above = codes.partition_point(|c| *c < value).min(CODES - 1);
    let below = above.saturating_sub(1);
    if (value - codes[below]).abs() <= (codes[above] - value).abs() { below as u8 } else { above as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn a_codebook_is_near_all_that_it_was_made_of() {
        let mut rng = Rng::new(3, "codebook");
        let mut values: Vec<f32> = (0..20_000).map(|_| rng.normal()).collect();
        values.extend([9.0, -12.0]);
        let codes = codebook(values.iter().copied());
        assert!(codes.is_sorted());
        let errors: Vec<f32> = values.iter().map(|v| (codes[usize::from(nearest(&codes, *v))] - v).abs()).collect();
        let mean_square = errors.iter().map(|e| e * e).sum::<f32>() / errors.len() as f32;
        assert!(mean_square.sqrt() < 0.02, "{mean_square}");
        assert!(errors.iter().all(|e| *e < 0.12), "rare values as well");
        for value in [-20.0, -0.3, 0.0, 0.7, 20.0] {
            let best = codes.iter().map(|c| (c - value).abs()).fold(f32::INFINITY, f32::min);
            assert_eq!((codes[usize::from(nearest(&codes, value))] - value).abs(), best);
        }
        assert_eq!(codebook(std::iter::repeat_n(2.5, 9)), [2.5; CODES]);
        assert_eq!(codebook(std::iter::empty()), [0.0; CODES]);
    }
}
