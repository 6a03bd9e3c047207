//! Parameters learned beside the Gaussians: exposures of the training views, and the background.
//! They are few numbers, so the host runs Adam on them.

use crate::engine::{Exposure, Losses};
use serde::{Deserialize, Serialize};

/// Values with both moments of Adam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Learned<const N: usize> {
    #[serde(with = "array")]
    pub values: [f32; N],
    #[serde(with = "array")]
    moment1: [f32; N],
    #[serde(with = "array")]
    moment2: [f32; N],
    steps: i32,
}

/// Needed because serde does not implement arrays whose length is a parameter.
mod array {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer, const N: usize>(
        values: &[f32; N],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        values.as_slice().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(
        deserializer: D,
    ) -> Result<[f32; N], D::Error> {
        let values = Vec::<f32>::deserialize(deserializer)?;
        values.try_into().map_err(|v: Vec<f32>| {
            serde::de::Error::invalid_length(v.len(), &"as many values as the array has")
        })
    }
}

impl<const N: usize> Learned<N> {
    pub fn new(values: [f32; N]) -> Self {
        Self {
            values,
            moment1: [0.0; N],
            moment2: [0.0; N],
            steps: 0,
        }
    }

    pub fn step(&mut self, gradient: [f64; N], rate: f32) {
        self.steps += 1;
        let (c1, c2) = (
            1.0 - 0.9f32.powi(self.steps),
            1.0 - 0.999f32.powi(self.steps),
        );
        for k in 0..N {
            let g = gradient[k] as f32;
            self.moment1[k] = 0.9 * self.moment1[k] + 0.1 * g;
            self.moment2[k] = 0.999 * self.moment2[k] + 0.001 * g * g;
            self.values[k] -=
                rate * (self.moment1[k] / c1) / ((self.moment2[k] / c2).sqrt() + 1e-15);
        }
    }
}

/// Learning rate of the background.
pub(crate) const BACKGROUND_RATE: f32 = 1e-3;
/// Learning rates of exposures at the start and the end of a run.
const RATES: [f32; 2] = [1e-2, 1e-3];
/// Gain above which nearly white pixels of a photo are treated as clipped.
const CLIPPED_GAIN: f32 = 1.05;
/// 8-bit value from which a pixel may be clipped at white.
const CLIPPED_VALUE: u8 = 250;

/// Exposure of one view: logarithms of three gains, and three offsets.
pub(crate) type LearnedExposure = Learned<6>;

impl LearnedExposure {
    /// Starts from the brightness of a photo that was measured before training.
    pub fn from_gain(gain: [f32; 3]) -> Self {
        let [a, b, c] = gain.map(f32::ln);
        Self::new([a, b, c, 0.0, 0.0, 0.0])
    }

    pub fn exposure(&self) -> Exposure {
        let [a, b, c, d, e, f] = self.values;
        Exposure {
            gain: [a, b, c].map(f32::exp),
            offset: [d, e, f],
        }
    }

    /// Runs one Adam step; `progress` is the share of the run that is done.
    pub fn learn(&mut self, losses: &Losses, progress: f32) {
        let gain = self.exposure().gain;
        let [a, b, c]: [f64; 3] = std::array::from_fn(|k| losses.by_gain[k] * f64::from(gain[k]));
        let [d, e, f] = losses.by_offset;
        self.step(
            [a, b, c, d, e, f],
            RATES[0] * (RATES[1] / RATES[0]).powf(progress),
        );
    }
}

/// Shifts all exposures so that their mean is the identity. Otherwise the brightness of the scene
/// and of the exposures could drift against each other.
pub(crate) fn pin_mean(exposures: &mut [LearnedExposure]) {
    for k in 0..6 {
        let mean =
            exposures.iter().map(|e| e.values[k]).sum::<f32>() / exposures.len().max(1) as f32;
        exposures.iter_mut().for_each(|e| e.values[k] -= mean);
    }
}

/// Returns whether a pixel may be clipped at white, in a photo whose channels are `gain` times
/// brighter than the mean. The true brightness of such a pixel is unknown.
pub(crate) fn is_clipped(pixel: u32, gain: [f32; 3]) -> bool {
    pixel
        .to_le_bytes()
        .iter()
        .zip(gain)
        .any(|(value, gain)| gain > CLIPPED_GAIN && *value >= CLIPPED_VALUE)
}
