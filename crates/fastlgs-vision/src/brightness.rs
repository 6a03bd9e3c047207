//! How much the brightness of a set of photos varies, by what the same points look like in two of them.

use crate::tracks::PairMatches;
use nalgebra::{DMatrix, DVector};

/// Fewest matches that tell how bright one photo is against another.
const FEW: usize = 8;
/// Values near black say nothing about ratios.
const DARK: f32 = 8.0;
/// Nor do values that may have been cut off at white.
const CLIPPED: f32 = 250.0;
/// Matches' worth of belief that a photo is as bright as the mean: what holds photos that nothing matches.
const HOLD: f32 = 1e-2;

fn median(values: &mut [f32]) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}

/// How bright photos are against each other.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Brightness {
    /// The typical difference between two photos of the same thing in stops (factors of two), in the colour channel that differs most: the
    /// median over pairs of photos. 0 where nothing matches.
    pub spread_stops: f32,
    /// How many times brighter than the mean of all each photo shows things, by channel.
    pub gains: Vec<[f32; 3]>,
}

/// A pair of photos: how many stops brighter the first is, and how many matches say so.
type Difference = (usize, usize, f32, f32);

/// Compares photos by what the same points look like in them; `colors` are those of each photo's key points.
pub fn compare(colors: &[Vec<[u8; 3]>], matches: &[PairMatches]) -> Brightness {
    let of_channel = |c: usize| -> Vec<Difference> {
        let difference = |m: &PairMatches| {
            let both = m.pairs.iter().map(|&(i, j)| (f32::from(colors[m.a][i][c]), f32::from(colors[m.b][j][c])));
            let telling = |(a, b): &(f32, f32)| a.min(*b) > DARK && a.max(*b) < CLIPPED;
            let mut stops: Vec<f32> = both.filter(telling).map(|(a, b)| (a / b).log2()).collect();
            let count = stops.len();
            if count < FEW { None } else { median(&mut stops).map(|stops| (m.a, m.b, stops, count as f32)) }
        };
        matches.iter().filter_map(difference).collect()
    };
    let channels: [Vec<Difference>; 3] = std::array::from_fn(of_channel);
    let spread = |differences: &Vec<Difference>| median(&mut differences.iter().map(|d| d.2.abs()).collect::<Vec<_>>()).unwrap_or(0.0);
    let stops = channels.each_ref().map(|differences| consistent(colors.len(), differences));
    Brightness {
        spread_stops: channels.iter().map(spread).fold(0.0, f32::max),
        gains: (0..colors.len()).map(|photo| [0, 1, 2].map(|c| stops[c][photo].exp2())).collect(),
    }
}

/// Stops of each photo, with a mean of 0, that fit all differences best (least squares).
fn consistent(photos: usize, differences: &[Difference]) -> Vec<f32> {
    let mut normal = DMatrix::<f32>::identity(photos, photos) * HOLD;
    let mut right = DVector::<f32>::zeros(photos);
    for &(a, b, stops, weight) in differences {
        (normal[(a, a)], normal[(b, b)]) = (normal[(a, a)] + weight, normal[(b, b)] + weight);
        (normal[(a, b)], normal[(b, a)]) = (normal[(a, b)] - weight, normal[(b, a)] - weight);
        (right[a], right[b]) = (right[a] + weight * stops, right[b] - weight * stops);
    }
    let stops = normal.cholesky().map_or_else(|| DVector::zeros(photos), |factors| factors.solve(&right));
    let mean = stops.mean();
    stops.iter().map(|s| s - mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_the_light_is_one_stop() {
        let photo = |gain: f32| (0..20u8).map(|k| [120 + 3 * k, 100 + k, 140].map(|v| (f32::from(v) * gain) as u8)).collect::<Vec<_>>();
        let matches = [PairMatches { a: 0, b: 1, pairs: (0..20).map(|k| (k, k)).collect() }];
        let between = |a: f32, b: f32| compare(&[photo(a), photo(b)], &matches);
        assert!((between(1.0, 0.5).spread_stops - 1.0).abs() < 0.03);
        assert!(between(1.0, 1.0).spread_stops < 1e-6);
        assert_eq!(compare(&[photo(1.0), photo(0.5)], &[]), Brightness { spread_stops: 0.0, gains: vec![[1.0; 3]; 2] });
        let gains = between(1.0, 0.5).gains;
        assert!((gains[0][1] - 2.0f32.sqrt()).abs() < 0.02 && (gains[1][1] - 0.5f32.sqrt()).abs() < 0.02, "{gains:?}");
    }
}
