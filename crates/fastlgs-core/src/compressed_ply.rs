//! Reads SuperSplat's compressed PLY (playcanvas.com).
//!
//! Gaussians are stored in chunks of 256. Positions, scales and colours are quantised between the
//! bounds of their chunk. Elements: `chunk` (floats), `vertex` (four 32-bit words), and optionally
//! `sh` (bytes) for view-dependent colour.

use crate::gaussians::{MAX_SH_DEGREE, logit, rest_len};
use crate::{Error, Gaussians, Result};
use glam::Vec3;
use std::collections::HashMap;
use std::path::Path;

/// Number of Gaussians per chunk.
const CHUNK: usize = 256;

/// An element of the header: row count, name and byte offset of each property, and bytes per row.
struct Element {
    count: usize,
    columns: Vec<(String, usize)>,
    row: usize,
}

/// Returns whether the header lines belong to a compressed PLY.
pub fn is_compressed(lines: &[String]) -> bool {
    lines.iter().any(|line| {
        line.split_whitespace()
            .eq(["property", "uint", "packed_position"])
    })
}

/// Rows of one element, with access to its properties by name.
struct Table<'a> {
    element: &'a Element,
    rows: &'a [u8],
}

impl Table<'_> {
    fn bytes(&self, row: usize, name: &str) -> Option<&[u8]> {
        let at = self
            .element
            .columns
            .iter()
            .find(|column| column.0 == name)?
            .1;
        self.rows.get(row * self.element.row + at..)
    }

    fn word(&self, row: usize, name: &str) -> Option<u32> {
        let b = self.bytes(row, name)?;
        Some(u32::from_le_bytes([
            *b.first()?,
            *b.get(1)?,
            *b.get(2)?,
            *b.get(3)?,
        ]))
    }

    fn float(&self, row: usize, name: &str) -> Option<f32> {
        self.word(row, name).map(f32::from_bits)
    }
}

/// Parses the elements of a header.
fn elements(path: &Path, lines: &[String]) -> Result<Vec<(String, Element)>> {
    let mut found: Vec<(String, Element)> = Vec::new();
    for line in lines {
        match line.split_whitespace().collect::<Vec<_>>()[..] {
            ["format", format, _] if format != "binary_little_endian" => {
                return Err(Error::format(
                    path,
                    "a compressed PLY must be binary_little_endian; export it again",
                ));
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| {
                    Error::format(path, format!("bad count '{count}' of element {name}"))
                })?;
                found.push((
                    name.to_owned(),
                    Element {
                        count,
                        columns: Vec::new(),
                        row: 0,
                    },
                ));
            }
            ["property", kind, name] => {
                let size = match kind {
                    "float" | "uint" | "int" => 4,
                    "uchar" | "uint8" => 1,
                    _ => {
                        return Err(Error::format(
                            path,
                            format!("unknown property type '{kind}' in a compressed PLY"),
                        ));
                    }
                };
                let (_, element) = found.last_mut().ok_or_else(|| {
                    Error::format(
                        path,
                        "the header has a property before its first element; export it again",
                    )
                })?;
                element.columns.push((name.to_owned(), element.row));
                element.row += size;
            }
            _ => {}
        }
    }
    Ok(found)
}

/// Parses a scene from the lines of its header and the `body` after it. Features are zero and
/// object ids 0.
///
/// # Errors
/// [`Error::Format`] for truncated files and missing properties.
pub fn parse(path: &Path, lines: &[String], body: &[u8]) -> Result<Gaussians> {
    let bad = |reason: String| Error::format(path, reason);
    let elements = elements(path, lines)?;
    let mut tables = HashMap::new();
    let mut rest = body;
    for (name, element) in &elements {
        let length = element.count.checked_mul(element.row);
        let split = length.and_then(|length| rest.split_at_checked(length));
        let (rows, after) = split.ok_or_else(|| {
            bad(format!(
                "truncated: it ends before the {} announced rows of {name}; copy it again",
                element.count
            ))
        })?;
        tables.insert(name.as_str(), Table { element, rows });
        rest = after;
    }
    let (Some(chunks), Some(vertices)) = (tables.get("chunk"), tables.get("vertex")) else {
        return Err(bad(
            "a compressed PLY must have the elements chunk and vertex; export it again".into(),
        ));
    };
    let n = vertices.element.count;
    let columns = tables
        .get("sh")
        .map_or(0, |table| table.element.columns.len());
    let sh_degree = (0..=MAX_SH_DEGREE).find(|degree| 3 * rest_len(*degree) == columns);
    let sh_degree = sh_degree.ok_or_else(|| {
        bad(format!(
            "{columns} SH coefficients do not match any SH degree up to {MAX_SH_DEGREE}"
        ))
    })?;
    let mut scene = Gaussians {
        sh_degree,
        ..Gaussians::default()
    };
    for i in 0..n {
        let row = gaussian(chunks, vertices, i).ok_or_else(|| {
            bad(format!(
                "Gaussian {i} has no chunk or lacks a packed property; export it again"
            ))
        })?;
        scene.push_sphere(row.mean, 1.0, 0.5, row.color);
        scene.log_scales[i] = row.log_scale;
        scene.rotations[i] = row.rotation;
        scene.opacity_logits[i] = logit(row.opacity.clamp(0.001, 0.999));
    }
    if let Some(table) = tables.get("sh") {
        read_harmonics(table, &mut scene);
    }
    Ok(scene)
}

/// Reads the SH coefficients above degree 0, one byte each.
fn read_harmonics(table: &Table, scene: &mut Gaussians) {
    let per_color = rest_len(scene.sh_degree);
    for (k, rest) in scene.sh_rest.iter_mut().enumerate() {
        let (i, coefficient) = (k / per_color, k % per_color);
        let value = |color: usize| {
            let column = format!("f_rest_{}", color * per_color + coefficient);
            let byte = table.bytes(i, &column).and_then(|bytes| bytes.first());
            // Centre of one of 256 equal steps between -4 and 4.
            byte.map_or(0.0, |byte| (f32::from(*byte) + 0.5) / 32.0 - 4.0)
        };
        *rest = Vec3::new(value(0), value(1), value(2));
    }
}

/// A Gaussian with dequantised values. Colour and opacity are 0 to 1; the rotation is (w, x, y, z).
struct UnpackedGaussian {
    mean: Vec3,
    log_scale: Vec3,
    rotation: [f32; 4],
    color: [f32; 3],
    opacity: f32,
}

/// Unpacks Gaussian `i`; `None` if its chunk or a packed property is missing.
fn gaussian(chunks: &Table<'_>, vertices: &Table<'_>, i: usize) -> Option<UnpackedGaussian> {
    let chunk = i / CHUNK;
    let dequantise = |names: [&str; 3], bits: [f32; 3]| -> Option<Vec3> {
        let bound = |side: &str| -> Option<Vec3> {
            let value = |name: &str| chunks.float(chunk, &format!("{side}_{name}"));
            Some(Vec3::new(
                value(names[0])?,
                value(names[1])?,
                value(names[2])?,
            ))
        };
        let (low, high) = (bound("min")?, bound("max")?);
        Some(low + (high - low) * Vec3::from(bits))
    };
    let mean = dequantise(
        ["x", "y", "z"],
        eleven_ten_eleven(vertices.word(i, "packed_position")?),
    )?;
    let log_scale = dequantise(
        ["scale_x", "scale_y", "scale_z"],
        eleven_ten_eleven(vertices.word(i, "packed_scale")?),
    )?;
    let [r, g, b, opacity] = vertices
        .word(i, "packed_color")?
        .to_be_bytes()
        .map(|v| f32::from(v) / 255.0);
    // Colour bounds are optional in the format; without them colours lie between 0 and 1.
    let color = dequantise(["r", "g", "b"], [r, g, b])
        .unwrap_or(Vec3::new(r, g, b))
        .to_array();
    Some(UnpackedGaussian {
        mean,
        log_scale,
        rotation: rotation(vertices.word(i, "packed_rotation")?),
        color,
        opacity,
    })
}

/// Unpacks three numbers between 0 and 1 from 11, 10 and 11 bits, the first in the highest bits.
fn eleven_ten_eleven(word: u32) -> [f32; 3] {
    [
        (word >> 21) as f32 / 2047.0,
        (word >> 11 & 1023) as f32 / 1023.0,
        (word & 2047) as f32 / 2047.0,
    ]
}

/// Unpacks a unit quaternion (w, x, y, z). The top two bits are the index of the largest component;
/// the others have ten bits each, between -1/sqrt(2) and 1/sqrt(2).
fn rotation(word: u32) -> [f32; 4] {
    let part =
        |shift: u32| ((word >> shift & 1023) as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
    let mut parts = [part(20), part(10), part(0)].into_iter();
    let rest: f32 = [20, 10, 0].map(|shift| part(shift).powi(2)).iter().sum();
    let largest = (word >> 30) as usize;
    std::array::from_fn(|k| {
        if k == largest {
            (1.0 - rest).max(0.0).sqrt()
        } else {
            parts.next().unwrap_or(0.0)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ply;

    /// Builds one chunk with two Gaussians according to SuperSplat's specification.
    fn file() -> Vec<u8> {
        let bounds = [
            "x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b",
        ];
        let names = |group: &[&str]| {
            let each = |side: &str| {
                group
                    .iter()
                    .map(|name| format!("property float {side}_{name}\n"))
                    .collect::<String>()
            };
            each("min") + &each("max")
        };
        let chunk = names(&bounds[..3]) + &names(&bounds[3..6]) + &names(&bounds[6..]);
        let packed: String = ["position", "rotation", "scale", "color"]
            .map(|name| format!("property uint packed_{name}\n"))
            .concat();
        let sh: String = (0..9)
            .map(|k| format!("property uchar f_rest_{k}\n"))
            .collect();
        let header = format!(
            "ply\nformat binary_little_endian 1.0\nelement chunk 1\n{chunk}element vertex 2\n{packed}element sh 2\n{sh}end_header\n"
        );
        let mut data = header.into_bytes();
        let values = [
            [-1.0f32, -2.0, -3.0],
            [1.0, 2.0, 3.0],
            [-5.0; 3],
            [-1.0; 3],
            [0.0; 3],
            [1.0, 1.0, 0.5],
        ];
        data.extend(values.concat().into_iter().flat_map(f32::to_le_bytes));
        // First Gaussian: lower bounds and the identity rotation (largest component w). Second:
        // upper bounds and a half turn about x.
        for word in [
            0u32,
            512 << 20 | 512 << 10 | 512,
            0,
            0x0000_0080,
            u32::MAX,
            1 << 30 | 512 << 20 | 512 << 10 | 512,
            u32::MAX,
            u32::MAX,
        ] {
            data.extend(word.to_le_bytes());
        }
        data.extend([128u8; 9].into_iter().chain([255; 9]));
        data
    }

    #[test]
    fn chunks_are_unpacked() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.compressed.ply");
        std::fs::write(&path, file()).unwrap();
        let scene = ply::read(&path).unwrap();
        assert_eq!((scene.len(), scene.sh_degree), (2, 1));
        assert_eq!(
            (scene.means[0], scene.means[1]),
            (Vec3::new(-1.0, -2.0, -3.0), Vec3::new(1.0, 2.0, 3.0))
        );
        assert_eq!(
            (scene.log_scales[0], scene.log_scales[1]),
            (Vec3::splat(-5.0), Vec3::splat(-1.0))
        );
        assert!(scene.rotation(0).w > 0.999 && scene.rotation(1).x > 0.999);
        assert!(
            (0.5 + crate::gaussians::SH_C0 * scene.sh_dc[1] - Vec3::new(1.0, 1.0, 0.5)).length()
                < 1e-5
        );
        assert!((crate::gaussians::sigmoid(scene.opacity_logits[0]) - 128.0 / 255.0).abs() < 1e-5);
        assert!(
            (scene.sh_rest[0].x - 0.0156).abs() < 1e-3 && (scene.sh_rest[3].x - 3.984).abs() < 1e-2
        );
        std::fs::write(&path, &file()[..file().len() - 20]).unwrap();
        assert!(
            ply::read(&path)
                .unwrap_err()
                .to_string()
                .contains("truncated")
        );
    }
}
