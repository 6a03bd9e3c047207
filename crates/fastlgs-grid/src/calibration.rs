//! Calibration of an encoder: converts cosines to log-odds, and margins to scores.

use serde::{Deserialize, Serialize};

/// Measured constants of an encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds per unit of margin: (mean margin of an object with its own name - mean margin of
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

/// Margins of an encoder with labelled objects.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// For each present name: the margin of its own object minus the mean of the other objects, and
    /// the variance of the others.
    pub excesses: Vec<[f32; 2]>,
    /// Best margins of scenes for absent names.
    pub absent: Vec<Best>,
}

impl Samples {
    /// Adds one name: its margin at the object that has it, and its margins at other objects of the
    /// same scene.
    ///
    /// Ignores the name if there are fewer than two other objects. Only the spread around each
    /// name's own mean counts, because the means of names differ.
    pub fn add_name(&mut self, own: f32, others: &[f32]) {
        if others.len() > 1 {
            let (mean, variance) = moments(others);
            self.excesses.push([own - mean, variance]);
        }
    }

    /// Returns the mean distance between an object's margin for its own name and the mean of the
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

/// Number of objects of a room, at which two calibrations are compared.
const TYPICAL_OBJECTS: usize = 60;
/// Largest difference of two thresholds that agree, in Gumbel scales. Rooms of ScanNet differ from
/// their common law by up to 0.5 scales.
const MOST_DIFFERENCE: f32 = 1.0;

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

    /// Returns the best margin among `objects` objects, in log-odds, that a share of absent names
    /// does not exceed.
    fn quantile(&self, share: f32, objects: usize) -> f32 {
        let mode = self.mode + self.growth * (objects.max(1) as f32).ln();
        mode - self.scale * (-share.ln()).ln()
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

    /// Text queries with OpenCLIP's models, from embeddings of OpenCLIP ViT-B/16.
    ///
    /// `temperature` and `scale` were measured by `fastlgs-bench clip` in five rooms of ScanNet with
    /// 32 absent names each. The 93 % quantile of the best margin of absent names in ten such rooms,
    /// -0.019 + 0.0100 ln K for K objects, gives `mode` and `growth`. In the five rooms alone it is
    /// -0.025 + 0.0113 ln K, which would answer 8.1 % of absent names in a room that was left out.
    pub const CLIP: Self = Self {
        temperature: 105.0,
        anything: -1.0,
        absent: MarginDistribution {
            mode: -6.3,
            scale: 1.65,
            growth: 1.05,
        },
        measured: false,
    };

    /// Text queries with OpenAI's models.
    ///
    /// `temperature` was measured by `fastlgs-bench clip` on 500 pairs of pictures and captions with
    /// ViT-B/32. The pairs have no canonical phrases, so the law of absent names is that of
    /// [`Self::CLIP`]. The pairs agree with it: their scale is 1.45 and their growth 1.39.
    pub const OPENAI_CLIP: Self = Self {
        temperature: 85.0,
        ..Self::CLIP
    };

    /// Example queries with any CLIP, from the rooms of [`Self::CLIP`].
    ///
    /// The nearest object of the same room stands for another view of an object, and gives
    /// `temperature`. Objects of other rooms without an object of that name are absent. `growth` is
    /// the slope between rooms of different size. The halves of a room overestimate it, because
    /// fragments of one object lie in both.
    pub const CLIP_PICTURES: Self = Self {
        temperature: 36.0,
        anything: 0.6,
        absent: MarginDistribution {
            mode: 6.3,
            scale: 0.74,
            growth: 0.54,
        },
        measured: false,
    };

    /// Computes a calibration from samples.
    ///
    /// Models the margins of right and other objects as two Gaussians with one variance. Their
    /// log-odds increase with the margin by (difference of the means) / variance.
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

    /// Returns the margin, in units of cosine, that a share `rate` of absent names reaches among
    /// `objects` objects.
    pub fn threshold(&self, rate: f32, objects: usize) -> f32 {
        self.absent.quantile(1.0 - rate, objects) / self.temperature
    }

    /// Returns whether absent names reach margins like those of `reference`, in log-odds.
    ///
    /// Compares what 7 % of absent names reach among 60 objects. The values may differ by the scale of
    /// `reference`.
    pub fn agrees_with(&self, reference: &Self) -> bool {
        let [own, other] = [self, reference].map(|c| c.absent.quantile(0.93, TYPICAL_OBJECTS));
        (own - other).abs() <= MOST_DIFFERENCE * reference.absent.scale
    }

    /// Checks a calibration from generated scenes against `reference`, which is from real rooms.
    ///
    /// If they disagree, generated scenes do not tell how near absent names come in real rooms. Then
    /// only the measured temperature is kept, and the calibration does not count as measured.
    #[must_use]
    pub fn checked_against(self, reference: &Self) -> Self {
        if self.agrees_with(reference) {
            return self;
        }
        Self {
            absent: reference.absent,
            measured: false,
            ..self
        }
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
    fn thresholds_are_the_quantiles_of_real_rooms() {
        // 93 % quantile of the best margins of absent names in ten rooms.
        for objects in [14usize, 60, 168] {
            let measured = -0.019 + 0.0100 * (objects as f32).ln();
            let threshold = Calibration::CLIP.threshold(0.07, objects);
            assert!(
                (threshold - measured).abs() < 0.001,
                "{threshold} among {objects} objects, measured {measured}"
            );
            let confidence = Calibration::CLIP.confidence(threshold, objects);
            assert!((confidence - 0.93).abs() < 1e-3, "{confidence}");
        }
        // The nearest object of another room has a cosine of 0.88 to 0.91 at the 93 % quantile.
        for objects in [21, 168] {
            let cosine = Calibration::CLIP_PICTURES.threshold(0.07, objects)
                + Calibration::CLIP_PICTURES.anything;
            assert!((0.86..0.92).contains(&cosine), "{cosine}");
        }
    }

    #[test]
    fn a_calibration_far_from_real_rooms_does_not_agree() {
        let clip = Calibration::CLIP;
        let shifted = |mode: f32| Calibration {
            absent: MarginDistribution {
                mode: clip.absent.mode + mode,
                ..clip.absent
            },
            ..clip
        };
        assert!(clip.agrees_with(&clip) && shifted(1.0).agrees_with(&clip));
        for mode in [4.0, -4.0] {
            let measured = Calibration {
                temperature: 50.0,
                measured: true,
                ..shifted(mode)
            };
            let checked = measured.checked_against(&clip);
            assert_eq!(
                (checked.temperature, checked.absent, checked.measured),
                (50.0, clip.absent, false)
            );
        }
    }
}
