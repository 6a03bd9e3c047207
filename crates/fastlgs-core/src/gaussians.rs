//! The Gaussian scene as structure of arrays.

use glam::{Quat, Vec3};

/// Zeroth spherical-harmonic basis function, 1 / (2 sqrt(pi)).
pub const SH_C0: f32 = 0.282_094_79;

/// 3-D Gaussians with colour, semantic feature and object id. All vectors have the same length.
///
/// Values are stored as they are optimised and as the PLY of 3DGS holds them: scales as logarithms, opacity as a
/// logit, rotation as an unnormalised quaternion (w, x, y, z), colour as the zeroth SH coefficient.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Centre in the world.
    pub means: Vec<Vec3>,
    /// Natural logarithm of the standard deviation along each axis of the Gaussian.
    pub log_scales: Vec<Vec3>,
    /// Rotation from the Gaussian's axes to the world, (w, x, y, z), not normalised.
    pub rotations: Vec<[f32; 4]>,
    /// Opacity before the sigmoid.
    pub opacity_logits: Vec<f32>,
    /// SH coefficient of degree 0; colour = 0.5 + [`SH_C0`] * dc.
    pub sh_dc: Vec<Vec3>,
    /// Low-dimensional semantic code, nominally in (0, 1)^3 (the paper's f).
    pub features: Vec<Vec3>,
    /// Object of the table that the Gaussian belongs to; 0 means none.
    pub object_ids: Vec<u16>,
}

/// Number of trained floats a Gaussian has here: mean 3, log-scale 3, rotation 4, opacity 1, colour 3, feature 3.
pub const CHANNELS: usize = 17;

impl Gaussians {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Appends an isotropic Gaussian without feature.
    pub fn push_sphere(&mut self, mean: Vec3, radius: f32, opacity: f32, color: [f32; 3]) {
        self.means.push(mean);
        self.log_scales.push(Vec3::splat(radius.ln()));
        self.rotations.push([1.0, 0.0, 0.0, 0.0]);
        self.opacity_logits.push(logit(opacity));
        self.sh_dc.push((Vec3::from(color) - 0.5) / SH_C0);
        self.features.push(Vec3::ZERO);
        self.object_ids.push(0);
    }

    /// All trained values as `[CHANNELS][n]`, the layout of the kernels.
    pub fn to_channels(&self) -> Vec<f32> {
        let n = self.len();
        let mut out = vec![0.0; CHANNELS * n];
        for i in 0..n {
            for (c, value) in self.values(i).into_iter().enumerate() {
                out[c * n + i] = value;
            }
        }
        out
    }

    fn values(&self, i: usize) -> [f32; CHANNELS] {
        let (m, s, r) = (self.means[i], self.log_scales[i], self.rotations[i]);
        let (c, f) = (self.sh_dc[i], self.features[i]);
        let o = self.opacity_logits[i];
        [m.x, m.y, m.z, s.x, s.y, s.z, r[0], r[1], r[2], r[3], o, c.x, c.y, c.z, f.x, f.y, f.z]
    }

    /// The inverse of [`Self::to_channels`]; object ids become 0 where `ids` does not give them.
    ///
    /// # Panics
    /// If `channels` is not a multiple of [`CHANNELS`] long.
    pub fn from_channels(channels: &[f32], ids: Option<&[u16]>) -> Self {
        assert_eq!(channels.len() % CHANNELS, 0, "channels of unequal length");
        let n = channels.len() / CHANNELS;
        let v = |c: usize, i: usize| channels[c * n + i];
        let vec3 = |c: usize| (0..n).map(|i| Vec3::new(v(c, i), v(c + 1, i), v(c + 2, i))).collect::<Vec<_>>();
        Self {
            means: vec3(0),
            log_scales: vec3(3),
            rotations: (0..n).map(|i| [v(6, i), v(7, i), v(8, i), v(9, i)]).collect(),
            opacity_logits: channels[10 * n..11 * n].to_vec(),
            sh_dc: vec3(11),
            features: vec3(14),
            object_ids: ids.map_or_else(|| vec![0; n], <[u16]>::to_vec),
        }
    }

    /// The Gaussians at `places`, in that order; a place may occur more than once.
    ///
    /// # Panics
    /// If a place is out of range.
    pub fn select(&self, places: &[usize]) -> Self {
        fn pick<T: Copy>(items: &[T], places: &[usize]) -> Vec<T> {
            places.iter().map(|&i| items[i]).collect()
        }
        Self {
            means: pick(&self.means, places),
            log_scales: pick(&self.log_scales, places),
            rotations: pick(&self.rotations, places),
            opacity_logits: pick(&self.opacity_logits, places),
            sh_dc: pick(&self.sh_dc, places),
            features: pick(&self.features, places),
            object_ids: pick(&self.object_ids, places),
        }
    }

    /// Rotation of Gaussian `i` as a unit quaternion.
    pub fn rotation(&self, i: usize) -> Quat {
        let [w, x, y, z] = self.rotations[i];
        Quat::from_xyzw(x, y, z, w).normalize()
    }

    /// Index of the first Gaussian with a value that is not finite.
    pub fn first_not_finite(&self) -> Option<usize> {
        (0..self.len()).find(|&i| !self.values(i).iter().all(|v| v.is_finite()))
    }
}

/// Inverse of [`sigmoid`].
pub fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}

/// 1 / (1 + e^-x).
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_round_trip() {
        let mut g = Gaussians::default();
        g.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.5, 0.25, [0.1, 0.2, 0.3]);
        g.push_sphere(Vec3::new(-1.0, 0.0, 9.0), 0.1, 0.75, [0.9, 0.8, 0.7]);
        g.object_ids = vec![3, 7];
        assert_eq!(Gaussians::from_channels(&g.to_channels(), Some(&g.object_ids)), g);
        assert!((sigmoid(g.opacity_logits[0]) - 0.25).abs() < 1e-6);
        assert_eq!(g.select(&[1]).object_ids, vec![7]);
    }
}
