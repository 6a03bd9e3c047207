//! The Gaussians of a scene as a structure of arrays.

use crate::stats;
use glam::{Quat, Vec3};

/// Zeroth spherical-harmonic basis function, 1 / (2 sqrt(pi)).
pub const SH_C0: f32 = 0.282_094_79;

/// Largest opacity logit of a transparent Gaussian, which adds no colour but marks an object that
/// photos see through. Trained Gaussians stay far above it: their gradients vanish below -5.5,
/// which is an opacity of 1/255.
pub const TRANSPARENT_LOGIT: f32 = -16.0;

/// 3-D Gaussians with colour, semantic feature and object id. All vectors have one entry per
/// Gaussian, except `sh_rest`.
///
/// Values are stored as they are optimised and as the PLY of 3DGS stores them: scales as
/// logarithms, opacity as a logit, rotation as an unnormalised quaternion (w, x, y, z), colour as
/// SH coefficients.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Mean in scene coordinates.
    pub means: Vec<Vec3>,
    /// Natural logarithm of the standard deviation along each axis of the Gaussian.
    pub log_scales: Vec<Vec3>,
    /// Rotation from the Gaussian's axes to the world, (w, x, y, z), not normalised.
    pub rotations: Vec<[f32; 4]>,
    /// Opacity before the sigmoid (a logit).
    pub opacity_logits: Vec<f32>,
    /// SH coefficient of degree 0; colour = 0.5 + [`SH_C0`] * dc.
    pub sh_dc: Vec<Vec3>,
    /// Highest spherical-harmonic degree of colour, 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u32,
    /// SH coefficients of degrees 1 and up: [`rest_len`] RGB triples per Gaussian.
    pub sh_rest: Vec<Vec3>,
    /// Feature: three trained numbers, nominally in (0, 1) (the paper's f).
    pub features: Vec<Vec3>,
    /// Id of the object or overlap list that the Gaussian belongs to; 0 means none.
    pub object_ids: Vec<u16>,
}

/// Number of trained floats per Gaussian without view-dependent colour: mean 3, log-scale 3,
/// rotation 4, opacity 1, colour 3, feature 3. SH coefficients of higher degrees follow, one RGB
/// triple after the other.
pub const BASE_CHANNELS: usize = 17;

/// Channels of the trained floats of a Gaussian; `shaders/shared/channels.wgsl` has the same.
pub mod channel {
    use std::ops::Range;

    /// Mean in units of the scene.
    pub const MEAN: Range<usize> = 0..3;
    /// Natural logarithms of the scales.
    pub const LOG_SCALE: Range<usize> = 3..6;
    /// Rotation quaternion w, x, y, z.
    pub const ROTATION: Range<usize> = 6..10;
    /// Logit of the opacity.
    pub const OPACITY: usize = 10;
    /// SH coefficients of degree 0.
    pub const COLOR: Range<usize> = 11..14;
    /// Feature.
    pub const FEATURE: Range<usize> = 14..17;
}

/// Highest SH degree that kernels and file formats support.
pub const MAX_SH_DEGREE: u32 = 3;

/// Returns the number of SH coefficients of degrees 1 to `degree` per colour.
pub const fn rest_len(degree: u32) -> usize {
    ((degree + 1) * (degree + 1) - 1) as usize
}

/// Returns the number of trained floats per Gaussian at an SH degree.
pub const fn channels(degree: u32) -> usize {
    BASE_CHANNELS + 3 * rest_len(degree)
}

impl Gaussians {
    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Appends an isotropic Gaussian with zero feature and object id 0. `radius` is its standard
    /// deviation.
    pub fn push_sphere(&mut self, mean: Vec3, radius: f32, opacity: f32, color: [f32; 3]) {
        self.means.push(mean);
        self.log_scales.push(Vec3::splat(radius.ln()));
        self.rotations.push([1.0, 0.0, 0.0, 0.0]);
        self.opacity_logits.push(logit(opacity));
        self.sh_dc.push((Vec3::from(color) - 0.5) / SH_C0);
        self.sh_rest
            .extend(std::iter::repeat_n(Vec3::ZERO, rest_len(self.sh_degree)));
        self.features.push(Vec3::ZERO);
        self.object_ids.push(0);
    }

    /// Appends the Gaussians of another scene.
    ///
    /// # Panics
    /// If the SH degrees differ.
    pub fn append(&mut self, mut other: Self) {
        assert_eq!(
            self.sh_degree, other.sh_degree,
            "both scenes must have the same SH degree"
        );
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.rotations.append(&mut other.rotations);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh_dc.append(&mut other.sh_dc);
        self.sh_rest.append(&mut other.sh_rest);
        self.features.append(&mut other.features);
        self.object_ids.append(&mut other.object_ids);
    }

    /// Returns the SH coefficients of Gaussian `i` above degree 0.
    pub fn rest(&self, i: usize) -> &[Vec3] {
        let k = rest_len(self.sh_degree);
        &self.sh_rest[i * k..(i + 1) * k]
    }

    /// Changes the SH degree of colour. Higher coefficients are dropped and missing ones are zero.
    pub fn with_sh_degree(mut self, degree: u32) -> Self {
        let (from, to) = (rest_len(self.sh_degree), rest_len(degree));
        let value = |i: usize, k: usize| {
            if k < from {
                self.sh_rest[i * from + k]
            } else {
                Vec3::ZERO
            }
        };
        let rest = (0..self.len())
            .flat_map(|i| (0..to).map(move |k| (i, k)))
            .map(|(i, k)| value(i, k))
            .collect();
        self.sh_rest = rest;
        self.sh_degree = degree;
        self
    }

    /// Returns all trained values as `[channels(sh_degree)][n]`, the layout of the kernels.
    pub fn to_channels(&self) -> Vec<f32> {
        let n = self.len();
        let mut out = vec![0.0; channels(self.sh_degree) * n];
        for i in 0..n {
            let rest = self.rest(i).iter().flat_map(|v| v.to_array());
            for (c, value) in self.values(i).into_iter().chain(rest).enumerate() {
                out[c * n + i] = value;
            }
        }
        out
    }

    fn values(&self, i: usize) -> [f32; BASE_CHANNELS] {
        let (m, s, r) = (self.means[i], self.log_scales[i], self.rotations[i]);
        let (c, f) = (self.sh_dc[i], self.features[i]);
        let o = self.opacity_logits[i];
        [
            m.x, m.y, m.z, s.x, s.y, s.z, r[0], r[1], r[2], r[3], o, c.x, c.y, c.z, f.x, f.y, f.z,
        ]
    }

    /// Inverts [`Self::to_channels`]. Without `ids`, all object ids are 0.
    ///
    /// # Panics
    /// If the length of `values` is not a multiple of [`channels`].
    pub fn from_channels(values: &[f32], sh_degree: u32, ids: Option<&[u16]>) -> Self {
        assert_eq!(
            values.len() % channels(sh_degree),
            0,
            "the number of values must be a multiple of the channels"
        );
        let n = values.len() / channels(sh_degree);
        let v = |c: usize, i: usize| values[c * n + i];
        let at = |c: usize, i: usize| Vec3::new(v(c, i), v(c + 1, i), v(c + 2, i));
        let vec3 = |c: usize| (0..n).map(|i| at(c, i)).collect::<Vec<_>>();
        Self {
            means: vec3(channel::MEAN.start),
            log_scales: vec3(channel::LOG_SCALE.start),
            rotations: (0..n)
                .map(|i| std::array::from_fn(|k| v(channel::ROTATION.start + k, i)))
                .collect(),
            opacity_logits: values[channel::OPACITY * n..(channel::OPACITY + 1) * n].to_vec(),
            sh_dc: vec3(channel::COLOR.start),
            sh_degree,
            sh_rest: (0..n)
                .flat_map(|i| (0..rest_len(sh_degree)).map(move |k| at(BASE_CHANNELS + 3 * k, i)))
                .collect(),
            features: vec3(channel::FEATURE.start),
            object_ids: ids.map_or_else(|| vec![0; n], <[u16]>::to_vec),
        }
    }

    /// Returns the Gaussians at the given indices, in that order. An index may occur more than
    /// once.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn select(&self, indices: &[usize]) -> Self {
        fn pick<T: Copy>(items: &[T], places: &[usize]) -> Vec<T> {
            places.iter().map(|&i| items[i]).collect()
        }
        Self {
            means: pick(&self.means, indices),
            log_scales: pick(&self.log_scales, indices),
            rotations: pick(&self.rotations, indices),
            opacity_logits: pick(&self.opacity_logits, indices),
            sh_dc: pick(&self.sh_dc, indices),
            sh_degree: self.sh_degree,
            sh_rest: indices
                .iter()
                .flat_map(|&i| self.rest(i))
                .copied()
                .collect(),
            features: pick(&self.features, indices),
            object_ids: pick(&self.object_ids, indices),
        }
    }

    /// Returns the rotation of Gaussian `i` as a unit quaternion.
    pub fn rotation(&self, i: usize) -> Quat {
        let [w, x, y, z] = self.rotations[i];
        Quat::from_xyzw(x, y, z, w).normalize()
    }

    /// Drops Gaussians that cannot be drawn: those with NaN or infinite values, or a zero
    /// quaternion. Infinite opacity logits, from files with 8-bit opacity, are clamped instead.
    /// Returns a warning with the number of dropped Gaussians and the PLY columns of their invalid
    /// values.
    pub fn drop_invalid(&mut self) -> Option<String> {
        let infinite = |logit: &&mut f32| logit.is_infinite();
        for logit in self.opacity_logits.iter_mut().filter(infinite) {
            *logit = logit.signum() * FINITE_LOGIT;
        }
        let mut columns = std::collections::BTreeSet::new();
        let (mut kept, mut infinite, mut unrotated) = (Vec::with_capacity(self.len()), 0, 0);
        for i in 0..self.len() {
            let own = self.values(i);
            let bad = (0..BASE_CHANNELS)
                .filter(|c| !own[*c].is_finite())
                .map(|c| CHANNEL_NAMES[c]);
            let rest = self
                .rest(i)
                .iter()
                .any(|v| !v.is_finite())
                .then_some("f_rest");
            let bad: Vec<&str> = bad.chain(rest).collect();
            if !bad.is_empty() {
                infinite += 1;
                columns.extend(bad);
            } else if self.rotations[i].iter().map(|v| v * v).sum::<f32>() < f32::MIN_POSITIVE {
                unrotated += 1;
            } else {
                kept.push(i);
            }
        }
        let all = self.len();
        if kept.len() == all {
            return None;
        }
        *self = self.select(&kept);
        let names: Vec<&str> = columns.into_iter().collect();
        let infinite = (infinite > 0).then(|| {
            format!(
                "{infinite} with NaN or infinite values in {}",
                names.join(", ")
            )
        });
        let unrotated = (unrotated > 0)
            .then(|| format!("{unrotated} with a zero quaternion in rot_0 to rot_3"));
        let why: Vec<String> = infinite.into_iter().chain(unrotated).collect();
        Some(format!(
            "{} of {all} Gaussians were dropped: {}",
            all - kept.len(),
            why.join("; ")
        ))
    }

    /// Negates y and z: a half turn about x, which converts between OpenCV and OpenGL axes.
    pub fn with_y_and_z_flipped(mut self) -> Self {
        let flip = Vec3::new(1.0, -1.0, -1.0);
        self.means.iter_mut().for_each(|mean| *mean *= flip);
        self.rotations
            .iter_mut()
            .for_each(|[_, _, y, z]| (*y, *z) = (-*y, -*z));
        let width = rest_len(self.sh_degree).max(1);
        self.sh_rest
            .iter_mut()
            .enumerate()
            .for_each(|(k, value)| *value *= SH_SIGNS[k % width]);
        self
    }

    /// Removes Gaussians far outside the scene, which would waste the range of quantised formats.
    /// Returns the rest and the number of removed ones.
    pub fn without_far_outliers(&self) -> (Self, usize) {
        let middle = stats::median_position(self.means.iter().copied());
        let distances: Vec<f32> = self.means.iter().map(|m| m.distance(middle)).collect();
        let most =
            OUTLIER_GAUSSIAN_DISTANCE * stats::median(distances.iter().copied()).unwrap_or(0.0);
        let kept: Vec<usize> = (0..self.len())
            .filter(|i| most == 0.0 || distances[*i] <= most)
            .collect();
        let count = self.len() - kept.len();
        (
            if count == 0 {
                self.clone()
            } else {
                self.select(&kept)
            },
            count,
        )
    }
}

/// Factors of the SH coefficients of degrees 1 to 3, in order, when y and z are negated.
pub(crate) const SH_SIGNS: [f32; 15] = [
    -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0,
];
/// Names of the base channels in PLY files, in their order.
const CHANNEL_NAMES: [&str; BASE_CHANNELS] = [
    "x",
    "y",
    "z",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
    "opacity",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "feature_0",
    "feature_1",
    "feature_2",
];

/// Size of the logit that replaces an infinite one: an opacity of 0.999 or 0.001.
const FINITE_LOGIT: f32 = 7.0;
/// Distance from the median mean beyond which a Gaussian is an outlier, in multiples of the median
/// distance.
const OUTLIER_GAUSSIAN_DISTANCE: f32 = 1000.0;

/// Returns ln(p / (1 - p)), the inverse of [`sigmoid`].
pub fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}

/// Returns 1 / (1 + e^-x).
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_outliers_are_removed_and_a_sky_is_kept() {
        let mut scene = Gaussians::default();
        (0..50).for_each(|k| {
            scene.push_sphere(
                Vec3::new((k as f32).sin(), (k as f32).cos(), 0.1 * k as f32),
                0.1,
                0.5,
                [0.5; 3],
            )
        });
        assert_eq!(scene.without_far_outliers(), (scene.clone(), 0));
        // A sky at about a hundred times the usual distance is kept.
        scene.push_sphere(Vec3::new(0.0, 200.0, 0.0), 5.0, 0.5, [0.5; 3]);
        let with_sky = scene.clone();
        scene.push_sphere(Vec3::splat(1e6), 0.1, 0.5, [0.5; 3]);
        assert_eq!(scene.without_far_outliers(), (with_sky, 1));
    }

    #[test]
    fn flipping_twice_restores_the_scene() {
        let mut scene = Gaussians {
            sh_degree: 2,
            ..Gaussians::default()
        };
        scene.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.1, 0.5, [0.5; 3]);
        scene.rotations[0] = [0.5, 0.1, 0.2, 0.3];
        scene
            .sh_rest
            .iter_mut()
            .enumerate()
            .for_each(|(k, v)| *v = Vec3::splat(k as f32));
        let flipped = scene.clone().with_y_and_z_flipped();
        assert_eq!(
            (flipped.means[0], flipped.rotations[0]),
            (Vec3::new(1.0, -2.0, -3.0), [0.5, 0.1, -0.2, -0.3])
        );
        assert_eq!(flipped.with_y_and_z_flipped(), scene);
    }

    #[test]
    fn channels_round_trip() {
        let mut g = Gaussians::default();
        g.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.5, 0.25, [0.1, 0.2, 0.3]);
        g.push_sphere(Vec3::new(-1.0, 0.0, 9.0), 0.1, 0.75, [0.9, 0.8, 0.7]);
        g.object_ids = vec![3, 7];
        assert_eq!(
            Gaussians::from_channels(&g.to_channels(), 0, Some(&g.object_ids)),
            g
        );
        let mut round = g.clone().with_sh_degree(2);
        round
            .sh_rest
            .iter_mut()
            .enumerate()
            .for_each(|(k, v)| *v = Vec3::splat(k as f32));
        assert_eq!(
            Gaussians::from_channels(&round.to_channels(), 2, Some(&g.object_ids)),
            round
        );
        assert_eq!(round.select(&[1]).rest(0)[0], Vec3::splat(8.0));
        assert_eq!(round.with_sh_degree(1).with_sh_degree(0), g);
        assert!((sigmoid(g.opacity_logits[0]) - 0.25).abs() < 1e-6);
        assert_eq!(g.select(&[1]).object_ids, vec![7]);
        let mut halves = g.clone().with_sh_degree(2).select(&[0]);
        halves.append(g.clone().with_sh_degree(2).select(&[1]));
        assert_eq!(halves.with_sh_degree(0), g);
    }
}
