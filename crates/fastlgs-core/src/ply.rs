//! Reads and writes the PLY format of 3DGS: one `vertex` element of floats, binary little-endian.
//! Reading also accepts big-endian, ASCII and SuperSplat's compressed files.
//!
//! Written columns: `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3` (`f_rest` as
//! in 3DGS: all of red, then green, then blue), then `feature_0..2` (float) and `object_id`
//! (ushort), which other viewers skip.
//!
//! Reading skips unknown columns and sets missing features and ids to 0. The number of `f_rest`
//! columns gives the SH degree. Gaussians that cannot be drawn are dropped.

use crate::gaussians::{MAX_SH_DEGREE, rest_len};
use crate::{Error, Gaussians, Result, WorldFrame, compressed_ply, fs};
use glam::{DVec3, Vec3};
use std::io::{Read, Write};
use std::path::Path;

/// Name of the column of object ids.
const OBJECT_ID: &str = "object_id";

/// Returns the names of the float columns at an SH degree, in file order.
fn float_columns(degree: u32) -> Vec<String> {
    let numbered = |name: &str, n: usize| (0..n).map(|k| format!("{name}_{k}")).collect::<Vec<_>>();
    let fixed = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned);
    let groups = [("f_dc", 3), ("f_rest", 3 * rest_len(degree))].map(|(name, n)| numbered(name, n));
    let tail = [("scale", 3), ("rot", 4), ("feature", 3)].map(|(name, n)| numbered(name, n));
    fixed
        .into_iter()
        .chain(groups.concat())
        .chain(["opacity".to_owned()])
        .chain(tail.concat())
        .collect()
}

/// Writes a scene atomically, in scene coordinates.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians) -> Result<()> {
    write_in(path, scene, &WorldFrame::default())
}

/// Writes a scene atomically, in world coordinates. If the frame has an origin, positions are
/// doubles, because floats lose digits far from the world's origin.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write_in(path: &Path, scene: &Gaussians, frame: &WorldFrame) -> Result<()> {
    let doubles = frame.origin != DVec3::ZERO;
    let shift = frame.scale.ln() as f32;
    fs::write_atomic(path, |file| {
        writeln!(
            file,
            "ply\nformat binary_little_endian 1.0\ncomment FastLGS\nelement vertex {}",
            scene.len()
        )?;
        for name in float_columns(scene.sh_degree) {
            let kind = if doubles && ["x", "y", "z"].contains(&name.as_str()) {
                "double"
            } else {
                "float"
            };
            writeln!(file, "property {kind} {name}")?;
        }
        writeln!(file, "property ushort {OBJECT_ID}\nend_header")?;
        for i in 0..scene.len() {
            let (m, c, r) = (scene.means[i], scene.sh_dc[i], scene.rotations[i]);
            let s = if shift == 0.0 {
                scene.log_scales[i]
            } else {
                scene.log_scales[i] + shift
            };
            let (o, f) = (scene.opacity_logits[i], scene.features[i]);
            if doubles {
                frame
                    .to_world(m)
                    .to_array()
                    .iter()
                    .try_for_each(|v| file.write_all(&v.to_le_bytes()))?;
            } else {
                let world = if frame.is_identity() {
                    m
                } else {
                    frame.to_world(m).as_vec3()
                };
                world
                    .to_array()
                    .iter()
                    .try_for_each(|v| file.write_all(&v.to_le_bytes()))?;
            }
            let head = [0.0, 0.0, 0.0, c.x, c.y, c.z];
            let rest = (0..3).flat_map(|color| scene.rest(i).iter().map(move |v| v[color]));
            let tail = [o, s.x, s.y, s.z, r[0], r[1], r[2], r[3], f.x, f.y, f.z];
            for value in head.into_iter().chain(rest).chain(tail) {
                file.write_all(&value.to_le_bytes())?;
            }
            file.write_all(&scene.object_ids[i].to_le_bytes())?;
        }
        Ok(())
    })
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Decodes a value from the first bytes of `b` (little-endian).
    fn read(self, b: &[u8]) -> f64 {
        match self {
            Self::I8 => f64::from(b[0] as i8),
            Self::U8 => f64::from(b[0]),
            Self::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            Self::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            Self::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F32 => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F64 => f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]),
        }
    }
}

struct Header {
    ascii: bool,
    big_endian: bool,
    count: usize,
    columns: Vec<(String, Scalar)>,
    /// Byte offset of the first row.
    body: usize,
}

/// Maximum length of a header in bytes.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Returns the lines of a header and the byte offset of the body; `None` if the header is
/// incomplete or not that of a PLY. Comments may have any encoding and contain `end_header`.
fn header_lines(data: &[u8]) -> Option<(Vec<String>, usize)> {
    let (mut lines, mut at) = (Vec::<String>::new(), 0);
    let limit = data.len().min(MAX_HEADER_BYTES);
    while let Some(length) = data[at..limit].iter().position(|b| *b == b'\n') {
        let line = String::from_utf8_lossy(&data[at..at + length])
            .trim_end_matches('\r')
            .to_owned();
        at += length + 1;
        if line.trim() == "end_header" {
            return Some((lines, at))
                .filter(|(lines, _)| lines.first().is_some_and(|first| first.trim() == "ply"));
        }
        lines.push(line);
    }
    None
}

fn header(path: &Path, data: &[u8]) -> Result<Header> {
    let bad = |reason: String| Error::format(path, reason);
    let (lines, body) =
        header_lines(data).ok_or_else(|| bad("not a PLY file, or its header is cut off".into()))?;
    let mut header = Header {
        ascii: false,
        big_endian: false,
        count: 0,
        columns: Vec::new(),
        body,
    };
    let mut in_vertex = false;
    for line in &lines {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["comment" | "obj_info", ..] => {}
            ["format", format, _] => {
                header.ascii = *format == "ascii";
                header.big_endian = *format == "binary_big_endian";
            }
            ["element", "vertex", n] => {
                header.count = n
                    .parse()
                    .map_err(|_| bad(format!("bad vertex count '{n}'")))?;
                in_vertex = true;
            }
            ["element", name, _] if header.columns.is_empty() => {
                return Err(bad(format!(
                    "element '{name}' precedes the vertices; this layout is not supported"
                )));
            }
            ["element", ..] => in_vertex = false,
            ["property", "list", ..] if in_vertex => {
                return Err(bad(
                    "a list property in the vertices is not supported".into()
                ));
            }
            ["property", kind, name] if in_vertex => {
                let scalar = Scalar::parse(kind)
                    .ok_or_else(|| bad(format!("unknown property type '{kind}'")))?;
                header.columns.push(((*name).to_owned(), scalar));
            }
            _ => {}
        }
    }
    Ok(header)
}

/// Returns the columns of the vertex element, in file order.
fn columns(path: &Path, data: &[u8], header: &Header) -> Result<Vec<Vec<f64>>> {
    let mut table = vec![Vec::new(); header.columns.len()];
    let short = |i: usize| {
        Error::format(
            path,
            format!(
                "truncated: it announces {} Gaussians but ends within Gaussian {}; copy it again",
                header.count,
                i + 1
            ),
        )
    };
    if header.ascii {
        let text = std::str::from_utf8(&data[header.body.min(data.len())..]).map_err(|_| {
            Error::format(
                path,
                "it is declared as ASCII but is not text; export it again",
            )
        })?;
        let mut words = text.split_whitespace();
        for i in 0..header.count {
            for column in &mut table {
                column.push(
                    words
                        .next()
                        .and_then(|w| w.parse().ok())
                        .ok_or_else(|| short(i))?,
                );
            }
        }
        return Ok(table);
    }
    let row: usize = header.columns.iter().map(|c| c.1.size()).sum();
    let body = &data[header.body.min(data.len())..];
    if row == 0 || body.len() / row < header.count {
        return Err(short(body.len() / row.max(1)));
    }
    for chunk in body.chunks_exact(row).take(header.count) {
        let mut at = 0;
        for (column, (_, scalar)) in table.iter_mut().zip(&header.columns) {
            let mut raw = [0; 8];
            raw[..scalar.size()].copy_from_slice(&chunk[at..at + scalar.size()]);
            if header.big_endian {
                raw[..scalar.size()].reverse();
            }
            column.push(scalar.read(&raw));
            at += scalar.size();
        }
    }
    Ok(table)
}

/// Returns whether a PLY file has object ids. Files of other programs often have none.
///
/// # Errors
/// A missing file, or a header that is not a supported PLY.
pub fn has_object_ids(path: &Path) -> Result<bool> {
    let mut start = Vec::new();
    let file = std::fs::File::open(path).map_err(Error::io(path))?;
    file.take(MAX_HEADER_BYTES as u64)
        .read_to_end(&mut start)
        .map_err(Error::io(path))?;
    Ok(header(path, &start)?
        .columns
        .iter()
        .any(|column| column.0 == OBJECT_ID))
}

/// Reads a PLY in scene coordinates. Gaussians that cannot be drawn are dropped with a warning in
/// the log.
///
/// # Errors
/// [`Error::Io`], or [`Error::Format`] for truncated files and missing columns.
pub fn read(path: &Path) -> Result<Gaussians> {
    parse(path, &fs::read(path)?)
}

/// As [`read`], for a file in memory. Errors name `path`.
///
/// # Errors
/// As [`read`].
pub fn parse(path: &Path, data: &[u8]) -> Result<Gaussians> {
    let (scene, warning) = parse_in(path, data, &WorldFrame::default())?;
    if let Some(warning) = warning {
        tracing::warn!("{warning}");
    }
    Ok(scene)
}

/// Explains why a file without the column `name` is not a 3DGS scene.
fn missing_column(header: &Header, name: &str) -> String {
    let has = |name: &str| header.columns.iter().any(|column| column.0 == name);
    if name == "scale_2" && has("scale_1") {
        return "its Gaussians are 2-D, as from 2DGS (scale_0 and scale_1, no scale_2); train the photos with FastLGS or another 3-D method"
            .into();
    }
    if name.starts_with("f_dc") && has("scale_0") && ["red", "r", "f_rgb_0"].into_iter().any(has) {
        return "its Gaussians have RGB colours and no SH coefficients (f_dc_0 to f_dc_2); export it with spherical harmonics".into();
    }
    if !has("scale_0") && has("x") {
        return format!(
            "no column '{name}': this is a point cloud or a mesh, not a Gaussian scene"
        );
    }
    format!("no column '{name}': this is not a Gaussian scene")
}

/// Reads a PLY in world coordinates and converts it to `frame`. Also returns a warning if Gaussians
/// were dropped.
///
/// # Errors
/// As [`read`].
pub fn parse_in(
    path: &Path,
    data: &[u8],
    frame: &WorldFrame,
) -> Result<(Gaussians, Option<String>)> {
    let lines = header_lines(data).filter(|(lines, _)| compressed_ply::is_compressed(lines));
    let mut scene = if let Some((lines, body)) = lines {
        let mut scene = compressed_ply::parse(path, &lines, &data[body..])?;
        for mean in &mut scene.means {
            *mean = frame.to_local(mean.as_dvec3());
        }
        let shift = frame.scale.ln() as f32;
        scene.log_scales.iter_mut().for_each(|s| *s -= shift);
        scene
    } else {
        uncompressed(path, data, frame)?
    };
    let dropped = scene.drop_invalid();
    let warning = dropped.map(|dropped| format!("{}: {dropped}", path.display()));
    Ok((scene, warning))
}

/// Reads a file with one column for each number.
fn uncompressed(path: &Path, data: &[u8], frame: &WorldFrame) -> Result<Gaussians> {
    let header = header(path, data)?;
    let table = columns(path, data, &header)?;
    let find = |name: &str| {
        let index = header.columns.iter().position(|c| c.0 == name);
        index.map(|i| table[i].as_slice())
    };
    let required =
        |name: &str| find(name).ok_or_else(|| Error::format(path, missing_column(&header, name)));
    let all_of = |names: [&str; 3]| -> Result<Vec<Vec3>> {
        let [a, b, c] = names.map(required);
        Ok(vec3(a?, b?, c?))
    };
    let n = header.count;
    let zeros = vec![0.0; n];
    let feature = |k: usize| find(&format!("feature_{k}")).unwrap_or(&zeros);
    let [w, x, y, z] = ["rot_0", "rot_1", "rot_2", "rot_3"].map(required);
    let rotation = [w?, x?, y?, z?];
    let is_rest = |column: &&(String, _)| column.0.starts_with("f_rest_");
    let rest_columns = header.columns.iter().filter(is_rest).count();
    let sh_degree = (0..=MAX_SH_DEGREE).find(|d| 3 * rest_len(*d) == rest_columns);
    let sh_degree = sh_degree.ok_or_else(|| {
        Error::format(path, format!("it has {rest_columns} columns 'f_rest_*'; SH degrees 0 to {MAX_SH_DEGREE} have 0, 9, 24 or 45"))
    })?;
    let per_color = rest_len(sh_degree);
    let rest = (0..rest_columns)
        .map(|k| required(&format!("f_rest_{k}")))
        .collect::<Result<Vec<_>>>()?;
    let coefficient =
        |i: usize, k: usize| [0, 1, 2].map(|color| rest[color * per_color + k][i] as f32);
    let coefficients = (0..n).flat_map(|i| (0..per_color).map(move |k| (i, k)));
    let (x, y, z) = (required("x")?, required("y")?, required("z")?);
    let local = |i: usize| frame.to_local(DVec3::new(x[i], y[i], z[i]));
    let object_ids = find(OBJECT_ID).unwrap_or(&zeros);
    let mut scene = Gaussians {
        means: (0..n).map(local).collect(),
        log_scales: all_of(["scale_0", "scale_1", "scale_2"])?,
        rotations: (0..n).map(|i| rotation.map(|r| r[i] as f32)).collect(),
        opacity_logits: required("opacity")?.iter().map(|&v| v as f32).collect(),
        sh_dc: all_of(["f_dc_0", "f_dc_1", "f_dc_2"])?,
        sh_degree,
        sh_rest: coefficients
            .map(|(i, k)| coefficient(i, k).into())
            .collect(),
        features: vec3(feature(0), feature(1), feature(2)),
        object_ids: object_ids.iter().map(|&v| v as u16).collect(),
    };
    let shift = (1.0 / frame.scale).ln() as f32;
    if shift != 0.0 {
        scene.log_scales.iter_mut().for_each(|s| *s += shift);
    }
    Ok(scene)
}

/// Joins three columns.
fn vec3(a: &[f64], b: &[f64], c: &[f64]) -> Vec<Vec3> {
    let rows = a.iter().zip(b).zip(c);
    rows.map(|((a, b), c)| Vec3::new(*a as f32, *b as f32, *c as f32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Gaussians {
        let mut g = Gaussians::default();
        for i in 0..5 {
            g.push_sphere(
                Vec3::splat(i as f32),
                0.1 + i as f32,
                0.5,
                [0.1 * i as f32; 3],
            );
        }
        g.features[2] = Vec3::new(0.1, 0.2, 0.3);
        g.object_ids[4] = 513;
        let mut g = g.with_sh_degree(3);
        g.sh_rest
            .iter_mut()
            .enumerate()
            .for_each(|(k, v)| *v = Vec3::new(k as f32, -0.5, 0.25 * k as f32));
        g
    }

    #[test]
    fn round_trip_is_lossless_and_truncation_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.ply");
        write(&path, &sample()).unwrap();
        assert_eq!(read(&path).unwrap(), sample());
        let data = std::fs::read(&path).unwrap();
        std::fs::write(&path, &data[..data.len() - 7]).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(
            message.contains("scene.ply") && message.contains("truncated"),
            "{message}"
        );
    }

    #[test]
    fn invalid_gaussians_are_dropped_with_a_warning() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.ply");
        let mut damaged = sample();
        damaged.means[0].y = f32::NAN;
        damaged.log_scales[1].x = f32::NEG_INFINITY;
        damaged.rotations[2] = [0.0; 4];
        // Fully opaque, as from files with 8-bit opacity.
        damaged.opacity_logits[3] = f32::INFINITY;
        write(&path, &damaged).unwrap();
        let (scene, warning) = parse_in(
            &path,
            &std::fs::read(&path).unwrap(),
            &WorldFrame::default(),
        )
        .unwrap();
        let warning = warning.unwrap();
        assert_eq!(scene.len(), 2);
        assert!(scene.opacity_logits[0].is_finite() && scene.opacity_logits[0] > 6.0);
        assert!(
            ["3 of 5", "y", "scale_0", "rot_0 to rot_3"]
                .iter()
                .all(|word| warning.contains(word)),
            "{warning}"
        );
    }

    #[test]
    fn headers_of_other_programs_are_read_and_other_content_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.ply");
        write(&path, &sample()).unwrap();
        let data = std::fs::read(&path).unwrap();
        let with = |from: &str, to: &[u8]| {
            let at = data
                .windows(from.len())
                .position(|w| w == from.as_bytes())
                .unwrap();
            [&data[..at], to, &data[at + from.len()..]].concat()
        };
        for comment in [
            b"comment caf\xe9 end_header was here\n".as_slice(),
            b"comment end_header\r\nobj_info x\r\n",
        ] {
            assert_eq!(
                parse(&path, &with("comment FastLGS\n", comment)).unwrap(),
                sample()
            );
        }
        assert!(has_object_ids(&path).unwrap());
        std::fs::write(&path, with(OBJECT_ID, b"something")).unwrap();
        assert!(!has_object_ids(&path).unwrap());
        for (column, other, what) in [
            ("scale_2", "flat_no", "2-D"),
            ("scale_0", "size_0", "not a Gaussian scene"),
        ] {
            let refused = parse(&path, &with(column, other.as_bytes()))
                .unwrap_err()
                .to_string();
            assert!(refused.contains(what), "{refused}");
        }
        let rgb = with("f_dc_0", b"red_0_");
        let at = rgb.windows(5).position(|w| w == b" nx\np").unwrap();
        let refused = parse(&path, &[&rgb[..at], b" red\np", &rgb[at + 5..]].concat())
            .unwrap_err()
            .to_string();
        assert!(refused.contains("RGB"), "{refused}");
    }

    #[test]
    fn far_scenes_keep_their_digits() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.ply");
        let frame = WorldFrame {
            origin: DVec3::new(512_345.6, 5_403_210.9, 431.2),
            scale: 4.0,
        };
        write_in(&path, &sample(), &frame).unwrap();
        let data = std::fs::read(&path).unwrap();
        let (back, _) = parse_in(&path, &data, &frame).unwrap();
        assert!(
            back.means
                .iter()
                .zip(&sample().means)
                .all(|(a, b)| a.distance(*b) < 1e-6),
            "{:?}",
            back.means
        );
        let (world, _) = parse_in(
            &path,
            &data,
            &WorldFrame {
                scale: 1.0,
                ..frame
            },
        )
        .unwrap();
        assert!((world.means[2] - 4.0 * sample().means[2]).length() < 1e-5);
        assert!((world.log_scales[2] - sample().log_scales[2] - 4f32.ln()).length() < 1e-5);
    }

    /// Reads the same two Gaussians in both byte orders and as text.
    #[test]
    fn both_byte_orders_and_text() {
        let dir = tempfile::tempdir().unwrap();
        let names = [
            "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
            "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "extra",
        ];
        let rows: Vec<Vec<f32>> = (0..2)
            .map(|i| {
                (0..names.len())
                    .map(|c| c as f32 * 0.25 + i as f32)
                    .collect()
            })
            .collect();
        let read_as = |format: &str, body: Vec<u8>| {
            let properties: String = names
                .iter()
                .map(|n| format!("property float {n}\n"))
                .collect();
            let mut data =
                format!("ply\nformat {format} 1.0\nelement vertex 2\n{properties}end_header\n")
                    .into_bytes();
            data.extend(body);
            let path = dir.path().join(format);
            std::fs::write(&path, data).unwrap();
            read(&path).unwrap()
        };
        let flat = || rows.iter().flatten();
        let little = read_as(
            "binary_little_endian",
            flat().flat_map(|v| v.to_le_bytes()).collect(),
        );
        let big = read_as(
            "binary_big_endian",
            flat().flat_map(|v| v.to_be_bytes()).collect(),
        );
        let text = read_as(
            "ascii",
            flat()
                .map(|v| format!("{v} "))
                .collect::<String>()
                .into_bytes(),
        );
        assert_eq!(little, big);
        assert_eq!(little, text);
        assert_eq!(little.rotations[1], [3.5, 3.75, 4.0, 4.25]);
    }
}
