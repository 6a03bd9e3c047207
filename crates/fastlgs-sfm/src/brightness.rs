//! Brightness of photos relative to each other, measured from the colours of matched key points.

use crate::conjugate_gradients;
use crate::tracks::PairMatches;
use nalgebra::DVector;
use std::collections::BTreeSet;

/// Smallest number of matches from which the brightness of two photos is compared.
const MIN_BRIGHTNESS_MATCHES: usize = 8;
/// Values up to this one (of 255) do not count: ratios of nearly black values are unreliable.
const DARK: f32 = 8.0;
/// Values from this one on (of 255) do not count: they may be clipped at white.
const CLIPPED: f32 = 250.0;
/// Weight, in matches, of the prior that the brightness of a photo equals its apparent brightness.
/// It matters only for photos and groups that no match connects to the others.
const APPEARANCE_PRIOR_WEIGHT: f64 = 1e-2;
/// Weight, in matches, of the prior that all channels of a photo differ from other photos by the
/// same number of stops. It matters for a channel that is clipped at white.
const CHANNEL_PRIOR_WEIGHT: f64 = 1.0;

fn median(values: &mut [f32]) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Brightness of photos relative to each other.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Brightness {
    /// Typical difference between two photos of the same surface, in stops (factors of two). It is
    /// the median over pairs of photos, in the channel where it is largest; 0 without matches.
    pub spread_stops: f32,
    /// Factor by which each photo is brighter than the geometric mean of all photos, by channel.
    pub gains: Vec<[f32; 3]>,
}

/// First photo, second photo, by how many stops the first is brighter, and the number of matches.
type Difference = (usize, usize, f64, f64);

/// Compares photos by the colours of matched key points. `colors` holds the colours of each photo's
/// key points.
pub fn compare(colors: &[Vec<[u8; 3]>], matches: &[PairMatches]) -> Brightness {
    let of_channel = |c: usize| -> Vec<Difference> {
        let difference = |m: &PairMatches| {
            let both = m
                .pairs
                .iter()
                .map(|&(i, j)| (f32::from(colors[m.a][i][c]), f32::from(colors[m.b][j][c])));
            let usable = |(a, b): &(f32, f32)| a.min(*b) > DARK && a.max(*b) < CLIPPED;
            let mut stops: Vec<f32> = both.filter(usable).map(|(a, b)| (a / b).log2()).collect();
            let count = stops.len();
            if count < MIN_BRIGHTNESS_MATCHES {
                None
            } else {
                median(&mut stops).map(|stops| (m.a, m.b, f64::from(stops), count as f64))
            }
        };
        matches.iter().filter_map(difference).collect()
    };
    let channels: [Vec<Difference>; 3] = std::array::from_fn(of_channel);
    let spread = |differences: &Vec<Difference>| {
        median(
            &mut differences
                .iter()
                .map(|d| d.2.abs() as f32)
                .collect::<Vec<_>>(),
        )
        .unwrap_or(0.0)
    };
    let looks = apparent_stops(colors);
    // A photo may look bright only because it shows bright surfaces. Apparent brightness is
    // therefore scaled by the least-squares slope of measured against apparent brightness.
    let measured = solve_stops(&channels, &DVector::zeros(looks.len()));
    let measured_indices = channels.iter().enumerate().flat_map(|(c, all)| {
        all.iter()
            .flat_map(move |d| [d.0, d.1].map(|photo| 3 * photo + c))
    });
    let tied_channels: BTreeSet<usize> = measured_indices.collect();
    let [common, own] = tied_channels.iter().fold([0.0, 0.0], |[common, own], &k| {
        [common + measured[k] * looks[k], own + looks[k] * looks[k]]
    });
    let stops = solve_stops(
        &channels,
        &(looks * (common / own.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)),
    );
    Brightness {
        spread_stops: channels.iter().map(spread).fold(0.0, f32::max),
        gains: (0..colors.len())
            .map(|photo| [0, 1, 2].map(|c| stops[3 * photo + c].exp2() as f32))
            .collect(),
    }
}

/// Returns by how many stops the key points of each photo look brighter than the mean of all
/// photos, for each channel: `[photo][3]`.
fn apparent_stops(colors: &[Vec<[u8; 3]>]) -> DVector<f64> {
    let of = |photo: &Vec<[u8; 3]>, c: usize| {
        median(
            &mut photo
                .iter()
                .map(|color| f32::from(color[c]).max(1.0).log2())
                .collect::<Vec<_>>(),
        )
    };
    let mut looks = DVector::zeros(3 * colors.len());
    for c in 0..3 {
        let of_photos: Vec<Option<f32>> = colors.iter().map(|photo| of(photo, c)).collect();
        let mean = of_photos.iter().flatten().sum::<f32>()
            / of_photos.iter().flatten().count().max(1) as f32;
        of_photos.iter().enumerate().for_each(|(photo, look)| {
            looks[3 * photo + c] = look.map_or(0.0, |look| f64::from(look - mean));
        });
    }
    looks
}

/// Returns the stops of each photo's channels, `[photo][3]`, that fit all differences best (least
/// squares). Each channel has a mean of 0. Photos without differences get their apparent stops.
fn solve_stops(channels: &[Vec<Difference>; 3], looks: &DVector<f64>) -> DVector<f64> {
    let measured = channels.iter().enumerate().flat_map(|(c, differences)| {
        let of = move |&(a, b, stops, count): &Difference| (3 * a + c, 3 * b + c, stops, count);
        differences.iter().map(of)
    });
    let equal = (0..looks.len()).step_by(3).flat_map(|red| {
        let pairs = [(0, 1), (1, 2), (2, 0)];
        pairs.map(|(a, b)| (red + a, red + b, 0.0, CHANNEL_PRIOR_WEIGHT))
    });
    let differences: Vec<Difference> = measured.chain(equal).collect();
    let mut diagonal = DVector::from_element(looks.len(), APPEARANCE_PRIOR_WEIGHT);
    let mut right = looks * APPEARANCE_PRIOR_WEIGHT;
    for &(a, b, stops, weight) in &differences {
        diagonal[a] += weight;
        diagonal[b] += weight;
        right[a] += weight * stops;
        right[b] -= weight * stops;
    }
    let product = |x: &DVector<f64>| {
        let mut y = x.component_mul(&diagonal);
        for &(a, b, _, weight) in &differences {
            y[a] -= weight * x[b];
            y[b] -= weight * x[a];
        }
        y
    };
    let precondition = |r: &DVector<f64>| r.component_div(&diagonal);
    let mut stops = conjugate_gradients::solve(product, precondition, &right, 1e-6)
        .expect("the prior makes the matrix positive definite");
    for c in 0..3 {
        let mean = stops.iter().skip(c).step_by(3).sum::<f64>() / (looks.len() / 3).max(1) as f64;
        stops
            .iter_mut()
            .skip(c)
            .step_by(3)
            .for_each(|stops| *stops -= mean);
    }
    stops
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_the_light_is_one_stop() {
        let photo = |gain: f32| {
            (0..20u8)
                .map(|k| [120 + 3 * k, 100 + k, 140].map(|v| (f32::from(v) * gain) as u8))
                .collect::<Vec<_>>()
        };
        let matches = [PairMatches {
            a: 0,
            b: 1,
            pairs: (0..20).map(|k| (k, k)).collect(),
        }];
        let between = |a: f32, b: f32| compare(&[photo(a), photo(b)], &matches);
        assert!((between(1.0, 0.5).spread_stops - 1.0).abs() < 0.03);
        assert!(between(1.0, 1.0).spread_stops < 1e-6);
        assert_eq!(
            compare(&[photo(1.0), photo(0.5)], &[]),
            Brightness {
                spread_stops: 0.0,
                gains: vec![[1.0; 3]; 2]
            }
        );
        let gains = between(1.0, 0.5).gains;
        assert!(
            (gains[0][1] - 2.0f32.sqrt()).abs() < 0.02
                && (gains[1][1] - 0.5f32.sqrt()).abs() < 0.02,
            "{gains:?}"
        );
    }

    /// Gains of photos of the same twenty points. Each photo matches the next one, but the last one
    /// matches none.
    fn gains_of(light: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let point = |k: u8, gain: &[f32; 3]| {
            [0, 1, 2].map(|c| ([60 + k, 50 + 2 * k, 70].map(f32::from)[c] * gain[c]) as u8)
        };
        let colors: Vec<Vec<[u8; 3]>> = light
            .iter()
            .map(|gain| (0..20).map(|k| point(k, gain)).collect())
            .collect();
        let pair = |a: usize| PairMatches {
            a,
            b: a + 1,
            pairs: (0..20).map(|k| (k, k)).collect(),
        };
        compare(&colors, &(0..light.len() - 2).map(pair).collect::<Vec<_>>()).gains
    }

    #[test]
    fn a_clipped_channel_follows_the_others() {
        // Red is clipped in the second photo, so only green and blue measure its brightness.
        let gains = gains_of(&[[1.0; 3], [9.0, 2.0, 2.0], [1.0; 3], [1.0; 3]]);
        let stops = [0, 1, 2].map(|c| (gains[1][c] / gains[0][c]).log2());
        assert!(stops.iter().all(|s| (s - 1.0).abs() < 0.1), "{stops:?}");
    }

    #[test]
    fn unmatched_photo_gets_its_apparent_brightness_if_light_varies() {
        let stops = |light: [f32; 5]| {
            let gains = gains_of(&light.map(|gain| [gain; 3]));
            (gains[4][1] / gains[0][1]).log2()
        };
        let (varying, steady) = (
            stops([1.0, 2.0, 0.5, 1.5, 0.4]),
            stops([1.0, 1.0, 1.0, 1.0, 0.4]),
        );
        assert!(
            (varying - 0.4f32.log2()).abs() < 0.3 && steady.abs() < 0.02,
            "{varying} {steady}"
        );
    }
}
