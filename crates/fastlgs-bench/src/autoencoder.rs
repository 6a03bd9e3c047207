//! A small scene-wise autoencoder that compresses embeddings to three numbers, as in LangSplat.

use fastlgs_core::rng::Rng;
use ndarray::{Array1, Array2, ArrayView2, Axis, Zip};

/// Output widths of the encoder's layers. The last one is the length of a code.
const ENCODER: [usize; 3] = [128, 32, 3];
/// Output widths of the decoder's hidden layers.
const DECODER: [usize; 2] = [32, 128];
const EPOCHS: usize = 300;
const BATCH: usize = 64;
const LEARNING_RATE: f32 = 2e-3;

/// A linear layer with the moments of Adam.
struct Layer {
    weights: Array2<f32>,
    bias: Array1<f32>,
    moments: [Array2<f32>; 2],
    bias_moments: [Array1<f32>; 2],
    /// Whether a ReLU follows.
    relu: bool,
}

impl Layer {
    fn new(inputs: usize, outputs: usize, cut: bool, rng: &mut Rng) -> Self {
        let scale = (2.0 / inputs as f32).sqrt();
        let (weights, bias) = (
            Array2::from_shape_fn((inputs, outputs), |_| scale * rng.normal()),
            Array1::zeros(outputs),
        );
        let (zeros, bias_zeros) = (Array2::zeros((inputs, outputs)), Array1::zeros(outputs));
        Self {
            weights,
            bias,
            moments: [zeros.clone(), zeros],
            bias_moments: [bias_zeros.clone(), bias_zeros],
            relu: cut,
        }
    }

    fn forward(&self, x: ArrayView2<f32>) -> Array2<f32> {
        let out = x.dot(&self.weights) + &self.bias;
        if self.relu {
            out.mapv_into(|v| v.max(0.0))
        } else {
            out
        }
    }

    /// Takes one step of Adam and returns the gradient of the input. `out` is the output of
    /// `forward` for `x`.
    fn backward(
        &mut self,
        x: ArrayView2<f32>,
        out: ArrayView2<f32>,
        mut gradient: Array2<f32>,
        step: i32,
    ) -> Array2<f32> {
        if self.relu {
            Zip::from(&mut gradient)
                .and(out)
                .for_each(|g, o| *g *= f32::from(u8::from(*o > 0.0)));
        }
        let before = gradient.dot(&self.weights.t());
        let (of_weights, of_bias) = (x.t().dot(&gradient), gradient.sum_axis(Axis(0)));
        let rate = LEARNING_RATE * (1.0 - 0.999f32.powi(step)).sqrt() / (1.0 - 0.9f32.powi(step));
        let adam = |value: &mut f32, m: &mut f32, v: &mut f32, g: &f32| {
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *value -= rate * *m / (v.sqrt() + 1e-8);
        };
        let [m, v] = &mut self.moments;
        Zip::from(&mut self.weights)
            .and(m)
            .and(v)
            .and(&of_weights)
            .for_each(adam);
        let [m, v] = &mut self.bias_moments;
        Zip::from(&mut self.bias)
            .and(m)
            .and(v)
            .and(&of_bias)
            .for_each(adam);
        before
    }
}

/// A trained encoder and decoder.
pub struct Autoencoder {
    layers: Vec<Layer>,
}

impl Autoencoder {
    /// Trains on the rows of `embeddings`, which have length 1. The loss is the squared error.
    pub fn learn(embeddings: &Array2<f32>, seed: u64) -> Self {
        let mut rng = Rng::new(seed, "autoencoder");
        let width = embeddings.ncols();
        let widths: Vec<usize> = [&[width], &ENCODER[..], &DECODER[..], &[width]].concat();
        let last = widths.len() - 2;
        // Codes and embeddings may be negative, so these layers have no ReLU.
        let layer = |k: usize, rng: &mut Rng| {
            Layer::new(
                widths[k],
                widths[k + 1],
                k + 1 != ENCODER.len() && k != last,
                rng,
            )
        };
        let mut model = Self {
            layers: (0..=last).map(|k| layer(k, &mut rng)).collect(),
        };
        let mut order: Vec<usize> = (0..embeddings.nrows()).collect();
        let mut step = 0;
        for _ in 0..EPOCHS {
            rng.shuffle(&mut order);
            for batch in order.chunks(BATCH) {
                step += 1;
                model.step(embeddings.select(Axis(0), batch), step);
            }
        }
        model
    }

    fn step(&mut self, x: Array2<f32>, step: i32) {
        let mut outs = vec![x];
        for layer in &self.layers {
            outs.push(layer.forward(outs[outs.len() - 1].view()));
        }
        let rows = outs[0].nrows() as f32;
        let mut gradient = (&outs[outs.len() - 1] - &outs[0]) * (2.0 / rows);
        for (k, layer) in self.layers.iter_mut().enumerate().rev() {
            gradient = layer.backward(outs[k].view(), outs[k + 1].view(), gradient, step);
        }
    }

    fn through(layers: &[Layer], x: Array2<f32>) -> Array2<f32> {
        layers.iter().fold(x, |x, layer| layer.forward(x.view()))
    }

    /// Returns the codes of embeddings, three numbers per row.
    pub fn encode(&self, embeddings: Array2<f32>) -> Array2<f32> {
        Self::through(&self.layers[..ENCODER.len()], embeddings)
    }

    /// Returns the embeddings of codes, not normalised.
    pub fn decode(&self, codes: Array2<f32>) -> Array2<f32> {
        Self::through(&self.layers[ENCODER.len()..], codes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn six_directions_are_reconstructed_from_three_numbers() {
        let mut rng = Rng::new(3, "test");
        let mut kinds = Array2::from_shape_fn((6, 40), |_| rng.normal());
        kinds
            .rows_mut()
            .into_iter()
            .for_each(|mut r| r /= r.dot(&r).sqrt());
        let embeddings = kinds.select(Axis(0), &(0..90).map(|k| k % 6).collect::<Vec<_>>());
        let coder = Autoencoder::learn(&embeddings, 0);
        let back = coder.decode(coder.encode(kinds.clone()));
        for (a, b) in kinds.rows().into_iter().zip(back.rows()) {
            let cosine = a.dot(&b) / b.dot(&b).sqrt();
            assert!(cosine > 0.95, "{cosine}");
        }
    }
}
