//! Compact scene file: a safetensors file with quantised Gaussians.
//!
//! The groups of trained values are mean, log-scale, rotation, opacity and colour. They are stored
//! as fixed-point numbers of one, two or three bytes, between the smallest and largest value of
//! each channel. Object ids are stored as they are. Features are left out: they follow from the
//! codes of the objects.
//!
//! Tensors, for n Gaussians: `object_id` U16 (n); for each group with c channels `GROUP` U8 (c,
//! bytes, n), most significant byte first, and `GROUP.range` F32 (c, 2). Channels are those of
//! [`Gaussians::to_channels`].

use crate::gaussians::{BASE_CHANNELS, MAX_SH_DEGREE, channel, channels, rest_len};
use crate::{Error, Gaussians, Result, fs};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// Names of the groups, in the order of their channels.
const GROUPS: [&str; 6] = [
    "mean",
    "log_scale",
    "rotation",
    "opacity",
    "sh_dc",
    "sh_rest",
];
/// Largest number of bytes per value.
const MAX_BYTES: u8 = 3;

/// Returns the channels of a group.
fn group(index: usize, sh_degree: u32) -> Range<usize> {
    match index {
        0 => channel::MEAN,
        1 => channel::LOG_SCALE,
        2 => channel::ROTATION,
        3 => channel::OPACITY..channel::OPACITY + 1,
        4 => channel::COLOR,
        _ => BASE_CHANNELS..channels(sh_degree),
    }
}

/// Number of bytes per value, for each group.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Precision([u8; GROUPS.len()]);

impl Default for Precision {
    /// Three bytes for means and two for all else: precise enough for any scene.
    fn default() -> Self {
        Self([3, 2, 2, 2, 2, 2])
    }
}

impl Precision {
    /// Chooses the fewest bytes for each group that reduce `quality` (PSNR in dB) by at most
    /// `loss`. Each group is tested with all others at full precision.
    ///
    /// # Errors
    /// Errors of `quality`.
    pub fn choose<E>(
        scene: &Gaussians,
        loss: f64,
        mut quality: impl FnMut(&Gaussians) -> Result<f64, E>,
    ) -> Result<Self, E> {
        let full = quality(scene)?;
        let mut bytes = [1; GROUPS.len()];
        for (g, bytes) in bytes
            .iter_mut()
            .enumerate()
            .filter(|(g, _)| !group(*g, scene.sh_degree).is_empty())
        {
            *bytes = MAX_BYTES;
            for fewer in 1..MAX_BYTES {
                let mut values = scene.to_channels();
                let n = scene.len();
                for channel in group(g, scene.sh_degree) {
                    let plane = &mut values[channel * n..(channel + 1) * n];
                    let fixed = FixedPoint::of(plane, fewer);
                    plane
                        .iter_mut()
                        .for_each(|v| *v = fixed.value(fixed.steps(*v)));
                }
                if quality(&Gaussians::from_channels(
                    &values,
                    scene.sh_degree,
                    Some(&scene.object_ids),
                ))? >= full - loss
                {
                    *bytes = fewer;
                    break;
                }
            }
        }
        Ok(Self(bytes))
    }

    /// Returns the number of bytes per value by group name.
    pub fn by_group(&self) -> BTreeMap<&'static str, u8> {
        GROUPS.into_iter().zip(self.0).collect()
    }
}

/// Fixed-point encoding of numbers between `low` and `high`. A value is a whole number of steps: 0
/// for `low`, 2^(8 `bytes`) - 1 for `high`.
struct FixedPoint {
    low: f32,
    high: f32,
    bytes: u8,
}

impl FixedPoint {
    fn of(values: &[f32], bytes: u8) -> Self {
        let bound = |start: f32, f: fn(f32, f32) -> f32| values.iter().fold(start, |a, &b| f(a, b));
        Self {
            low: bound(f32::INFINITY, f32::min),
            high: bound(f32::NEG_INFINITY, f32::max),
            bytes,
        }
    }

    fn max_step(&self) -> f64 {
        f64::from((1u32 << (8 * self.bytes)) - 1)
    }

    fn steps(&self, value: f32) -> u32 {
        let span = f64::from(self.high) - f64::from(self.low);
        if span > 0.0 {
            ((f64::from(value) - f64::from(self.low)) / span * self.max_step()).round() as u32
        } else {
            0
        }
    }

    fn value(&self, steps: u32) -> f32 {
        let span = f64::from(self.high) - f64::from(self.low);
        (f64::from(self.low) + f64::from(steps) / self.max_step() * span) as f32
    }
}

/// Writes the scene atomically. Rotations become unit quaternions with w >= 0.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians, precision: &Precision) -> Result<()> {
    let n = scene.len();
    let mut scene = scene.clone();
    for i in 0..n {
        let q = scene.rotation(i);
        let q = if q.w < 0.0 { -q } else { q };
        scene.rotations[i] = [q.w, q.x, q.y, q.z];
    }
    let values = scene.to_channels();
    let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    for (g, name) in GROUPS.into_iter().enumerate() {
        let (range, bytes) = (group(g, scene.sh_degree), precision.0[g]);
        let (mut planes, mut bounds) = (Vec::new(), Vec::new());
        for channel in range.clone() {
            let plane = &values[channel * n..(channel + 1) * n];
            let fixed = FixedPoint::of(plane, bytes);
            bounds.extend(
                [fixed.low, fixed.high]
                    .into_iter()
                    .flat_map(f32::to_le_bytes),
            );
            for byte_index in (0..bytes).rev() {
                planes.extend(
                    plane
                        .iter()
                        .map(|v| (fixed.steps(*v) >> (8 * byte_index)) as u8),
                );
            }
        }
        tensors.push((
            name.into(),
            Dtype::U8,
            vec![range.len(), bytes.into(), n],
            planes,
        ));
        tensors.push((
            format!("{name}.range"),
            Dtype::F32,
            vec![range.len(), 2],
            bounds,
        ));
    }
    let ids = scene
        .object_ids
        .iter()
        .flat_map(|id| id.to_le_bytes())
        .collect();
    tensors.push(("object_id".into(), Dtype::U16, vec![n], ids));
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, dtype, shape, data)| Ok((name, TensorView::new(*dtype, shape.clone(), data)?)))
        .collect();
    let data = views.and_then(|v| safetensors::serialize(v, None));
    let data = data.map_err(|e: safetensors::SafeTensorError| {
        Error::format(path, format!("cannot write tensors: {e}"))
    })?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// Reads a scene. Its features are zero.
///
/// # Errors
/// [`Error::Format`] for truncated files and other content.
pub fn read(path: &Path) -> Result<Gaussians> {
    let data = fs::read(path)?;
    let bad = |what: String| Error::format(path, format!("{what}; export the scene again"));
    let file = SafeTensors::deserialize(&data)
        .map_err(|e| bad(format!("not a complete safetensors file ({e})")))?;
    let tensor = |name: &str, dtype: Dtype, rank: usize| {
        let found = file.tensor(name).ok();
        let fitting = found.filter(|t| t.dtype() == dtype && t.shape().len() == rank);
        fitting.ok_or_else(|| {
            bad(format!(
                "no tensor '{name}' of type {dtype:?} with {rank} dimensions"
            ))
        })
    };
    let ids = tensor("object_id", Dtype::U16, 1)?;
    let n = ids.shape()[0];
    let words = ids.data().as_chunks::<2>().0.iter();
    let ids: Vec<u16> = words.map(|b| u16::from_le_bytes(*b)).collect();
    let rest = tensor("sh_rest", Dtype::U8, 3)?.shape()[0];
    let sh_degree = (0..=MAX_SH_DEGREE).find(|d| 3 * rest_len(*d) == rest);
    let sh_degree =
        sh_degree.ok_or_else(|| bad(format!("{rest} SH channels do not match any SH degree")))?;
    let mut values = vec![0.0f32; channels(sh_degree) * n];
    for (g, name) in GROUPS.into_iter().enumerate() {
        let (planes, bounds) = (
            tensor(name, Dtype::U8, 3)?,
            tensor(&format!("{name}.range"), Dtype::F32, 2)?,
        );
        let range = group(g, sh_degree);
        let bytes = planes.shape()[1];
        let fits = planes.shape() == [range.len(), bytes, n] && bounds.shape() == [range.len(), 2];
        if !fits || !(1..=usize::from(MAX_BYTES)).contains(&bytes) {
            return Err(bad(format!(
                "tensor '{name}' has the unexpected shape {:?}",
                planes.shape()
            )));
        }
        for (k, channel) in range.enumerate() {
            let bound = |side: usize| {
                f32::from_le_bytes(std::array::from_fn(|b| bounds.data()[8 * k + 4 * side + b]))
            };
            let fixed = FixedPoint {
                low: bound(0),
                high: bound(1),
                bytes: bytes as u8,
            };
            let is_finite = fixed.low.is_finite() && fixed.high.is_finite();
            if n > 0 && !is_finite {
                return Err(bad(format!("the range of '{name}' is not finite")));
            }
            let planes = &planes.data()[k * bytes * n..];
            let own = &mut values[channel * n..(channel + 1) * n];
            for (i, value) in own.iter_mut().enumerate() {
                let byte = |steps: u32, b: usize| steps << 8 | u32::from(planes[b * n + i]);
                *value = fixed.value((0..bytes).fold(0, byte));
            }
        }
    }
    Ok(Gaussians::from_channels(&values, sh_degree, Some(&ids)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;
    use glam::Vec3;

    fn sample() -> Gaussians {
        let mut rng = Rng::new(1, "compact");
        let mut g = Gaussians {
            sh_degree: 2,
            ..Gaussians::default()
        };
        for i in 0..300 {
            let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
            g.push_sphere(
                mean,
                rng.range(0.01, 0.5),
                rng.range(0.1, 0.9),
                [rng.uniform(), rng.uniform(), rng.uniform()],
            );
            g.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
            g.object_ids[i] = i as u16 * 7;
        }
        g.sh_rest
            .iter_mut()
            .for_each(|v| *v = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()));
        g
    }

    #[test]
    fn round_trip_errs_by_half_a_step() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.safetensors");
        let before = sample();
        write(&path, &before, &Precision([3, 2, 2, 2, 1, 1])).unwrap();
        let after = read(&path).unwrap();
        assert_eq!(
            (after.sh_degree, &after.object_ids),
            (2, &before.object_ids)
        );
        let error = |f: fn(&Gaussians) -> &[Vec3]| {
            f(&before)
                .iter()
                .zip(f(&after))
                .map(|(a, b)| (*a - *b).abs().max_element())
                .fold(0.0, f32::max)
        };
        assert!(error(|g| &g.means) < 8.0 / (1 << 24) as f32);
        assert!(error(|g| &g.log_scales) < 4.0 / 65535.0);
        assert!((1e-4..0.5 / 255.0 + 1e-6).contains(&error(|g| &g.sh_rest)));
        assert!((0..300).all(|i| after.rotation(i).dot(before.rotation(i)).abs() > 0.999_99));
        let bytes = 300 * (3 * 3 + 2 * 3 + 2 * 4 + 2 + 3 + 24 + 2);
        assert!(
            (bytes..bytes + 2000).contains(&(std::fs::metadata(&path).unwrap().len() as usize))
        );
    }

    #[test]
    fn choose_uses_the_fewest_bytes_that_keep_the_quality() {
        let scene = sample();
        // Quality depends only on the means, to an accuracy of 0.001.
        let quality = |g: &Gaussians| {
            let worst = g
                .means
                .iter()
                .zip(&scene.means)
                .map(|(a, b)| a.distance(*b))
                .fold(0.0, f32::max);
            Ok::<_, ()>(if worst < 1e-3 { 30.0 } else { 20.0 })
        };
        assert_eq!(
            Precision::choose(&scene, 0.01, quality).unwrap(),
            Precision([2, 1, 1, 1, 1, 1])
        );
    }

    #[test]
    fn empty_scenes_and_damage() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.safetensors");
        write(&path, &Gaussians::default(), &Precision([1; 6])).unwrap();
        assert!(read(&path).unwrap().is_empty());
        write(&path, &sample(), &Precision([1; 6])).unwrap();
        let data = std::fs::read(&path).unwrap();
        std::fs::write(&path, &data[..data.len() - 9]).unwrap();
        assert!(
            read(&path)
                .unwrap_err()
                .to_string()
                .contains("scene.safetensors")
        );
        let one = 1.0f32.to_le_bytes();
        let other = safetensors::serialize(
            [("x", TensorView::new(Dtype::F32, vec![1], &one).unwrap())],
            None,
        )
        .unwrap();
        std::fs::write(&path, other).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("object_id"));
    }
}
