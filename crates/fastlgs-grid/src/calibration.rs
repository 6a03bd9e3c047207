//! What an encoder's cosines are worth: the odds that an object is what a text means, and what scores mean.

use serde::{Deserialize, Serialize};

/// What an encoder's cosines are worth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds of a unit of cosine: by how much the cosines of things with their names exceed those of others, over the variance of the latter.
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
    /// Mean cosines of things with what they are.
    pub right: Vec<f32>,
    /// Those with what other things are.
    pub wrong: Vec<f32>,
    /// By how much the best thing of a scene exceeds "anything" where what is asked for is absent.
    pub absent: Vec<f32>,
}

/// Mean and variance.
fn moments(values: &[f32]) -> (f32, f32) {
    let n = values.len().max(1) as f32;
    let mean = values.iter().sum::<f32>() / n;
    (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n)
}

/// Mode and scale of the Gumbel distribution under which values are likeliest: a fixed point that some steps come near from the moments' scale.
fn gumbel(values: &[f32]) -> [f32; 2] {
    const STEPS: usize = 50;
    let (mean, variance) = moments(values);
    let mut scale = variance.sqrt() * 6.0f32.sqrt() / std::f32::consts::PI;
    let weights = |scale: f32| values.iter().map(move |v| (-(v - mean) / scale).exp());
    for _ in 0..STEPS {
        let total: f32 = weights(scale).sum();
        let own = mean - weights(scale).zip(values).map(|(w, v)| w * v).sum::<f32>() / total;
        scale = 0.5 * (scale + own);
    }
    [mean - scale * (weights(scale).sum::<f32>() / values.len() as f32).ln(), scale]
}

impl Calibration {
    /// Texts and the offline encoder, measured on three photographed scenes and the generated room and table, whose temperatures are 14, 20, 22,
    /// 29 and 34. A sentence model has no picture of "object" or "stuff", so that a fixed cosine stands for "anything".
    pub const OFFLINE: Self = Self { temperature: 20.0, anything: 0.6, absent: [-2.56, 1.36], measured: true };

    /// Pictures and the offline encoder: views of some 900 objects of two photographed scenes, cosine 0.85 with other views of the same one and 0.65
    /// with others. It knows kinds of things, not the single thing: what is elsewhere is hardly ever told to be the same.
    pub const OFFLINE_PICTURES: Self = Self { temperature: 13.4, anything: 0.6, absent: [3.6, 0.69], measured: true };

    /// CLIP's towers, from their published statistics (right 0.28 +- 0.02, wrong 0.20 +- 0.02, canonical phrases 0.21 +- 0.015) drawn for the objects
    /// of three scenes. Twice the temperature that follows: without a measurement the text decides unless it is nearly level.
    pub const CLIP: Self = Self { temperature: 400.0, anything: -1.0, absent: [17.0, 2.6], measured: false };

    /// Follows from samples: cosines that are spread like a Gaussian around two means with one variance have log-odds that rise with the cosine by the
    /// means' distance over the variance, and the best of many things is spread like Gumbel's law. Nothing where right and wrong cannot be told
    /// apart, or there are fewer than two samples of a kind.
    pub fn measured(samples: &Samples, anything: f32) -> Option<Self> {
        let least = [&samples.right, &samples.wrong, &samples.absent].into_iter().map(Vec::len).min();
        let ((right, _), (wrong, variance)) = (moments(&samples.right), moments(&samples.wrong));
        let temperature = (right - wrong) / variance;
        if least < Some(2) || !temperature.is_finite() || temperature <= 0.0 {
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
        for _ in 0..20 {
            let cosines = scene(rng, objects, true);
            samples.right.push(cosines[0]);
            samples.wrong.extend(&cosines[1..]);
        }
        samples.absent = (0..160).map(|_| best(&scene(rng, objects, false)) - anything).collect();
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
