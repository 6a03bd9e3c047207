//! What is learned beside the Gaussians: exposures of the training views, and the background. A handful of numbers, so the
//! host does their Adam.

use crate::engine::{Exposure, Losses};
use serde::{Deserialize, Serialize};

/// Some values with both moments of Adam.
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

/// serde knows arrays only up to fixed lengths, and not by a parameter.
mod array {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer, const N: usize>(values: &[f32; N], serializer: S) -> Result<S::Ok, S::Error> {
        values.as_slice().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(deserializer: D) -> Result<[f32; N], D::Error> {
        let values = Vec::<f32>::deserialize(deserializer)?;
        values.try_into().map_err(|v: Vec<f32>| serde::de::Error::invalid_length(v.len(), &"another number of values"))
    }
}

impl<const N: usize> Learned<N> {
    pub fn new(values: [f32; N]) -> Self {
        Self { values, moment1: [0.0; N], moment2: [0.0; N], steps: 0 }
    }

    pub fn step(&mut self, gradient: [f64; N], rate: f32) {
        self.steps += 1;
        let (c1, c2) = (1.0 - 0.9f32.powi(self.steps), 1.0 - 0.999f32.powi(self.steps));
        for k in 0..N {
            let g = gradient[k] as f32;
            self.moment1[k] = 0.9 * self.moment1[k] + 0.1 * g;
            self.moment2[k] = 0.999 * self.moment2[k] + 0.001 * g * g;
            self.values[k] -= rate * (self.moment1[k] / c1) / ((self.moment2[k] / c2).sqrt() + 1e-15);
        }
    }
}

/// Learning rate of exposures and background.
pub(crate) const RATE: f32 = 1e-3;

/// Exposure of one view: three gains, three offsets.
pub(crate) type LearnedExposure = Learned<6>;

impl Default for LearnedExposure {
    fn default() -> Self {
        Self::new([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    }
}

impl LearnedExposure {
    pub fn exposure(&self) -> Exposure {
        let [a, b, c, d, e, f] = self.values;
        Exposure { gain: [a, b, c], offset: [d, e, f] }
    }

    pub fn learn(&mut self, losses: &Losses) {
        let ([a, b, c], [d, e, f]) = (losses.by_gain, losses.by_offset);
        self.step([a, b, c, d, e, f], RATE);
    }
}
