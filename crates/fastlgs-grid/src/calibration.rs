//! What an encoder's cosines are worth: the odds that an object is what a text means, and what scores mean.

use serde::{Deserialize, Serialize};

/// What an encoder's cosines are worth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds of a unit of cosine: by how much the cosine of a thing with its name exceeds those of other things, over the variance of the latter.
    pub temperature: f32,
    /// The cosine from which odds count, where no phrases stand for "anything".
    pub anything: f32,
    /// Mode and scale of the Gumbel distribution of the best log-odds in a scene, without sizes, that names of absent things reach.
    pub absent: [f32; 2],
    /// Whether all this was measured with the encoder; otherwise it follows from figures that are published about its kind.
    pub measured: bool,
}

/// Cosines of an encoder with things that are known.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// For each name of a thing that is there: by how much the thing's cosine with it exceeds the mean of the others, and the variance of these.
    pub told: Vec<[f32; 2]>,
    /// By how much the best object of a scene exceeds "anything" where what is asked for is absent.
    pub absent: Vec<f32>,
}

impl Samples {
    /// Adds the cosines of a name with the thing that has it, and with other things of the same scene. Names differ in how like anything is to
    /// them, which tells no thing from another: only the spread around the mean of each counts.
    pub fn tell(&mut self, own: f32, others: &[f32]) {
        if others.len() > 1 {
            let (mean, variance) = moments(others);
            self.told.push([own - mean, variance]);
        }
    }

    /// Those of several scenes.
    pub fn extend(&mut self, other: &Self) {
        self.told.extend(&other.told);
        self.absent.extend(&other.absent);
    }
}

/// Mean and variance.
fn moments(values: &[f32]) -> (f32, f32) {
    let n = values.len().max(1) as f32;
    let mean = values.iter().sum::<f32>() / n;
    (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n)
}

/// Mode and scale of the Gumbel distribution that comes nearest to the upper half of some values, by least squares over their quantiles: what
/// counts is where scores are high, and below that they follow no such law.
fn gumbel(values: &[f32]) -> [f32; 2] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let share = |k: usize| (k as f32 + 0.5) / sorted.len() as f32;
    let upper: Vec<(f32, f32)> = (sorted.len() / 2..sorted.len()).map(|k| (-(-share(k).ln()).ln(), sorted[k])).collect();
    let n = upper.len() as f32;
    let (x, y) = upper.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
    let covariance: f32 = upper.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    let scale = covariance / upper.iter().map(|p| (p.0 - x).powi(2)).sum::<f32>();
    [y - scale * x, scale]
}

impl Calibration {
    /// Texts and the offline encoder, measured on three photographed scenes, whose temperatures are 20 to 23 (those that tell each name apart best, by maximum likelihood, are 18 to 25); the law of 40 absent names there, with a colour and without.
    /// A sentence model has no picture of "object" or "stuff", so that a fixed cosine stands for "anything".
    pub const OFFLINE: Self = Self { temperature: 21.5, anything: 0.6, absent: [-2.06, 0.92], measured: true };

    /// Pictures and the offline encoder: every seventh object of the same scenes, by one view of it; cosine 0.88 with its other views and 0.66 with
    /// other objects. It knows kinds of things, not the single thing: what is elsewhere is hardly ever told to be the same.
    pub const OFFLINE_PICTURES: Self = Self { temperature: 26.0, anything: 0.6, absent: [6.4, 0.82], measured: true };

    /// CLIP's towers, from their published statistics (right 0.28 +- 0.02, wrong 0.20 +- 0.02, canonical phrases 0.21 +- 0.015), for scenes of 200
    /// objects that five views show.
    pub const CLIP: Self = Self { temperature: 200.0, anything: -1.0, absent: [9.0, 1.3], measured: false };

    /// Follows from samples: cosines that are spread like a Gaussian around two means with one variance have log-odds that rise with the cosine by the
    /// means' distance over the variance, and the best of many things is spread like Gumbel's law. Nothing where names do not tell things
    /// apart, or there are fewer than two samples of a kind.
    pub fn measured(samples: &Samples, anything: f32) -> Option<Self> {
        let [excess, variance] = [0, 1].map(|k| samples.told.iter().map(|told| told[k]).sum::<f32>());
        let temperature = excess / variance;
        if samples.told.len().min(samples.absent.len()) < 2 || !temperature.is_finite() || temperature <= 0.0 {
            return None;
        }
        let absent = gumbel(&samples.absent.iter().map(|margin| temperature * margin).collect::<Vec<_>>());
        (absent[1] > 0.0).then_some(Self { temperature, anything, absent, measured: true })
    }

    /// The share of absent names whose best log-odds in a scene are lower.
    pub fn confidence(&self, log_odds: f32) -> f32 {
        let [mode, scale] = self.absent;
        (-(-(log_odds - mode) / scale).exp()).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    #[test]
    fn confidence_is_the_share_of_absent_names() {
        let Calibration { absent: [mode, scale], .. } = Calibration::OFFLINE;
        for share in [0.05f32, 0.5, 0.95] {
            let at = mode - scale * (-share.ln()).ln();
            assert!((Calibration::OFFLINE.confidence(at) - share).abs() < 1e-3, "{share}");
        }
    }

    /// A scene of `objects` whose cosines have CLIP's statistics: that of the right one, where there is one, and those of the others.
    fn scene(rng: &mut Rng, objects: usize, present: bool) -> Vec<f32> {
        (0..objects).map(|k| if present && k == 0 { 0.28 } else { 0.20 } + 0.02 * rng.normal()).collect()
    }

    fn best(cosines: &[f32]) -> f32 {
        cosines.iter().copied().fold(f32::NEG_INFINITY, f32::max)
    }

    #[test]
    fn false_alarms_are_as_asked_with_clips_statistics() {
        let rng = &mut Rng::new(7, "calibration");
        let (objects, anything) = (200, 0.21);
        let mut samples = Samples::default();
        let mut blind = Samples::default();
        for _ in 0..20 {
            let cosines = scene(rng, objects, true);
            samples.tell(cosines[0], &cosines[1..]);
            blind.tell(0.1, &cosines[1..]);
        }
        samples.absent = (0..320).map(|_| best(&scene(rng, objects, false)) - anything).collect();
        let calibration = Calibration::measured(&samples, anything).expect("they can be told apart");
        assert!((calibration.temperature / 200.0 - 1.0).abs() < 0.15, "{calibration:?}");
        for share in [0.05, 0.1, 0.2] {
            let alarms = (0..4000).filter(|_| {
                let margin = best(&scene(rng, objects, false)) - anything;
                calibration.confidence(calibration.temperature * margin) >= 1.0 - share
            });
            let factor = alarms.count() as f32 / 4000.0 / share;
            assert!((1.0 / 1.5..1.5).contains(&factor), "asked for {share}: {factor} times as many");
        }
        assert_eq!(Calibration::measured(&Samples { absent: samples.absent, ..blind }, anything), None);
    }
}
