//! Reads and writes SOG, the compressed Gaussian format of PlayCanvas (version 2,
//! developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog).
//!
//! A file is an archive of lossless WebP images, in which each pixel is a Gaussian, and
//! `meta.json`, which describes them. The format has no features or object ids.
//!
//! Positions are stored as sign(v) ln(|v| + 1) with 16 bits, and rotations as their three smallest
//! components with 8 bits each. Scales and colours are indices into codebooks, and the SH
//! coefficients of a Gaussian are a row of a palette. The axes are those of 3DGS PLY files.

mod codebook;
mod palette;

use crate::curve::morton_order;
use crate::gaussians::{MAX_SH_DEGREE, logit, rest_len, sigmoid};
use crate::{Error, Gaussians, Result, fs};
use codebook::{CODES, codebook, nearest};
use glam::Vec3;
use image::codecs::webp::{WebPDecoder, WebPEncoder};
use image::{ExtendedColorType, ImageDecoder};
use palette::palette;
use serde::{Deserialize, Serialize};
use std::io::{Cursor, Read, Write};
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

const VERSION: u32 = 2;
/// Palette rows per row of the palette image.
const PALETTE_COLUMNS: usize = 64;
/// Fourth channel of a rotation whose omitted component is w; 253 to 255 denote x, y and z.
const ROTATION_TAG_W: u8 = 252;

#[derive(Serialize, Deserialize)]
struct Meta {
    version: u32,
    #[serde(default)]
    asset: Asset,
    count: usize,
    means: Means,
    scales: Coded,
    quats: Files,
    sh0: Coded,
    #[serde(rename = "shN", skip_serializing_if = "Option::is_none")]
    rest: Option<Rest>,
}

#[derive(Default, Serialize, Deserialize)]
struct Asset {
    #[serde(default)]
    generator: String,
}

#[derive(Serialize, Deserialize)]
struct Means {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [String; 2],
}

#[derive(Serialize, Deserialize)]
struct Coded {
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Serialize, Deserialize)]
struct Files {
    files: [String; 1],
}

#[derive(Serialize, Deserialize)]
struct Rest {
    count: usize,
    bands: u32,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// An RGBA image of the archive.
struct Picture {
    name: &'static str,
    width: usize,
    pixels: Vec<[u8; 4]>,
}

fn byte(value: f32) -> u8 {
    (255.0 * value).round().clamp(0.0, 255.0) as u8
}

/// Compresses positions far from the origin: sign(v) ln(|v| + 1).
fn signed_log(v: Vec3) -> Vec3 {
    (v.abs() + 1.0).map(f32::ln) * v.signum()
}

/// Inverts [`signed_log`].
fn signed_exp(v: Vec3) -> Vec3 {
    (v.abs().map(f32::exp) - 1.0) * v.signum()
}

/// Writes the scene atomically, without features and object ids. Sorts Gaussians along a Morton
/// curve, so that the images compress well.
///
/// # Errors
/// [`Error::Invalid`] for an empty scene, [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians) -> Result<()> {
    if scene.is_empty() {
        return Err(Error::Invalid(format!(
            "{}: there are no Gaussians to write",
            path.display()
        )));
    }
    let scene = &scene.select(&morton_order(&scene.means));
    let n = scene.len();
    // Width and height are multiples of four, as in the encoder of the specification.
    let width = ((n as f64).sqrt() / 4.0).ceil() as usize * 4;
    let pixels = width * n.div_ceil(width).next_multiple_of(4);
    let mut pictures = Vec::new();
    let mut picture = |name: &'static str, of: &dyn Fn(usize) -> [u8; 4]| {
        let mut own: Vec<[u8; 4]> = (0..n).map(of).collect();
        own.resize(pixels, [0, 0, 0, 255]);
        pictures.push(Picture {
            name,
            width,
            pixels: own,
        });
        name.to_owned()
    };

    let logs: Vec<Vec3> = scene.means.iter().map(|m| signed_log(*m)).collect();
    let low = logs.iter().copied().reduce(Vec3::min).unwrap_or_default();
    let high = logs.iter().copied().reduce(Vec3::max).unwrap_or_default();
    let range = (high - low).max(Vec3::splat(1e-6));
    let steps = |i: usize| {
        ((logs[i] - low) / range * 65535.0)
            .round()
            .to_array()
            .map(|v| v as u16)
    };
    let means_l = picture("means_l.webp", &|i| {
        with_alpha(steps(i).map(|v| v as u8), 255)
    });
    let means_u = picture("means_u.webp", &|i| {
        with_alpha(steps(i).map(|v| (v >> 8) as u8), 255)
    });
    let quats = picture("quats.webp", &|i| packed_rotation(scene.rotations[i]));
    let scale_codes = codebook(scene.log_scales.iter().flat_map(|s| s.to_array()));
    let scales = picture("scales.webp", &|i| {
        with_alpha(
            scene.log_scales[i]
                .to_array()
                .map(|s| nearest(&scale_codes, s)),
            255,
        )
    });
    let color_codes = codebook(scene.sh_dc.iter().flat_map(|c| c.to_array()));
    let color = |i: usize| scene.sh_dc[i].to_array().map(|c| nearest(&color_codes, c));
    let sh0 = picture("sh0.webp", &|i| {
        with_alpha(color(i), byte(sigmoid(scene.opacity_logits[i])))
    });
    let rest = (scene.sh_degree > 0).then(|| coded_rest(scene, &mut picture));
    let (rest, centroids) = rest.unzip();
    pictures.extend(centroids);
    let meta = Meta {
        version: VERSION,
        asset: Asset {
            generator: concat!("FastLGS ", env!("CARGO_PKG_VERSION")).to_owned(),
        },
        count: n,
        means: Means {
            mins: low.to_array(),
            maxs: (low + range).to_array(),
            files: [means_l, means_u],
        },
        scales: Coded {
            codebook: scale_codes.to_vec(),
            files: [scales],
        },
        quats: Files { files: [quats] },
        sh0: Coded {
            codebook: color_codes.to_vec(),
            files: [sh0],
        },
        rest,
    };
    archive(path, &meta, &pictures)
}

/// Codes the SH coefficients above degree 0 by a palette. `picture` stores an image of one pixel
/// for each Gaussian, and returns its name. The palette itself is returned as an image.
fn coded_rest(
    scene: &Gaussians,
    picture: &mut impl FnMut(&'static str, &dyn Fn(usize) -> [u8; 4]) -> String,
) -> (Rest, Picture) {
    let bands = scene.sh_degree;
    let rows: Vec<f32> = scene.sh_rest.iter().flat_map(|v| v.to_array()).collect();
    let palette = palette(&rows, 3 * rest_len(bands));
    let labels = picture("shN_labels.webp", &|i| {
        let [low, high] = palette.labels[i].to_le_bytes();
        [low, high, 0, 255]
    });
    let codes = codebook(palette.rows.iter().copied());
    let coded = palette
        .rows
        .chunks_exact(3)
        .map(|v| with_alpha([0, 1, 2].map(|k| nearest(&codes, v[k])), 255));
    let width = PALETTE_COLUMNS * rest_len(bands);
    let mut pixels: Vec<[u8; 4]> = coded.collect();
    let count = pixels.len() / rest_len(bands);
    pixels.resize(pixels.len().next_multiple_of(width), [0, 0, 0, 255]);
    let name = "shN_centroids.webp";
    let rest = Rest {
        count,
        bands,
        codebook: codes.to_vec(),
        files: [name.to_owned(), labels],
    };
    let centroids = Picture {
        name,
        width,
        pixels,
    };
    (rest, centroids)
}

fn with_alpha([r, g, b]: [u8; 3], a: u8) -> [u8; 4] {
    [r, g, b, a]
}

/// Builds the archive in memory and writes it atomically.
fn archive(path: &Path, meta: &Meta, pictures: &[Picture]) -> Result<()> {
    let damaged = |error: &dyn std::fmt::Display| {
        Error::format(path, format!("the SOG archive cannot be written: {error}"))
    };
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // WebP images are compressed already.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut add = |name: &str, data: &[u8]| {
        archive.start_file(name, options).map_err(|e| damaged(&e))?;
        archive.write_all(data).map_err(|e| damaged(&e))
    };
    add(
        "meta.json",
        &serde_json::to_vec(meta).map_err(|e| damaged(&e))?,
    )?;
    for Picture {
        name,
        width,
        pixels,
    } in pictures
    {
        let mut data = Vec::new();
        let height = (pixels.len() / width) as u32;
        let encoder = WebPEncoder::new_lossless(&mut data);
        encoder
            .encode(
                pixels.as_flattened(),
                *width as u32,
                height,
                ExtendedColorType::Rgba8,
            )
            .map_err(|e| damaged(&e))?;
        add(name, &data)?;
    }
    let data = archive.finish().map_err(|e| damaged(&e))?.into_inner();
    fs::write_atomic(path, |file| file.write_all(&data))
}

/// Packs a quaternion (w, x, y, z) into its three smallest components and the index of the omitted
/// one. Components are scaled by sqrt(2) to [-1, 1] and stored as bytes.
fn packed_rotation(q: [f32; 4]) -> [u8; 4] {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    let largest = (0..4)
        .max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs()))
        .unwrap_or(0);
    let scale = std::f32::consts::FRAC_1_SQRT_2 / if q[largest] < 0.0 { -length } else { length };
    let mut rest = (0..4)
        .filter(|k| *k != largest)
        .map(|k| byte(q[k] * scale + 0.5));
    let mut next = || rest.next().unwrap_or(0);
    [next(), next(), next(), ROTATION_TAG_W + largest as u8]
}

/// Unpacks a quaternion (w, x, y, z); `None` for an invalid tag.
fn rotation([a, b, c, tag]: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(tag.checked_sub(ROTATION_TAG_W)?);
    let rest =
        [a, b, c].map(|v| (f32::from(v) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    let own = (1.0 - rest.iter().map(|v| v * v).sum::<f32>())
        .max(0.0)
        .sqrt();
    let mut out = rest.to_vec();
    out.insert(largest, own);
    out.try_into().ok()
}

/// An opened SOG file.
struct Archive<'a> {
    path: &'a Path,
    zip: ZipArchive<Cursor<Vec<u8>>>,
}

impl Archive<'_> {
    fn bad(&self, reason: String) -> Error {
        Error::format(self.path, reason)
    }

    /// Returns the content of a member.
    fn member(&mut self, name: &str) -> Result<Vec<u8>> {
        let path = self.path;
        let bad = |reason: String| Error::format(path, reason);
        let mut data = Vec::new();
        let mut file = self
            .zip
            .by_name(name)
            .map_err(|e| bad(format!("it does not contain {name} ({e}); export it again")))?;
        file.read_to_end(&mut data)
            .map_err(|e| bad(format!("{name} is damaged ({e}); copy it again")))?;
        Ok(data)
    }

    /// Returns the first `count` pixels of a picture.
    fn pixels(&mut self, name: &str, count: usize) -> Result<Vec<[u8; 4]>> {
        let data = self.member(name)?;
        let damaged =
            |e: image::ImageError| self.bad(format!("{name} is damaged ({e}); copy it again"));
        let decoder = WebPDecoder::new(Cursor::new(data)).map_err(damaged)?;
        let channels = usize::from(decoder.color_type().channel_count());
        let (width, height) = decoder.dimensions();
        // Check the size before allocating memory for it.
        if (width as usize) * (height as usize) < count {
            return Err(self.bad(format!(
                "{name} has {width}x{height} pixels, but at least {count} are needed; export it again"
            )));
        }
        let mut values = vec![0; decoder.total_bytes() as usize];
        decoder.read_image(&mut values).map_err(damaged)?;
        let pixel = |p: &[u8]| [p[0], p[1], p[2], if channels == 4 { p[3] } else { 255 }];
        Ok(values
            .chunks_exact(channels)
            .take(count)
            .map(pixel)
            .collect())
    }

    /// Returns a function that looks up the first three bytes of a pixel in a codebook.
    fn lookup(&self, codes: &[f32], name: &str) -> Result<impl Fn([u8; 4]) -> Vec3 + use<>> {
        let codes = <[f32; CODES]>::try_from(codes).map_err(|_| {
            self.bad(format!(
                "the codebook of {name} does not have {CODES} numbers; export it again"
            ))
        })?;
        Ok(move |p: [u8; 4]| Vec3::from_array([p[0], p[1], p[2]].map(|v| codes[usize::from(v)])))
    }

    /// Returns the SH coefficients above degree 0 of `count` Gaussians.
    fn rest(&mut self, rest: &Rest, count: usize) -> Result<Vec<Vec3>> {
        if rest.bands > MAX_SH_DEGREE {
            return Err(self.bad(format!(
                "SH degree {} is not supported; export it with degree {MAX_SH_DEGREE} or less",
                rest.bands
            )));
        }
        let width = rest_len(rest.bands);
        let centroids = self.pixels(&rest.files[0], rest.count * width)?;
        let labels = self.pixels(&rest.files[1], count)?;
        let value = self.lookup(&rest.codebook, "shN")?;
        let mut coefficients = Vec::with_capacity(count * width);
        for label in &labels {
            let at = usize::from(u16::from_le_bytes([label[0], label[1]])) * width;
            let row = centroids.get(at..at + width).ok_or_else(|| {
                self.bad(format!(
                    "{} refers to rows that the palette does not have; export it again",
                    rest.files[1]
                ))
            })?;
            coefficients.extend(row.iter().map(|p| value(*p)));
        }
        Ok(coefficients)
    }
}

/// Reads a scene. Features are zero and object ids 0.
///
/// # Errors
/// [`Error::Format`] for other content, truncated files and other versions.
pub fn read(path: &Path) -> Result<Gaussians> {
    let bad = |reason: String| Error::format(path, reason);
    let zip = ZipArchive::new(Cursor::new(fs::read(path)?))
        .map_err(|e| bad(format!("not a complete SOG file ({e}); copy it again")))?;
    let mut archive = Archive { path, zip };
    let meta: Meta = serde_json::from_slice(&archive.member("meta.json")?)
        .map_err(|e| bad(format!("meta.json: {e}")))?;
    if meta.version != VERSION {
        return Err(bad(format!(
            "SOG version {} is not supported; export it as version {VERSION}",
            meta.version
        )));
    }
    let n = meta.count;
    let low = archive.pixels(&meta.means.files[0], n)?;
    let high = archive.pixels(&meta.means.files[1], n)?;
    let (from, to) = (Vec3::from(meta.means.mins), Vec3::from(meta.means.maxs));
    let mean = |(l, u): (&[u8; 4], &[u8; 4])| {
        let steps =
            Vec3::from_array([0, 1, 2].map(|k| f32::from(u16::from_le_bytes([l[k], u[k]]))));
        signed_exp(from + (to - from) * steps / 65535.0)
    };
    let rotations = archive.pixels(&meta.quats.files[0], n)?;
    let rotations = rotations.into_iter().map(rotation).collect::<Option<_>>();
    let rotations = rotations.ok_or_else(|| {
        bad(format!(
            "{} has pixels that are not rotations; export it again",
            meta.quats.files[0]
        ))
    })?;
    let scale = archive.lookup(&meta.scales.codebook, "scales")?;
    let scales = archive.pixels(&meta.scales.files[0], n)?;
    let color = archive.lookup(&meta.sh0.codebook, "sh0")?;
    let colors = archive.pixels(&meta.sh0.files[0], n)?;
    // Opacities of exactly 0 and 1 have no finite logit.
    let opacity_logit = |p: &[u8; 4]| logit((f32::from(p[3]) / 255.0).clamp(0.001, 0.999));
    let (sh_degree, sh_rest) = match &meta.rest {
        Some(rest) => (rest.bands, archive.rest(rest, n)?),
        None => (0, Vec::new()),
    };
    Ok(Gaussians {
        means: low.iter().zip(&high).map(mean).collect(),
        log_scales: scales.into_iter().map(scale).collect(),
        rotations,
        opacity_logits: colors.iter().map(opacity_logit).collect(),
        sh_dc: colors.into_iter().map(color).collect(),
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

    fn sample(n: usize) -> Gaussians {
        let mut rng = Rng::new(1, "sog");
        let mut g = Gaussians {
            sh_degree: 2,
            ..Gaussians::default()
        };
        for i in 0..n {
            let mean = 3.0 * Vec3::new(rng.normal(), rng.normal(), rng.normal());
            g.push_sphere(
                mean,
                rng.range(0.001, 0.5),
                rng.range(0.1, 0.9),
                [rng.uniform(), rng.uniform(), rng.uniform()],
            );
            g.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
        }
        // Each Gaussian has one of 20 sets of SH coefficients, with a little noise.
        let kinds: Vec<Vec3> = (0..20 * rest_len(2))
            .map(|_| 0.1 * Vec3::new(rng.normal(), rng.normal(), rng.normal()))
            .collect();
        for row in g.sh_rest.chunks_exact_mut(rest_len(2)) {
            let kind = (20.0 * rng.uniform()) as usize * rest_len(2);
            row.iter_mut()
                .zip(&kinds[kind..])
                .for_each(|(v, own)| *v = *own + 0.003 * Vec3::splat(rng.normal()));
        }
        g
    }

    #[test]
    fn round_trip_is_as_close_as_the_format_allows() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.sog");
        let before = sample(3000);
        write(&path, &before).unwrap();
        let after = read(&path).unwrap();
        let before = before.select(&morton_order(&before.means));
        assert_eq!((after.len(), after.sh_degree), (3000, 2));
        for i in 0..before.len() {
            assert!((after.means[i] - before.means[i]).length() < 2e-3);
            assert!(
                (after.log_scales[i] - before.log_scales[i])
                    .abs()
                    .max_element()
                    <= 0.1
            );
            assert!(
                (sigmoid(after.opacity_logits[i]) - sigmoid(before.opacity_logits[i])).abs()
                    < 0.003
            );
            assert!((after.sh_dc[i] - before.sh_dc[i]).abs().max_element() < 0.03);
            assert!(after.rotation(i).dot(before.rotation(i)).abs() > 0.9999);
        }
        let error = |a: &[Vec3]| {
            a.iter()
                .zip(&before.sh_rest)
                .map(|(a, b)| (*a - *b).length_squared())
                .sum::<f32>()
        };
        assert!(error(&after.sh_rest) < 0.01 * error(&vec![Vec3::ZERO; before.sh_rest.len()]));
        let again = dir.path().join("again.sog");
        write(&again, &sample(3000)).unwrap();
        assert_eq!(
            std::fs::read(&path).unwrap(),
            std::fs::read(&again).unwrap(),
            "the same scene gives the same bytes"
        );
        // A single Gaussian without view-dependent colour.
        write(&path, &sample(1).with_sh_degree(0)).unwrap();
        assert_eq!(read(&path).unwrap().len(), 1);
        assert!(write(&path, &Gaussians::default()).is_err());
    }

    #[test]
    fn damage_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.sog");
        write(&path, &sample(50)).unwrap();
        let data = std::fs::read(&path).unwrap();
        std::fs::write(&path, &data[..data.len() / 2]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("scene.sog"));
        std::fs::write(&path, b"ply\n").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("SOG"));
        // A count that is larger than the images.
        let count = data.windows(10).position(|w| w == b"\"count\":50").unwrap();
        let mut more = data;
        more[count..count + 10].copy_from_slice(b"\"count\":99");
        std::fs::write(&path, &more).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(
            message.contains("damaged") || message.contains("too few"),
            "{message}"
        );
    }
}
