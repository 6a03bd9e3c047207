//! What an encoder's cosines are worth: the odds that an object is what a text means, and what scores mean.

use serde::{Deserialize, Serialize};

/// What an encoder's cosines are worth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds of a unit of cosine: by how much the cosines of things with their names exceed those of others, over the variance of the latter.
    pub temperature: f32,
    /// By how many standard deviations of the latter they exceed them.
    pub separation: f32,
    /// By how much things exceed "anything" on the average where something else is meant.
    pub wrong: f32,
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
    /// Mean cosines of things with what they are.
    pub right: Vec<f32>,
    /// Those with what other things are.
    pub wrong: Vec<f32>,
    /// By how much things exceed "anything" where what is asked for is absent.
    pub margins: Vec<f32>,
    /// By how much the best place of a scene does, then.
    pub absent: Vec<f32>,
    /// The same where what is asked for has a colour or a material in its name.
    pub colored: Vec<f32>,
}

impl Samples {
    /// By how many standard deviations of the wrong cosines the right ones exceed them.
    pub fn separation(&self) -> f32 {
        let ((right, _), (wrong, variance)) = (moments(&self.right), moments(&self.wrong));
        (right - wrong) / variance.sqrt()
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
    /// Texts and the offline encoder, measured on three photographed scenes, whose separations are 0.6 to 1.5; the law of 40 absent names there and in
    /// the generated room, by its offline masks and by exact ones.
    /// A sentence model has no picture of "object" or "stuff", so that a fixed cosine stands for "anything".
    pub const OFFLINE: Self =
        Self { temperature: 20.0, separation: 1.25, wrong: -0.22, anything: 0.6, absent: [-2.38, 0.72], measured: true };

    /// The same for texts that name a colour or a material as well, on which more depends on what colours a scene has.
    pub const OFFLINE_COLORED: Self = Self { absent: [-5.1, 1.76], ..Self::OFFLINE };

    /// Pictures and the offline encoder: every seventh object of the same scenes, by one view of it; cosine 0.88 with its other views and 0.66 with
    /// other objects. It knows kinds of things, not the single thing: what is elsewhere is hardly ever told to be the same.
    pub const OFFLINE_PICTURES: Self =
        Self { temperature: 13.4, separation: 1.92, wrong: 0.06, anything: 0.6, absent: [1.91, 0.73], measured: true };

    /// CLIP's towers, from their published statistics (right 0.28 +- 0.02, wrong 0.20 +- 0.02, canonical phrases 0.21 +- 0.015), drawn for scenes of 200
    /// objects.
    pub const CLIP: Self = Self { temperature: 200.0, separation: 4.0, wrong: -0.02, anything: -1.0, absent: [7.1, 1.35], measured: false };

    /// Follows from samples: cosines that are spread like a Gaussian around two means with one variance have log-odds that rise with the cosine by the
    /// means' distance over the variance, and the best of many things is spread like Gumbel's law. Nothing where right and wrong cannot be told
    /// apart, or there are fewer than two samples of a kind.
    pub fn measured(samples: &Samples, anything: f32) -> Option<Self> {
        let least = [&samples.right, &samples.wrong, &samples.absent].into_iter().map(Vec::len).min();
        let ((right, _), (wrong, variance)) = (moments(&samples.right), moments(&samples.wrong));
        let (temperature, separation) = ((right - wrong) / variance, samples.separation());
        if least < Some(2) || !temperature.is_finite() || temperature <= 0.0 {
            return None;
        }
        let wrong = moments(&samples.margins).0;
        Self { temperature, separation, wrong, anything, absent: [0.0; 2], measured: true }.judged_by(&samples.absent)
    }

    /// The same with the law that the best places of scenes follow where what is asked for is absent; nothing where there are too few of them.
    pub fn judged_by(self, best: &[f32]) -> Option<Self> {
        let absent = gumbel(&best.iter().map(|margin| self.temperature * margin).collect::<Vec<_>>());
        (absent[1] > 0.0).then_some(Self { absent, ..self })
    }

    /// The same, with what follows from samples that lack those of best places, which depend on it.
    pub fn so_far(self, samples: &Samples) -> Self {
        Self { separation: samples.separation(), wrong: moments(&samples.margins).0, ..self }
    }

    /// Objects of a scene of which about one is what a text names.
    pub const AMONG: f32 = 50.0;

    /// How far an object's own cosine is to be trusted against what is usual around it, 0 to 1: the chance that an object which is as like a text
    /// as the right one is the right one, among [`Self::AMONG`], by the likelihood ratio of two Gaussians.
    pub fn trust(&self) -> f32 {
        1.0 / (1.0 + Self::AMONG * (-0.5 * self.separation.powi(2)).exp())
    }

    /// Correlation of what is said of a thing and of something that it lies in, where neither is meant: 0.20 to 0.21 on three photographed scenes.
    const CORRELATION: f32 = 0.2;

    /// Standard deviation of the mean of what is said of so many things that lie in each other, over that of one.
    pub fn spread_of_mean(&self, count: f32) -> f32 {
        (Self::CORRELATION + (1.0 - Self::CORRELATION) / count).sqrt()
    }

    /// The power of an object's size that weighs as much as its excess of likeness. Log-odds rise with the excess over the variance: where
    /// things are told apart by so many standard deviations, by their square for each factor of e; by twice that after pooling.
    pub fn size_exponent(&self) -> f32 {
        0.5 / self.separation.powi(2).max(0.5)
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
        for _ in 0..20 {
            let cosines = scene(rng, objects, true);
            samples.right.push(cosines[0]);
            samples.wrong.extend(&cosines[1..]);
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
        let blind = Samples { right: samples.wrong.clone(), wrong: samples.right.clone(), ..samples };
        assert_eq!(Calibration::measured(&blind, anything), None);
    }
}
