//! Reads and writes SPZ, the compressed Gaussian format of Niantic (github.com/nianticlabs/spz).
//! Writes version 2 and reads versions 2 to 4.
//!
//! Version 2 is a gzip stream of a 16-byte header and six attributes. Positions are 24-bit
//! fixed-point numbers. Opacities, colours, log-scales, rotations and SH coefficients follow with 8
//! bits per value. Version 3 has rotations of four bytes. Version 4 compresses each attribute
//! separately with Zstandard. The format has no features or object ids.
//!
//! The format's axes are right, up, back. PLY files of 3DGS are treated as right, down, front, so y
//! and z change sign.

use crate::gaussians::{MAX_SH_DEGREE, SH_SIGNS, logit, rest_len, sigmoid};
use crate::{Error, Gaussians, Result, fs};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use glam::Vec3;
use std::io::{Read, Write};
use std::path::Path;

const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 2;
/// Versions that can be read.
const VERSIONS: std::ops::RangeInclusive<u32> = 2..=4;
const HEADER: usize = 16;
/// Scale of colour coefficients, which are stored as 0.5 + 0.15 * value.
const COLOR_SCALE: f32 = 0.15;
/// Largest coordinate in fixed-point units (2^23 - 1).
const POSITION_RANGE: f32 = 8_388_607.0;

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Quantises an SH coefficient to 5 bits in degree 1 and 4 bits above, like the encoder of the
/// specification.
fn sh_byte(value: f32, coefficient: usize) -> u8 {
    let step = if coefficient < 3 { 8 } else { 16 };
    let steps = (value * 128.0 + 128.0).round() as i32;
    ((steps + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}

/// Writes the scene atomically, without features and object ids.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians) -> Result<()> {
    let extent = scene
        .means
        .iter()
        .map(|m| m.abs().max_element())
        .fold(1e-6f32, f32::max);
    // Uses as many fractional bits as the largest coordinate allows.
    let fraction = (POSITION_RANGE / extent).log2().floor().clamp(0.0, 23.0) as u8;
    let unit = f32::from(fraction).exp2();
    let flip = Vec3::new(1.0, -1.0, -1.0);
    let mut data = Vec::new();
    data.extend(MAGIC.to_le_bytes());
    data.extend(VERSION.to_le_bytes());
    data.extend((scene.len() as u32).to_le_bytes());
    // SH degree, number of fractional bits, flags (bit 0: antialiased), reserved.
    data.extend([scene.sh_degree as u8, fraction, u8::from(false), 0]);
    for mean in &scene.means {
        for value in (*mean * flip).to_array() {
            data.extend(&((value * unit).round() as i32).to_le_bytes()[..3]);
        }
    }
    let opacities = scene.opacity_logits.iter();
    data.extend(opacities.map(|o| byte(sigmoid(*o) * 255.0)));
    let colors = scene.sh_dc.iter().flat_map(|c| c.to_array());
    data.extend(colors.map(|c| byte(c * COLOR_SCALE * 255.0 + 127.5)));
    let scales = scene.log_scales.iter().flat_map(|s| s.to_array());
    data.extend(scales.map(|s| byte((s + 10.0) * 16.0)));
    for i in 0..scene.len() {
        let q = scene.rotation(i);
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        data.extend(
            (Vec3::new(q.x, q.y, q.z) * flip * sign)
                .to_array()
                .map(|v| byte(v * 127.5 + 127.5)),
        );
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

/// The decompressed attributes of a file.
struct Packed {
    version: u32,
    count: usize,
    sh_degree: u32,
    fractional_bits: u8,
    /// Positions, opacities, colours, log-scales, rotations, SH coefficients.
    streams: [Vec<u8>; 6],
}

/// Length of the version 4 header in bytes: the common header, the offset of the stream table, and
/// reserved bytes.
const HEADER_4: usize = 32;
/// Length of a table entry in bytes: compressed and decompressed length of a stream.
const ENTRY: usize = 16;

/// Returns the length of each attribute in bytes.
fn lengths(version: u32, n: usize, sh_degree: u32) -> [usize; 6] {
    let rotation = if version == 2 { 3 } else { 4 };
    [
        9 * n,
        n,
        3 * n,
        3 * n,
        rotation * n,
        3 * rest_len(sh_degree) * n,
    ]
}

/// Checks the header that all versions begin with. Returns version, count, SH degree and fractional
/// bits.
fn checked_header(path: &Path, data: &[u8]) -> Result<(u32, usize, u32, u8)> {
    let bad = |reason: String| Err(Error::format(path, reason));
    let word = |at: usize| {
        data.get(at..at + 4)
            .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    };
    if word(0) != Some(MAGIC) || data.len() < HEADER {
        return bad("not an SPZ file".into());
    }
    let (version, count) = (word(4).unwrap_or(0), word(8).unwrap_or(0));
    if !VERSIONS.contains(&version) {
        let (first, last) = (VERSIONS.start(), VERSIONS.end());
        return bad(format!(
            "SPZ version {version} is not supported; export it as version {first} to {last}"
        ));
    }
    let sh_degree = u32::from(data[12]);
    if sh_degree > MAX_SH_DEGREE {
        return bad(format!(
            "SH degree {sh_degree} is not supported; export it with degree {MAX_SH_DEGREE} or less"
        ));
    }
    Ok((version, count as usize, sh_degree, data[13]))
}

/// Decompresses versions 2 and 3: one gzip stream of header and attributes.
fn unpack_gzip(path: &Path, packed: &[u8]) -> Result<Packed> {
    let bad = |reason: String| Error::format(path, reason);
    let mut data = Vec::new();
    GzDecoder::new(packed)
        .read_to_end(&mut data)
        .map_err(|e| bad(format!("not a complete SPZ file ({e}); copy it again")))?;
    let (version, count, sh_degree, fraction) = checked_header(path, &data)?;
    let lengths = lengths(version, count, sh_degree);
    let expected = HEADER + lengths.iter().sum::<usize>();
    if data.len() < expected {
        return Err(bad(format!(
            "truncated: {count} Gaussians need {expected} bytes, but it has {}; copy it again",
            data.len()
        )));
    }
    let mut at = HEADER;
    let streams = lengths.map(|length| {
        at += length;
        data[at - length..at].to_vec()
    });
    Ok(Packed {
        version,
        count,
        sh_degree,
        fractional_bits: fraction,
        streams,
    })
}

/// Decompresses version 4: a plain header, a table, and a Zstandard stream for each attribute.
fn unpack_zstd(path: &Path, data: &[u8]) -> Result<Packed> {
    let bad = |reason: String| Error::format(path, reason);
    let (version, count, sh_degree, fraction) = checked_header(path, data)?;
    let lengths = lengths(version, count, sh_degree);
    let cut_off = || bad("truncated: its table or a stream ends early; copy it again".to_owned());
    let number = |at: usize, bytes: usize| -> Result<usize> {
        let raw = data.get(at..at.saturating_add(bytes)).ok_or_else(cut_off)?;
        let value = raw
            .iter()
            .rev()
            .fold(0u64, |value, byte| value << 8 | u64::from(*byte));
        usize::try_from(value).map_err(|_| cut_off())
    };
    let (used, table) = (usize::from(data[15]), number(16, 4)?);
    if used != lengths.iter().filter(|length| **length > 0).count() && count > 0 || table < HEADER_4
    {
        return Err(bad(format!(
            "its table of {used} streams does not match SH degree {sh_degree}; export it again"
        )));
    }
    let mut streams: [Vec<u8>; 6] = Default::default();
    let mut at = table + used * ENTRY;
    for (k, (stream, length)) in streams.iter_mut().zip(lengths).take(used).enumerate() {
        let (packed, unpacked) = (
            number(table + k * ENTRY, 8)?,
            number(table + k * ENTRY + 8, 8)?,
        );
        if unpacked != length {
            return Err(bad(format!(
                "stream {k} has {unpacked} bytes, but {count} Gaussians need {length}; export it again"
            )));
        }
        let from = data
            .get(at..at.saturating_add(packed))
            .ok_or_else(cut_off)?;
        let decoder = ruzstd::decoding::StreamingDecoder::new(from)
            .map_err(|e| bad(format!("stream {k} is damaged ({e}); copy it again")))?;
        // Decompresses at most one byte more than announced.
        decoder
            .take(length as u64 + 1)
            .read_to_end(stream)
            .map_err(|e| bad(format!("stream {k} is damaged ({e}); copy it again")))?;
        if stream.len() != length {
            return Err(bad(format!(
                "stream {k} is damaged: it has {} bytes, not {length}; copy it again",
                stream.len()
            )));
        }
        at += packed;
    }
    Ok(Packed {
        version,
        count,
        sh_degree,
        fractional_bits: fraction,
        streams,
    })
}

/// Decodes a quaternion of versions 3 and 4 to (w, x, y, z). The top two bits are the index of the
/// largest of (x, y, z, w). Each other component has ten bits: nine of magnitude, then a sign bit.
/// The last component has the lowest bits.
fn smallest_three(b: &[u8]) -> [f32; 4] {
    const SIZE: u32 = (1 << 9) - 1;
    let mut bits = u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let largest = (bits >> 30) as usize;
    let mut q = [0.0f32; 4];
    for k in (0..4).rev().filter(|k| *k != largest) {
        let size = (bits & SIZE) as f32 / SIZE as f32 * std::f32::consts::FRAC_1_SQRT_2;
        q[k] = if bits >> 9 & 1 == 1 { -size } else { size };
        bits >>= 10;
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    [q[3], q[0], q[1], q[2]]
}

/// Reads a scene of version 2, 3 or 4. Features are zero and object ids 0.
///
/// # Errors
/// [`Error::Format`] for other content, truncated files and other versions.
pub fn read(path: &Path) -> Result<Gaussians> {
    let data = fs::read(path)?;
    let packed = if data.starts_with(&MAGIC.to_le_bytes()) {
        unpack_zstd(path, &data)?
    } else {
        unpack_gzip(path, &data)?
    };
    let (n, sh_degree) = (packed.count, packed.sh_degree);
    let [positions, opacities, colors, scales, rotation_bytes, rest] = &packed.streams;
    let width = rest_len(sh_degree);
    let unit = f32::from(packed.fractional_bits).exp2();
    let flip = Vec3::new(1.0, -1.0, -1.0);
    let fixed = |b: &[u8]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / unit;
    let vec3 =
        |b: &[u8], f: fn(f32) -> f32| Vec3::new(f(b[0].into()), f(b[1].into()), f(b[2].into()));
    let rotations = if packed.version == 2 {
        let first_three = |b: &[u8]| {
            let v = vec3(b, |v| v / 127.5 - 1.0);
            [(1.0 - v.length_squared()).max(0.0).sqrt(), v.x, v.y, v.z]
        };
        rotation_bytes
            .chunks_exact(3)
            .map(first_three)
            .collect::<Vec<_>>()
    } else {
        rotation_bytes.chunks_exact(4).map(smallest_three).collect()
    };
    Ok(Gaussians {
        means: positions
            .chunks_exact(9)
            .map(|b| Vec3::new(fixed(b), fixed(&b[3..]), fixed(&b[6..])) * flip)
            .collect(),
        log_scales: scales
            .chunks_exact(3)
            .map(|b| vec3(b, |v| v / 16.0 - 10.0))
            .collect(),
        rotations: rotations
            .into_iter()
            .map(|[w, x, y, z]| [w, x, -y, -z])
            .collect(),
        // Opacities of exactly 0 and 1 have no finite logit.
        opacity_logits: opacities
            .iter()
            .map(|b| logit((f32::from(*b) / 255.0).clamp(0.001, 0.999)))
            .collect(),
        sh_dc: colors
            .chunks_exact(3)
            .map(|b| vec3(b, |v| (v - 127.5) / (COLOR_SCALE * 255.0)))
            .collect(),
        sh_degree,
        sh_rest: rest
            .chunks_exact(3)
            .enumerate()
            .map(|(k, b)| vec3(b, |v| (v - 128.0) / 128.0) * SH_SIGNS[k % width])
            .collect(),
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
        let mut g = Gaussians {
            sh_degree: 3,
            ..Gaussians::default()
        };
        for i in 0..50 {
            let mean = 3.0 * Vec3::new(rng.normal(), rng.normal(), rng.normal());
            g.push_sphere(
                mean,
                rng.range(0.001, 0.5),
                rng.range(0.1, 0.9),
                [rng.uniform(), rng.uniform(), rng.uniform()],
            );
            g.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
        }
        g.sh_rest
            .iter_mut()
            .for_each(|v| *v = 0.3 * Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()));
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
            assert!(
                (after.log_scales[i] - before.log_scales[i])
                    .abs()
                    .max_element()
                    <= 0.04
            );
            assert!(
                (sigmoid(after.opacity_logits[i]) - sigmoid(before.opacity_logits[i])).abs()
                    < 0.003
            );
            assert!((after.sh_dc[i] - before.sh_dc[i]).abs().max_element() < 0.02);
            assert!(after.rotation(i).dot(before.rotation(i)).abs() > 0.99);
            for (a, b) in after.rest(i).iter().zip(before.rest(i)) {
                assert!((*a - *b).abs().max_element() <= 0.07);
            }
        }
        // Values that were read are written back without change.
        let again = dir.path().join("again.spz");
        write(&again, &after).unwrap();
        let again = read(&again).unwrap();
        assert_eq!(
            (again.means, again.sh_rest, again.sh_dc),
            (after.means, after.sh_rest, after.sh_dc)
        );
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

    /// Reads a Gaussian whose bytes were written according to the specification.
    #[test]
    fn bytes_are_those_of_the_specification() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("one.spz");
        let mut raw = Vec::new();
        raw.extend(b"NGSP");
        raw.extend([2, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 0]);
        raw.extend([0x00, 0x10, 0x00, 0x00, 0xf0, 0xff, 0x00, 0x08, 0x00]); // 1, -1, 0.5 in 12 fractional bits
        raw.extend([128, 255, 128, 0, 160, 144, 128, 255, 128, 128]);
        let mut encoder =
            GzEncoder::new(std::fs::File::create(&path).unwrap(), Compression::fast());
        encoder.write_all(&raw).unwrap();
        encoder.finish().unwrap();
        let g = read(&path).unwrap();
        assert_eq!(g.means[0], Vec3::new(1.0, 1.0, -0.5));
        assert_eq!(g.log_scales[0], Vec3::new(0.0, -1.0, -2.0));
        assert!((sigmoid(g.opacity_logits[0]) - 128.0 / 255.0).abs() < 1e-6);
        assert!(g.rotation(0).x > 0.999, "half a turn around x");
    }
}
