//! What an encoder's cosines are worth: the odds that an object is what a text means, and what scores mean.

use serde::{Deserialize, Serialize};

/// What an encoder's cosines are worth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Log-odds of a unit of cosine: by how much the cosine of a thing with its name exceeds those of other things, over the variance of the latter.
    pub temperature: f32,
    /// The cosine from which odds count, where no phrases stand for "anything".
    pub anything: f32,
    /// What names of absent things reach.
    pub absent: Law,
    /// Whether all this was measured with the encoder; otherwise it follows from figures that are published about its kind.
    pub measured: bool,
}

/// How likely the best of many objects is to exceed "anything" by so much where what is asked for is absent: Gumbel's law, whose mode rises with the
/// logarithm of the number of objects. For things that have nothing in common it would rise by the scale; objects of a scene lie in each other, and
/// most of the scale is that names differ, so that this is measured as well.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Law {
    /// Mode for one object.
    pub mode: f32,
    /// Scale.
    pub scale: f32,
    /// What the mode rises by where there are e times as many objects.
    pub growth: f32,
}

/// By how much the object of a scene that is most like what is meant is more so than like anything.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Best {
    /// In units of cosine.
    pub margin: f32,
    /// The mean of the same for each half of the objects.
    pub of_halves: f32,
    /// Objects that were compared.
    pub objects: usize,
}

/// Cosines of an encoder with things that are known.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// For each name of a thing that is there: by how much the thing's cosine with it exceeds the mean of the others, and the variance of these.
    pub told: Vec<[f32; 2]>,
    /// The best objects of scenes where what is asked for is absent.
    pub absent: Vec<Best>,
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

    /// By how many standard deviations of other things' cosines with a name the thing that has it exceeds their mean.
    pub fn separation(&self) -> f32 {
        let [excess, variance] = [0, 1].map(|k| self.told.iter().map(|told| told[k]).sum::<f32>() / self.told.len().max(1) as f32);
        excess / variance.sqrt()
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

impl Law {
    /// The law that comes nearest to the best objects of some scenes; nothing where these do not differ.
    fn of(best: &[Best], temperature: f32) -> Option<Self> {
        let doubled: f32 = best.iter().map(|b| b.margin - b.of_halves).sum::<f32>() / best.len().max(1) as f32;
        let growth = temperature * doubled / std::f32::consts::LN_2;
        let [mode, scale] = gumbel(&best.iter().map(|b| temperature * b.margin - growth * (b.objects as f32).ln()).collect::<Vec<_>>());
        (scale > 0.0).then_some(Self { mode, scale, growth })
    }

    /// The share of absent names that exceed "anything" by less, in log-odds, among so many objects.
    pub fn below(&self, excess: f32, objects: usize) -> f32 {
        let mode = self.mode + self.growth * (objects.max(1) as f32).ln();
        (-(-(excess - mode) / self.scale).exp()).exp()
    }
}

impl Calibration {
    /// Texts and the offline encoder, measured by `bench names` on two trainings each of three photographed scenes (20.2 and 21.5; by maximum likelihood
    /// 18 to 25); the law of 40 absent names there, with a colour and without.
    /// A sentence model has no picture of "object" or "stuff", so that a fixed cosine stands for "anything".
    pub const OFFLINE: Self =
        Self { temperature: 20.8, anything: 0.6, absent: Law { mode: -4.65, scale: 0.89, growth: 0.43 }, measured: true };

    /// Pictures and the offline encoder: every seventh object of the same scenes, by one view of it. Its embeddings tell kinds of things once and single
    /// things twice, so that 3 is the same picture; 2.06 with an object's other views and 0.61 with other objects. The law is that of all that is embedded of an
    /// object, which is what a lesson keeps, in the other scenes.
    pub const OFFLINE_PICTURES: Self =
        Self { temperature: 5.0, anything: 1.8, absent: Law { mode: -4.5, scale: 0.72, growth: 0.48 }, measured: true };

    /// Pictures and a CLIP that was not measured, which may know kinds of things better than single ones: what the offline encoder's words are worth
    /// between pictures (cosine 0.89 with other views of a thing and 0.65 with others).
    pub const CLIP_PICTURES: Self =
        Self { temperature: 26.0, anything: 0.6, absent: Law { mode: 4.66, scale: 0.76, growth: 0.38 }, measured: false };

    /// CLIP's towers, from their published statistics (right 0.28 +- 0.02, wrong 0.20 +- 0.02, canonical phrases 0.21 +- 0.015), for things
    /// that have nothing in common and that three views show.
    pub const CLIP: Self =
        Self { temperature: 200.0, anything: -1.0, absent: Law { mode: 2.3, scale: 1.34, growth: 1.34 }, measured: false };

    /// Follows from samples: cosines that are spread like a Gaussian around two means with one variance have log-odds that rise with the cosine by the
    /// means' distance over the variance, and the best of many things is spread like Gumbel's law. Nothing where names do not tell things
    /// apart, or there are fewer than two samples of a kind.
    pub fn measured(samples: &Samples, anything: f32) -> Option<Self> {
        let [excess, variance] = [0, 1].map(|k| samples.told.iter().map(|told| told[k]).sum::<f32>());
        let temperature = excess / variance;
        if samples.told.len().min(samples.absent.len()) < 2 || !temperature.is_finite() || temperature <= 0.0 {
            return None;
        }
        Some(Self { temperature, anything, absent: Law::of(&samples.absent, temperature)?, measured: true })
    }

    /// The share of absent names that no object of so many exceeds "anything" by as much, in units of cosine.
    pub fn confidence(&self, margin: f32, objects: usize) -> f32 {
        self.absent.below(self.temperature * margin, objects)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

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
        let anything = 0.21;
        // Measured on scenes of 40 things, asked in scenes of ten times as many, where the best of Gaussians grows less than Gumbel's law has it:
        // there are fewer alarms than asked for, not more.
        let (few, many) = (40, 400);
        let (mut samples, mut blind) = (Samples::default(), Samples::default());
        for _ in 0..60 {
            let cosines = scene(rng, few, true);
            samples.tell(cosines[0], &cosines[1..]);
            blind.tell(0.1, &cosines[1..]);
        }
        for _ in 0..1280 {
            let cosines = scene(rng, few, false);
            let (one, other) = cosines.split_at(few / 2);
            let of_halves = 0.5 * (best(one) + best(other)) - anything;
            samples.absent.push(Best { margin: best(&cosines) - anything, of_halves, objects: few });
        }
        let calibration = Calibration::measured(&samples, anything).expect("they can be told apart");
        assert!((calibration.temperature / 200.0 - 1.0).abs() < 0.15, "{calibration:?}");
        for (objects, fewest) in [(few, 1.0 / 1.5), (many, 0.1)] {
            for share in [0.05, 0.1, 0.2] {
                let alarms =
                    (0..4000).filter(|_| calibration.confidence(best(&scene(rng, objects, false)) - anything, objects) >= 1.0 - share);
                let factor = alarms.count() as f32 / 4000.0 / share;
                assert!((fewest..1.5).contains(&factor), "asked for {share} of {objects}: {factor} times as many");
            }
        }
        assert_eq!(Calibration::measured(&Samples { absent: samples.absent, ..blind }, anything), None);
    }

    #[test]
    fn clips_law_is_that_of_its_published_statistics() {
        let rng = &mut Rng::new(9, "law");
        for objects in [50usize, 200, 800] {
            let margin = |rng: &mut Rng| 0.20 + 0.02 * rng.normal() - (0.21 + 0.015 / 3f32.sqrt() * rng.normal());
            let mut bests: Vec<f32> = (0..2000).map(|_| (0..objects).map(|_| margin(rng)).fold(f32::MIN, f32::max)).collect();
            bests.sort_by(f32::total_cmp);
            let at = Calibration::CLIP.confidence(bests[1860], objects);
            assert!((0.90..0.96).contains(&at), "93 of 100 of {objects} objects: {at}");
        }
    }
}
