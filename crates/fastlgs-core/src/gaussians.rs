//! The Gaussian scene as structure of arrays.

use glam::{Quat, Vec3};

/// Zeroth spherical-harmonic basis function, 1 / (2 sqrt(pi)).
pub const SH_C0: f32 = 0.282_094_79;

/// A Gaussian is clear from this logit of opacity down: it shows nothing, but stands for a thing that photos see through. What training fades out stays
/// well above, since pictures feel nothing of it from -5.5 on.
pub const CLEAR: f32 = -16.0;

/// 3-D Gaussians with colour, semantic feature and object id. All vectors have the same length.
///
/// Values are stored as they are optimised and as the PLY of 3DGS holds them: scales as logarithms, opacity as a
/// logit, rotation as an unnormalised quaternion (w, x, y, z), colour as SH coefficients.
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
    /// Highest spherical-harmonic degree of colour, 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u32,
    /// SH coefficients of degrees 1 and up, [`rest_len`] red-green-blue triples a Gaussian.
    pub sh_rest: Vec<Vec3>,
    /// Low-dimensional semantic code, nominally in (0, 1)^3 (the paper's f).
    pub features: Vec<Vec3>,
    /// Object of the table that the Gaussian belongs to; 0 means none.
    pub object_ids: Vec<u16>,
}

/// Trained floats of a Gaussian without view-dependent colour: mean 3, log-scale 3, rotation 4, opacity 1, colour 3,
/// feature 3. The SH coefficients of higher degrees follow, coefficient by coefficient.
pub const BASE_CHANNELS: usize = 17;

/// Highest degree that kernels and files know.
pub const MAX_SH_DEGREE: u32 = 3;

/// SH coefficients of degrees 1 to `degree` for each colour.
pub const fn rest_len(degree: u32) -> usize {
    ((degree + 1) * (degree + 1) - 1) as usize
}

/// Number of trained floats a Gaussian has at an SH degree.
pub const fn channels(degree: u32) -> usize {
    BASE_CHANNELS + 3 * rest_len(degree)
}

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
        self.sh_rest.extend(std::iter::repeat_n(Vec3::ZERO, rest_len(self.sh_degree)));
        self.features.push(Vec3::ZERO);
        self.object_ids.push(0);
    }

    /// Appends another scene.
    ///
    /// # Panics
    /// If its SH degree is another.
    pub fn append(&mut self, mut other: Self) {
        assert_eq!(self.sh_degree, other.sh_degree, "scenes of one SH degree");
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.rotations.append(&mut other.rotations);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh_dc.append(&mut other.sh_dc);
        self.sh_rest.append(&mut other.sh_rest);
        self.features.append(&mut other.features);
        self.object_ids.append(&mut other.object_ids);
    }

    /// The SH coefficients of Gaussian `i` above degree 0.
    pub fn rest(&self, i: usize) -> &[Vec3] {
        let k = rest_len(self.sh_degree);
        &self.sh_rest[i * k..(i + 1) * k]
    }

    /// The same scene with view-dependent colour up to `degree`: what is above is dropped, what is missing is zero.
    pub fn with_sh_degree(mut self, degree: u32) -> Self {
        let (from, to) = (rest_len(self.sh_degree), rest_len(degree));
        let value = |i: usize, k: usize| if k < from { self.sh_rest[i * from + k] } else { Vec3::ZERO };
        let rest = (0..self.len()).flat_map(|i| (0..to).map(move |k| (i, k))).map(|(i, k)| value(i, k)).collect();
        self.sh_rest = rest;
        self.sh_degree = degree;
        self
    }

    /// All trained values as `[channels(sh_degree)][n]`, the layout of the kernels.
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
        [m.x, m.y, m.z, s.x, s.y, s.z, r[0], r[1], r[2], r[3], o, c.x, c.y, c.z, f.x, f.y, f.z]
    }

    /// The inverse of [`Self::to_channels`]; object ids become 0 where `ids` does not give them.
    ///
    /// # Panics
    /// If `values` is not a multiple of [`channels`] long.
    pub fn from_channels(values: &[f32], sh_degree: u32, ids: Option<&[u16]>) -> Self {
        assert_eq!(values.len() % channels(sh_degree), 0, "channels of unequal length");
        let n = values.len() / channels(sh_degree);
        let v = |c: usize, i: usize| values[c * n + i];
        let at = |c: usize, i: usize| Vec3::new(v(c, i), v(c + 1, i), v(c + 2, i));
        let vec3 = |c: usize| (0..n).map(|i| at(c, i)).collect::<Vec<_>>();
        Self {
            means: vec3(0),
            log_scales: vec3(3),
            rotations: (0..n).map(|i| [v(6, i), v(7, i), v(8, i), v(9, i)]).collect(),
            opacity_logits: values[10 * n..11 * n].to_vec(),
            sh_dc: vec3(11),
            sh_degree,
            sh_rest: (0..n).flat_map(|i| (0..rest_len(sh_degree)).map(move |k| at(BASE_CHANNELS + 3 * k, i))).collect(),
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
            sh_degree: self.sh_degree,
            sh_rest: places.iter().flat_map(|&i| self.rest(i)).copied().collect(),
            features: pick(&self.features, places),
            object_ids: pick(&self.object_ids, places),
        }
    }

    /// Rotation of Gaussian `i` as a unit quaternion.
    pub fn rotation(&self, i: usize) -> Quat {
        let [w, x, y, z] = self.rotations[i];
        Quat::from_xyzw(x, y, z, w).normalize()
    }

    /// Drops Gaussians that cannot be drawn: with NaN or infinite values, or a rotation of zeros. Infinite opacities, as files with eight bits have
    /// them, become the nearest that is drawn. Says in one sentence how many were dropped, and for which columns of a PLY file.
    pub fn drop_invalid(&mut self) -> Option<String> {
        for logit in self.opacity_logits.iter_mut().filter(|logit| logit.is_infinite()) {
            *logit = logit.signum() * SOLID;
        }
        const NAMES: [&str; BASE_CHANNELS] = [
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
        let mut columns = std::collections::BTreeSet::new();
        let (mut kept, mut infinite, mut unrotated) = (Vec::with_capacity(self.len()), 0, 0);
        for i in 0..self.len() {
            let own = self.values(i);
            let bad = (0..BASE_CHANNELS).filter(|c| !own[*c].is_finite()).map(|c| NAMES[c]);
            let rest = self.rest(i).iter().any(|v| !v.is_finite()).then_some("f_rest");
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
        let infinite = (infinite > 0).then(|| format!("{infinite} with NaN or infinite values in {}", names.join(", ")));
        let unrotated = (unrotated > 0).then(|| format!("{unrotated} with a rotation of zeros in rot_0 to rot_3"));
        let why: Vec<String> = infinite.into_iter().chain(unrotated).collect();
        Some(format!("{} of {all} Gaussians were dropped: {}", all - kept.len(), why.join("; ")))
    }

    /// The scene with y and z of the other sign: half a turn about x, from the axes of one program to those of another.
    pub fn with_y_and_z_flipped(mut self) -> Self {
        let flip = Vec3::new(1.0, -1.0, -1.0);
        self.means.iter_mut().for_each(|mean| *mean *= flip);
        self.rotations.iter_mut().for_each(|[_, _, y, z]| (*y, *z) = (-*y, -*z));
        let width = rest_len(self.sh_degree).max(1);
        self.sh_rest.iter_mut().enumerate().for_each(|(k, value)| *value *= SH_SIGNS[k % width]);
        self
    }

    /// The scene without Gaussians that lie so far outside that formats of few bits would spend their range on them; and how many these were.
    pub fn without_far_outliers(&self) -> (Self, usize) {
        let median = |mut values: Vec<f32>| {
            values.sort_by(f32::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        let middle = Vec3::from_array([0, 1, 2].map(|k| median(self.means.iter().map(|m| m[k]).collect())));
        let distances: Vec<f32> = self.means.iter().map(|m| m.distance(middle)).collect();
        let most = FAR_OUTSIDE * median(distances.clone());
        let kept: Vec<usize> = (0..self.len()).filter(|i| most == 0.0 || distances[*i] <= most).collect();
        let count = self.len() - kept.len();
        (if count == 0 { self.clone() } else { self.select(&kept) }, count)
    }
}

/// Signs of the SH coefficients above degree 0 when y and z change theirs.
pub(crate) const SH_SIGNS: [f32; 15] = [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];
/// Logit of the opacity that stands for one of exactly 1; its negative for 0.
const SOLID: f32 = 7.0;
/// Distance from the middle of a scene, in medians of all, beyond which a Gaussian shows nothing of it.
const FAR_OUTSIDE: f32 = 1000.0;

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
    fn one_gaussian_far_outside_does_not_set_the_range() {
        let mut scene = Gaussians::default();
        (0..50).for_each(|k| scene.push_sphere(Vec3::new((k as f32).sin(), (k as f32).cos(), 0.1 * k as f32), 0.1, 0.5, [0.5; 3]));
        assert_eq!(scene.without_far_outliers(), (scene.clone(), 0));
        // A sky a hundred times as far as the rest stays.
        scene.push_sphere(Vec3::new(0.0, 200.0, 0.0), 5.0, 0.5, [0.5; 3]);
        let with_sky = scene.clone();
        scene.push_sphere(Vec3::splat(1e6), 0.1, 0.5, [0.5; 3]);
        assert_eq!(scene.without_far_outliers(), (with_sky, 1));
    }

    #[test]
    fn two_flips_are_none() {
        let mut scene = Gaussians { sh_degree: 2, ..Gaussians::default() };
        scene.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.1, 0.5, [0.5; 3]);
        scene.rotations[0] = [0.5, 0.1, 0.2, 0.3];
        scene.sh_rest.iter_mut().enumerate().for_each(|(k, v)| *v = Vec3::splat(k as f32));
        let flipped = scene.clone().with_y_and_z_flipped();
        assert_eq!((flipped.means[0], flipped.rotations[0]), (Vec3::new(1.0, -2.0, -3.0), [0.5, 0.1, -0.2, -0.3]));
        assert_eq!(flipped.with_y_and_z_flipped(), scene);
    }

    #[test]
    fn channels_round_trip() {
        let mut g = Gaussians::default();
        g.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.5, 0.25, [0.1, 0.2, 0.3]);
        g.push_sphere(Vec3::new(-1.0, 0.0, 9.0), 0.1, 0.75, [0.9, 0.8, 0.7]);
        g.object_ids = vec![3, 7];
        assert_eq!(Gaussians::from_channels(&g.to_channels(), 0, Some(&g.object_ids)), g);
        let mut round = g.clone().with_sh_degree(2);
        round.sh_rest.iter_mut().enumerate().for_each(|(k, v)| *v = Vec3::splat(k as f32));
        assert_eq!(Gaussians::from_channels(&round.to_channels(), 2, Some(&g.object_ids)), round);
        assert_eq!(round.select(&[1]).rest(0)[0], Vec3::splat(8.0));
        assert_eq!(round.with_sh_degree(1).with_sh_degree(0), g);
        assert!((sigmoid(g.opacity_logits[0]) - 0.25).abs() < 1e-6);
        assert_eq!(g.select(&[1]).object_ids, vec![7]);
        let mut halves = g.clone().with_sh_degree(2).select(&[0]);
        halves.append(g.clone().with_sh_degree(2).select(&[1]));
        assert_eq!(halves.with_sh_degree(0), g);
    }
}
