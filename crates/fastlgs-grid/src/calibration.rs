//! Calibration of an encoder: converts cosines to log-odds, and margins to scores.

use serde::{Deserialize, Serialize};

/// Measured constants of an encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds per unit of cosine: (mean cosine of an object with its own name - mean cosine of
    /// other objects with it) / variance of the latter.
    pub temperature: f32,
    /// Canonical cosine if there are no canonical phrases; otherwise the lower bound of their
    /// largest cosine.
    pub anything: f32,
    /// Distribution of the best margin for absent names.
    pub absent: MarginDistribution,
    /// Whether the constants were measured with this encoder. Otherwise they follow from published
    /// statistics of encoders of its kind.
    pub measured: bool,
}

/// Gumbel distribution of the best margin among many objects for an absent name, in log-odds.
///
/// The mode increases with the logarithm of the number of objects. For independent objects the
/// increase would equal the scale. Objects of a scene overlap, and names contribute most of the
/// scale, so `growth` is measured separately.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarginDistribution {
    /// Mode for one object.
    pub mode: f32,
    /// Scale.
    pub scale: f32,
    /// Increase of the mode when the number of objects grows by a factor of e.
    pub growth: f32,
}

/// The largest margin of a scene's objects for one query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Best {
    /// Largest margin of all objects, in units of cosine.
    pub margin: f32,
    /// Mean of the largest margins of the two halves of the objects.
    pub halves_margin: f32,
    /// Number of objects compared.
    pub objects: usize,
}

/// Cosines of an encoder with labelled objects.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// For each present name: the cosine of its own object minus the mean of the other objects, and
    /// the variance of the others.
    pub excesses: Vec<[f32; 2]>,
    /// Best margins of scenes for absent names.
    pub absent: Vec<Best>,
}

impl Samples {
    /// Adds one name: its cosine with the object that has it, and its cosines with other objects of
    /// the same scene.
    ///
    /// Ignores the name if there are fewer than two other objects. Only the spread around each
    /// name's own mean counts, because the means of names differ.
    pub fn add_name(&mut self, own: f32, others: &[f32]) {
        if others.len() > 1 {
            let (mean, variance) = moments(others);
            self.excesses.push([own - mean, variance]);
        }
    }

    /// Returns the mean distance between an object's cosine with its own name and the mean of the
    /// other objects, in standard deviations of the latter.
    pub fn separation(&self) -> f32 {
        let [excess, variance] = [0, 1].map(|k| {
            self.excesses
                .iter()
                .map(|name_excess| name_excess[k])
                .sum::<f32>()
                / self.excesses.len().max(1) as f32
        });
        excess / variance.sqrt()
    }

    /// Appends the samples of another scene.
    pub fn extend(&mut self, other: &Self) {
        self.excesses.extend(&other.excesses);
        self.absent.extend(&other.absent);
    }
}

/// Returns mean and variance.
fn moments(values: &[f32]) -> (f32, f32) {
    let n = values.len().max(1) as f32;
    let mean = values.iter().sum::<f32>() / n;
    (
        mean,
        values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n,
    )
}

/// Fits a Gumbel distribution to the upper half of `values`; returns mode and scale.
///
/// Uses least squares over the quantiles. Only high scores decide queries, and lower ones do not
/// follow this distribution.
fn gumbel(values: &[f32]) -> [f32; 2] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let share = |k: usize| (k as f32 + 0.5) / sorted.len() as f32;
    let upper: Vec<(f32, f32)> = (sorted.len() / 2..sorted.len())
        .map(|k| (-(-share(k).ln()).ln(), sorted[k]))
        .collect();
    let n = upper.len() as f32;
    let (x, y) = upper
        .iter()
        .fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
    let covariance: f32 = upper.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    let scale = covariance / upper.iter().map(|p| (p.0 - x).powi(2)).sum::<f32>();
    [y - scale * x, scale]
}

impl MarginDistribution {
    /// Fits the distribution to the best margins of scenes. Returns `None` if they do not vary.
    fn of(best: &[Best], temperature: f32) -> Option<Self> {
        let doubled: f32 =
            best.iter().map(|b| b.margin - b.halves_margin).sum::<f32>() / best.len().max(1) as f32;
        let growth = temperature * doubled / std::f32::consts::LN_2;
        let [mode, scale] = gumbel(
            &best
                .iter()
                .map(|b| temperature * b.margin - growth * (b.objects as f32).ln())
                .collect::<Vec<_>>(),
        );
        (scale > 0.0).then_some(Self {
            mode,
            scale,
            growth,
        })
    }

    /// Returns the share of absent names whose best margin among `objects` objects is smaller than
    /// `excess`. `excess` is in log-odds.
    pub fn below(&self, excess: f32, objects: usize) -> f32 {
        let mode = self.mode + self.growth * (objects.max(1) as f32).ln();
        (-(-(excess - mode) / self.scale).exp()).exp()
    }
}

impl Calibration {
    /// Text queries with the offline encoder.
    ///
    /// Measured by `bench names` on three photographed scenes with 40 absent names, with and
    /// without a colour. A sentence encoder has no useful embeddings of canonical phrases, so a
    /// fixed cosine replaces them.
    pub const OFFLINE: Self = Self {
        temperature: 20.8,
        anything: 0.6,
        absent: MarginDistribution {
            mode: -4.65,
            scale: 0.89,
            growth: 0.43,
        },
        measured: true,
    };

    /// Example queries with the offline encoder, measured on every seventh object of the same
    /// scenes.
    ///
    /// The inner product of two embeddings is the cosine of their classes plus twice the cosine of
    /// their appearances, so identical pictures reach 3. `absent` was measured in the other scenes
    /// with all embeddings of an object, as taught names store them.
    pub const OFFLINE_PICTURES: Self = Self {
        temperature: 5.0,
        anything: 1.8,
        absent: MarginDistribution {
            mode: -4.5,
            scale: 0.72,
            growth: 0.48,
        },
        measured: true,
    };

    /// Example queries with a CLIP that was not measured. The constants are those of the offline
    /// encoder's text embeddings, compared between pictures.
    pub const CLIP_PICTURES: Self = Self {
        temperature: 26.0,
        anything: 0.6,
        absent: MarginDistribution {
            mode: 4.66,
            scale: 0.76,
            growth: 0.38,
        },
        measured: false,
    };

    /// Text queries with CLIP, from published statistics of cosines.
    ///
    /// They are 0.28 +- 0.02 for the right object, 0.20 +- 0.02 for others and 0.21 +- 0.015 for
    /// canonical phrases. Assumes independent objects with three views each.
    pub const CLIP: Self = Self {
        temperature: 200.0,
        anything: -1.0,
        absent: MarginDistribution {
            mode: 2.3,
            scale: 1.34,
            growth: 1.34,
        },
        measured: false,
    };

    /// Computes a calibration from samples.
    ///
    /// Models the cosines of right and other objects as two Gaussians with one variance. Their
    /// log-odds increase with the cosine by (difference of the means) / variance.
    /// The best margins for absent names follow a Gumbel distribution.
    /// Returns `None` with fewer than two samples of a kind, or if names do not separate objects.
    pub fn measured(samples: &Samples, anything: f32) -> Option<Self> {
        let [excess, variance] = [0, 1].map(|k| {
            samples
                .excesses
                .iter()
                .map(|name_excess| name_excess[k])
                .sum::<f32>()
        });
        let temperature = excess / variance;
        if samples.excesses.len().min(samples.absent.len()) < 2
            || !temperature.is_finite()
            || temperature <= 0.0
        {
            return None;
        }
        Some(Self {
            temperature,
            anything,
            absent: MarginDistribution::of(&samples.absent, temperature)?,
            measured: true,
        })
    }

    /// Returns the share of absent names whose best margin among `objects` objects is smaller than
    /// `margin`. `margin` is in units of cosine.
    pub fn confidence(&self, margin: f32, objects: usize) -> f32 {
        self.absent.below(self.temperature * margin, objects)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    /// Cosines of `objects` objects with CLIP's statistics. The first one is the right object if
    /// `present`.
    fn scene(rng: &mut Rng, objects: usize, present: bool) -> Vec<f32> {
        (0..objects)
            .map(|k| if present && k == 0 { 0.28 } else { 0.20 } + 0.02 * rng.normal())
            .collect()
    }

    fn best(cosines: &[f32]) -> f32 {
        cosines.iter().copied().fold(f32::NEG_INFINITY, f32::max)
    }

    #[test]
    fn false_alarm_rate_is_the_accepted_rate_with_clip_statistics() {
        let rng = &mut Rng::new(7, "calibration");
        let anything = 0.21;
        // Calibrates on scenes of 40 objects and tests on scenes of 40 and 400. The maximum of
        // Gaussians grows more slowly than a Gumbel mode, so larger scenes give fewer false alarms
        // than accepted.
        let (few, many) = (40, 400);
        let (mut samples, mut blind) = (Samples::default(), Samples::default());
        for _ in 0..60 {
            let cosines = scene(rng, few, true);
            samples.add_name(cosines[0], &cosines[1..]);
            blind.add_name(0.1, &cosines[1..]);
        }
        for _ in 0..1280 {
            let cosines = scene(rng, few, false);
            let (one, other) = cosines.split_at(few / 2);
            let of_halves = 0.5 * (best(one) + best(other)) - anything;
            samples.absent.push(Best {
                margin: best(&cosines) - anything,
                halves_margin: of_halves,
                objects: few,
            });
        }
        let calibration =
            Calibration::measured(&samples, anything).expect("the samples are separable");
        assert!(
            (calibration.temperature / 200.0 - 1.0).abs() < 0.15,
            "{calibration:?}"
        );
        for (objects, fewest) in [(few, 1.0 / 1.5), (many, 0.1)] {
            for share in [0.05, 0.1, 0.2] {
                let alarms = (0..4000).filter(|_| {
                    calibration.confidence(best(&scene(rng, objects, false)) - anything, objects)
                        >= 1.0 - share
                });
                let factor = alarms.count() as f32 / 4000.0 / share;
                assert!(
                    (fewest..1.5).contains(&factor),
                    "accepted rate {share} with {objects} objects: {factor} times as many false alarms"
                );
            }
        }
        assert_eq!(
            Calibration::measured(
                &Samples {
                    absent: samples.absent,
                    ..blind
                },
                anything
            ),
            None
        );
    }

    #[test]
    fn clip_calibration_matches_published_statistics() {
        let rng = &mut Rng::new(9, "law");
        for objects in [50usize, 200, 800] {
            let margin = |rng: &mut Rng| {
                0.20 + 0.02 * rng.normal() - (0.21 + 0.015 / 3f32.sqrt() * rng.normal())
            };
            let mut bests: Vec<f32> = (0..2000)
                .map(|_| (0..objects).map(|_| margin(rng)).fold(f32::MIN, f32::max))
                .collect();
            bests.sort_by(f32::total_cmp);
            let at = Calibration::CLIP.confidence(bests[1860], objects);
            assert!(
                (0.90..0.96).contains(&at),
                "confidence at the 93rd percentile with {objects} objects: {at}"
            );
        }
    }
}
