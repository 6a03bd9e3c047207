//! SPZ, the compressed Gaussian format of Niantic (version 2 of its specification, github.com/nianticlabs/spz): gzip of a
//! 16-byte header and then, for all Gaussians, positions (24-bit fixed point), opacities, colours, log-scales, rotations and
//! SH coefficients (8 bits each). Features and object ids have no place in it.
//!
//! The format's axes are right, up, back; PLY files of 3DGS are taken to be right, down, front, so y and z change sign.

use crate::gaussians::{MAX_SH_DEGREE, logit, rest_len, sigmoid};
use crate::{Error, Gaussians, Result, fs};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use glam::Vec3;
use std::io::{Read, Write};
use std::path::Path;

const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 2;
const HEADER: usize = 16;
/// Colour coefficients are stored around one half with this scale.
const COLOR_SCALE: f32 = 0.15;
/// Largest coordinate in units of the fixed point.
const POSITION_RANGE: f32 = 8_388_607.0;

/// Signs of the SH coefficients above degree 0 when y and z change theirs.
const SH_SIGNS: [f32; 15] = [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// SH coefficients are rounded to these steps: more finely in degree 1, as the specification's encoder does.
fn sh_byte(value: f32, coefficient: usize) -> u8 {
    let step = if coefficient < 3 { 8 } else { 16 };
    let steps = (value * 128.0 + 128.0).round() as i32;
    ((steps + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}

/// Writes the scene atomically. What the format cannot hold (features, object ids) is left out.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians) -> Result<()> {
    let extent = scene.means.iter().map(|m| m.abs().max_element()).fold(1e-6f32, f32::max);
    // As many bits behind the point as the largest coordinate leaves.
    let fraction = (POSITION_RANGE / extent).log2().floor().clamp(0.0, 23.0) as u8;
    let unit = f32::from(fraction).exp2();
    let flip = Vec3::new(1.0, -1.0, -1.0);
    let mut data = Vec::new();
    data.extend(MAGIC.to_le_bytes());
    data.extend(VERSION.to_le_bytes());
    data.extend((scene.len() as u32).to_le_bytes());
    data.extend([scene.sh_degree as u8, fraction, u8::from(false), 0]);
    for mean in &scene.means {
        for value in (*mean * flip).to_array() {
            data.extend(&((value * unit).round() as i32).to_le_bytes()[..3]);
        }
    }
    data.extend(scene.opacity_logits.iter().map(|o| byte(sigmoid(*o) * 255.0)));
    data.extend(scene.sh_dc.iter().flat_map(|c| c.to_array()).map(|c| byte(c * COLOR_SCALE * 255.0 + 127.5)));
    data.extend(scene.log_scales.iter().flat_map(|s| s.to_array()).map(|s| byte((s + 10.0) * 16.0)));
    for i in 0..scene.len() {
        let q = scene.rotation(i);
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        data.extend((Vec3::new(q.x, q.y, q.z) * flip * sign).to_array().map(|v| byte(v * 127.5 + 127.5)));
    }
    for i in 0..scene.len() {
        for (k, v) in scene.rest(i).iter().enumerate() {
            data.extend((*v * SH_SIGNS[k]).to_array().map(|v| sh_byte(v, k)));
        }
    }
    fs::write_atomic(path, |file| {
        let mut encoder = GzEncoder::new(file, Compression::best());
        encoder.write_all(&data)?;
        encoder.finish().map(drop)
    })
}

/// Reads a scene; features are zero and object ids 0.
///
/// # Errors
/// [`Error::Format`] for files that are no SPZ, are cut off, or of another version.
pub fn read(path: &Path) -> Result<Gaussians> {
    let bad = |reason: String| Error::format(path, reason);
    let mut data = Vec::new();
    let packed = fs::read(path)?;
    GzDecoder::new(packed.as_slice()).read_to_end(&mut data).map_err(|e| bad(format!("not a whole SPZ file ({e}); copy it again")))?;
    let word = |at: usize| data.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    if word(0) != Some(MAGIC) || data.len() < HEADER {
        return Err(bad("not an SPZ file".into()));
    }
    if word(4) != Some(VERSION) {
        return Err(bad(format!("SPZ version {}; only version {VERSION} can be read", word(4).unwrap_or(0))));
    }
    let (n, sh_degree, fraction) = (word(8).unwrap_or(0) as usize, u32::from(data[12]), data[13]);
    if sh_degree > MAX_SH_DEGREE {
        return Err(bad(format!("SH degree {sh_degree}; at most {MAX_SH_DEGREE} is known")));
    }
    let rest = rest_len(sh_degree);
    let expected = HEADER + n * (9 + 1 + 3 + 3 + 3 + 3 * rest);
    if data.len() < expected {
        return Err(bad(format!("truncated: {n} Gaussians need {expected} bytes, it holds {}; copy it again", data.len())));
    }
    let mut at = HEADER;
    let mut take = |bytes: usize| {
        at += bytes;
        &data[at - bytes..at]
    };
    let unit = f32::from(fraction).exp2();
    let flip = Vec3::new(1.0, -1.0, -1.0);
    let fixed = |b: &[u8]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / unit;
    let vec3 = |b: &[u8], f: fn(f32) -> f32| Vec3::new(f(b[0].into()), f(b[1].into()), f(b[2].into()));
    let means = take(9 * n).chunks_exact(9).map(|b| Vec3::new(fixed(b), fixed(&b[3..]), fixed(&b[6..])) * flip).collect();
    // Opacities of exactly 0 and 1 have no finite logit.
    let opacity_logits = take(n).iter().map(|b| logit((f32::from(*b) / 255.0).clamp(0.001, 0.999))).collect();
    let sh_dc = take(3 * n).chunks_exact(3).map(|b| vec3(b, |v| (v - 127.5) / (COLOR_SCALE * 255.0))).collect();
    let log_scales = take(3 * n).chunks_exact(3).map(|b| vec3(b, |v| v / 16.0 - 10.0)).collect();
    let rotations = take(3 * n).chunks_exact(3).map(|b| {
        let v = vec3(b, |v| v / 127.5 - 1.0) * flip;
        [(1.0 - v.length_squared()).max(0.0).sqrt(), v.x, v.y, v.z]
    });
    let rotations = rotations.collect();
    let sh_rest =
        take(3 * n * rest).chunks_exact(3).enumerate().map(|(k, b)| vec3(b, |v| (v - 128.0) / 128.0) * SH_SIGNS[k % rest]).collect();
    Ok(Gaussians {
        means,
        log_scales,
        rotations,
        opacity_logits,
        sh_dc,
        sh_degree,
        sh_rest,
        features: vec![Vec3::ZERO; n],
        object_ids: vec![0; n],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    fn sample() -> Gaussians {
        let mut rng = Rng::new(1, "spz");
        let mut g = Gaussians { sh_degree: 3, ..Gaussians::default() };
        for i in 0..50 {
            let mean = 3.0 * Vec3::new(rng.normal(), rng.normal(), rng.normal());
            g.push_sphere(mean, rng.range(0.001, 0.5), rng.range(0.1, 0.9), [rng.uniform(), rng.uniform(), rng.uniform()]);
            g.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
        }
        g.sh_rest.iter_mut().for_each(|v| *v = 0.3 * Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()));
        g
    }

    #[test]
    fn round_trip_is_as_close_as_the_format_allows() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.spz");
        let (before, n) = (sample(), 50);
        write(&path, &before).unwrap();
        let after = read(&path).unwrap();
        assert_eq!((after.len(), after.sh_degree), (n, 3));
        for i in 0..n {
            assert!((after.means[i] - before.means[i]).length() < 1e-5);
            assert!((after.log_scales[i] - before.log_scales[i]).abs().max_element() <= 0.04);
            assert!((sigmoid(after.opacity_logits[i]) - sigmoid(before.opacity_logits[i])).abs() < 0.003);
            assert!((after.sh_dc[i] - before.sh_dc[i]).abs().max_element() < 0.02);
            assert!(after.rotation(i).dot(before.rotation(i)).abs() > 0.99);
            for (a, b) in after.rest(i).iter().zip(before.rest(i)) {
                assert!((*a - *b).abs().max_element() <= 0.07);
            }
        }
        // Writing what was read changes nothing: the format is a fixed point of itself.
        let again = dir.path().join("again.spz");
        write(&again, &after).unwrap();
        let again = read(&again).unwrap();
        assert_eq!((again.means, again.sh_rest, again.sh_dc), (after.means, after.sh_rest, after.sh_dc));
    }

    #[test]
    fn damage_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.spz");
        write(&path, &sample()).unwrap();
        let data = std::fs::read(&path).unwrap();
        std::fs::write(&path, &data[..data.len() / 2]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("scene.spz"));
        std::fs::write(&path, b"ply\n").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("SPZ"));
    }

    /// A Gaussian written by hand after the specification.
    #[test]
    fn bytes_are_those_of_the_specification() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("one.spz");
        let mut raw = Vec::new();
        raw.extend(b"NGSP");
        raw.extend([2, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 0]);
        raw.extend([0x00, 0x10, 0x00, 0x00, 0xf0, 0xff, 0x00, 0x08, 0x00]); // 1, -1, 0.5 in 12 fractional bits
        raw.extend([128, 255, 128, 0, 160, 144, 128, 255, 128, 128]);
        let mut encoder = GzEncoder::new(std::fs::File::create(&path).unwrap(), Compression::fast());
        encoder.write_all(&raw).unwrap();
        encoder.finish().unwrap();
        let g = read(&path).unwrap();
        assert_eq!(g.means[0], Vec3::new(1.0, 1.0, -0.5));
        assert_eq!(g.log_scales[0], Vec3::new(0.0, -1.0, -2.0));
        assert!((sigmoid(g.opacity_logits[0]) - 128.0 / 255.0).abs() < 1e-6);
        assert!(g.rotation(0).x > 0.999, "half a turn around x");
    }
}
