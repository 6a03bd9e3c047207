//! How much the brightness of a set of photos varies, by what the same points look like in two of them.

use crate::triangulate::PairMatches;

/// Fewest matches that tell how bright one photo is against another.
const FEW: usize = 8;
/// Values near black say nothing about ratios.
const DARK: f32 = 8.0;

fn median(values: &mut [f32]) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The typical difference between two photos of the same thing in stops (factors of two), in the colour channel that differs most: the
/// median over pairs of photos of the median over their matches. 0 where nothing matches. `colors` are those of each photo's key points.
pub fn spread(colors: &[Vec<[u8; 3]>], matches: &[PairMatches]) -> f32 {
    let of_channel = |c: usize| {
        let difference = |m: &PairMatches| {
            let both = m.pairs.iter().map(|&(i, j)| (f32::from(colors[m.a][i][c]), f32::from(colors[m.b][j][c])));
            let mut stops: Vec<f32> = both.filter(|(a, b)| a.min(*b) > DARK).map(|(a, b)| (a / b).log2()).collect();
            if stops.len() < FEW { None } else { median(&mut stops).map(f32::abs) }
        };
        let mut differences: Vec<f32> = matches.iter().filter_map(difference).collect();
        median(&mut differences).unwrap_or(0.0)
    };
    (0..3).map(of_channel).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_the_light_is_one_stop() {
        let photo = |gain: f32| (0..20u8).map(|k| [120 + 3 * k, 100 + k, 140].map(|v| (f32::from(v) * gain) as u8)).collect::<Vec<_>>();
        let matches = [PairMatches { a: 0, b: 1, pairs: (0..20).map(|k| (k, k)).collect() }];
        let between = |a: f32, b: f32| spread(&[photo(a), photo(b)], &matches);
        assert!((between(1.0, 0.5) - 1.0).abs() < 0.03);
        assert!(between(1.0, 1.0) < 1e-6);
        assert_eq!(spread(&[photo(1.0), photo(0.5)], &[]), 0.0);
    }
}
