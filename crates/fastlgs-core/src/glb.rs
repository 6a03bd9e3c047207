//! Reads and writes binary glTF 2.0 with the Khronos extension `KHR_gaussian_splatting`: one mesh
//! of points whose attributes are the Gaussians.
//!
//! Scales are linear (not logarithms), opacity is after the sigmoid, and rotations are unit
//! quaternions (x, y, z, w). Coordinates are those of the scene; the node rotates its up direction
//! to glTF's +y. Programs without the extension show coloured points. The format has no features or
//! object ids.

use crate::gaussians::{MAX_SH_DEGREE, SH_C0, logit, rest_len, sigmoid};
use crate::{Error, Gaussians, Result, WorldFrame, fs};
use glam::{Quat, Vec3};
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

// Numbers of the glTF 2.0 specification: file header, chunk types, component type, primitive mode
// and buffer target.
const MAGIC: u32 = 0x4654_6c67;
const VERSION: u32 = 2;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;
const FLOAT: u32 = 5126;
const POINTS: u32 = 0;
const VERTICES: u32 = 34962;

/// Attribute name, glTF type, and the values of all Gaussians, one Gaussian after the other.
type Attribute = (String, &'static str, Vec<f32>);

fn attributes(scene: &Gaussians) -> Vec<Attribute> {
    let flat = |values: &[Vec3]| {
        values
            .iter()
            .flat_map(|v| v.to_array())
            .collect::<Vec<f32>>()
    };
    let extension_name = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let opacity: Vec<f32> = scene.opacity_logits.iter().map(|o| sigmoid(*o)).collect();
    let color = |(c, o): (&Vec3, &f32)| {
        (0.5 + SH_C0 * *c)
            .clamp(Vec3::ZERO, Vec3::ONE)
            .extend(*o)
            .to_array()
    };
    let mut out = vec![
        ("POSITION".to_owned(), "VEC3", flat(&scene.means)),
        (
            "COLOR_0".to_owned(),
            "VEC4",
            scene.sh_dc.iter().zip(&opacity).flat_map(color).collect(),
        ),
        (
            extension_name("ROTATION"),
            "VEC4",
            (0..scene.len())
                .flat_map(|i| scene.rotation(i).to_array())
                .collect(),
        ),
        (
            extension_name("SCALE"),
            "VEC3",
            scene
                .log_scales
                .iter()
                .flat_map(|s| s.exp().to_array())
                .collect(),
        ),
        (extension_name("OPACITY"), "SCALAR", opacity),
        (
            extension_name("SH_DEGREE_0_COEF_0"),
            "VEC3",
            flat(&scene.sh_dc),
        ),
    ];
    for degree in 1..=scene.sh_degree {
        let before = rest_len(degree - 1);
        for k in before..rest_len(degree) {
            let values = (0..scene.len())
                .flat_map(|i| scene.rest(i)[k].to_array())
                .collect();
            out.push((
                extension_name(&format!("SH_DEGREE_{degree}_COEF_{}", k - before)),
                "VEC3",
                values,
            ));
        }
    }
    out
}

/// Builds the JSON chunk. The attributes are stored one after the other in the binary chunk.
fn document(
    scene: &Gaussians,
    attributes: &[Attribute],
    up: Vec3,
    frame: &WorldFrame,
    bytes: usize,
) -> Value {
    let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), serde_json::Map::new());
    let mut offset = 0;
    for (k, (name, kind, values)) in attributes.iter().enumerate() {
        let length = 4 * values.len();
        views.push(
            json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": VERTICES }),
        );
        accessors.push(
            json!({ "bufferView": k, "componentType": FLOAT, "count": scene.len(), "type": kind }),
        );
        names.insert(name.clone(), json!(k));
        offset += length;
    }
    // glTF requires the bounds of positions.
    let bound = |by: fn(Vec3, Vec3) -> Vec3| {
        scene
            .means
            .iter()
            .copied()
            .reduce(by)
            .unwrap_or(Vec3::ZERO)
            .to_array()
    };
    accessors[0]["min"] = json!(bound(Vec3::min));
    accessors[0]["max"] = json!(bound(Vec3::max));
    let turn = Quat::from_rotation_arc(up, Vec3::Y);
    let mut node = json!({ "mesh": 0, "rotation": turn.to_array() });
    if !frame.is_identity() {
        node["translation"] = json!((turn.as_dquat() * frame.origin).to_array());
        node["scale"] = json!([frame.scale, frame.scale, frame.scale]);
    }
    let kernel = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
    json!({
        "asset": { "version": "2.0", "generator": concat!("FastLGS ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{
            "attributes": names,
            "mode": POINTS,
            "extensions": { "KHR_gaussian_splatting": kernel },
        }] }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": bytes }],
    })
}

/// Writes a scene as binary glTF. The node rotates `up`, a unit vector in world coordinates, to +y
/// and applies the scene's `frame`.
///
/// # Errors
/// [`crate::Error::Invalid`] for an empty scene and above the format's limit of 4 GiB;
/// [`Error::Io`] with the path.
pub fn write(path: &Path, scene: &Gaussians, up: Vec3, frame: &WorldFrame) -> Result<()> {
    let attributes = attributes(scene);
    let bytes: usize = attributes.iter().map(|a| 4 * a.2.len()).sum();
    let mut text = document(scene, &attributes, up, frame, bytes).to_string();
    text.extend(std::iter::repeat_n(
        ' ',
        text.len().next_multiple_of(4) - text.len(),
    ));
    let total = u32::try_from(12 + 8 + text.len() + 8 + bytes)
        .ok()
        .filter(|_| !scene.is_empty());
    let Some(total) = total else {
        let reason = format!(
            "{}: {} Gaussians cannot be written as one glTF file; use .ply",
            path.display(),
            scene.len()
        );
        return Err(crate::Error::Invalid(reason));
    };
    fs::write_atomic(path, |file| {
        for word in [MAGIC, VERSION, total, text.len() as u32, JSON_CHUNK] {
            file.write_all(&word.to_le_bytes())?;
        }
        file.write_all(text.as_bytes())?;
        file.write_all(&(bytes as u32).to_le_bytes())?;
        file.write_all(&BINARY_CHUNK.to_le_bytes())?;
        for (_, _, values) in &attributes {
            values
                .iter()
                .try_for_each(|v| file.write_all(&v.to_le_bytes()))?;
        }
        Ok(())
    })
}

/// Returns the JSON document and the binary chunk of a binary glTF file.
fn chunks<'a>(path: &Path, data: &'a [u8]) -> Result<(Value, &'a [u8])> {
    let bad = |reason: &str| Error::format(path, format!("{reason}; copy or export it again"));
    let word = |at: usize| {
        data.get(at..at + 4)
            .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize)
    };
    let (Some(magic), Some(length)) = (word(0), word(12)) else {
        return Err(bad("not a complete glTF file"));
    };
    if magic != MAGIC as usize {
        return Err(bad("not a binary glTF file"));
    }
    let text = data
        .get(20..20usize.saturating_add(length))
        .ok_or_else(|| bad("its JSON chunk is cut off"))?;
    let document = serde_json::from_slice(text)
        .map_err(|e| bad(&format!("its JSON chunk cannot be parsed ({e})")))?;
    Ok((document, data.get(20 + length + 8..).unwrap_or_default()))
}

/// Attributes of the first mesh of Gaussians in a document.
struct Attributes<'a> {
    path: &'a Path,
    document: &'a Value,
    /// The binary chunk.
    body: &'a [u8],
    /// Accessor of each attribute.
    accessors: &'a Value,
}

impl<'a> Attributes<'a> {
    fn find(path: &'a Path, document: &'a Value, body: &'a [u8]) -> Result<Self> {
        let meshes = document["meshes"].as_array().into_iter().flatten();
        let mut primitives = meshes
            .flat_map(|mesh| mesh["primitives"].as_array())
            .flatten();
        let has_gaussians =
            |primitive: &&Value| primitive["extensions"]["KHR_gaussian_splatting"].is_object();
        let primitive = primitives.find(has_gaussians).ok_or_else(|| {
            Error::format(path, "it has no mesh of Gaussians (KHR_gaussian_splatting)")
        })?;
        Ok(Self {
            path,
            document,
            body,
            accessors: &primitive["attributes"],
        })
    }

    /// Returns the values of an attribute with `width` floats for each Gaussian, if it has one.
    fn values(&self, name: &str, width: usize) -> Result<Option<Vec<f32>>> {
        let bad = |reason: String| Error::format(self.path, reason);
        let Some(accessor) = self.accessors[name].as_u64() else {
            return Ok(None);
        };
        let accessor = &self.document["accessors"][accessor as usize];
        if accessor["componentType"] != FLOAT {
            return Err(bad(format!(
                "{name} is not stored as floats; export it uncompressed"
            )));
        }
        let view = accessor["bufferView"].as_u64().unwrap_or(u64::MAX) as usize;
        let view = &self.document["bufferViews"][view];
        let offset = |value: &Value| value["byteOffset"].as_u64().unwrap_or(0) as usize;
        let start = offset(view).saturating_add(offset(accessor));
        let stride = view["byteStride"].as_u64().unwrap_or(0) as usize;
        let stride = stride.max(4 * width);
        let row = |i: usize| {
            let at = i.checked_mul(stride)?.checked_add(start)?;
            self.body.get(at..at.checked_add(4 * width)?)
        };
        let mut values = Vec::new();
        for i in 0..accessor["count"].as_u64().unwrap_or(0) as usize {
            let row =
                row(i).ok_or_else(|| bad(format!("{name} is cut off; copy the file again")))?;
            let floats = row.chunks_exact(4);
            values.extend(floats.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
        }
        Ok(Some(values))
    }

    /// Returns the values of an attribute of the extension, if it has one.
    fn extension(&self, name: &str, width: usize) -> Result<Option<Vec<f32>>> {
        self.values(&format!("KHR_gaussian_splatting:{name}"), width)
    }

    /// Returns the values of an attribute that every file has.
    fn required(&self, name: &str, values: Result<Option<Vec<f32>>>) -> Result<Vec<f32>> {
        values?.ok_or_else(|| {
            let reason = format!("its Gaussians have no attribute {name}; export it again");
            Error::format(self.path, reason)
        })
    }

    fn required_extension(&self, name: &str, width: usize) -> Result<Vec<f32>> {
        self.required(name, self.extension(name, width))
    }

    /// Returns the SH degree, and for each coefficient above degree 0 its values of all Gaussians.
    fn harmonics(&self) -> Result<(u32, Vec<Vec<Vec3>>)> {
        let (mut sh_degree, mut coefficients) = (0, Vec::new());
        for degree in 1..=MAX_SH_DEGREE {
            let count = rest_len(degree) - rest_len(degree - 1);
            let found = (0..count)
                .map(|k| self.extension(&format!("SH_DEGREE_{degree}_COEF_{k}"), 3))
                .collect::<Result<Option<Vec<_>>>>()?;
            let Some(found) = found else { break };
            coefficients.extend(found.iter().map(|values| vec3(values)));
            sh_degree = degree;
        }
        Ok((sh_degree, coefficients))
    }
}

fn vec3(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}

/// Reads the first mesh of Gaussians in a binary glTF file. Features are zero and object ids 0.
///
/// Node transforms are ignored in files of FastLGS, which are in scene coordinates. Transforms in
/// files of other programs are an error.
///
/// # Errors
/// [`Error::Format`] for other content and damaged files.
pub fn read(path: &Path) -> Result<Gaussians> {
    let data = fs::read(path)?;
    let (document, body) = chunks(path, &data)?;
    check_transforms(path, &document)?;
    let attributes = Attributes::find(path, &document, body)?;
    let means = attributes.required("POSITION", attributes.values("POSITION", 3))?;
    let means = vec3(&means);
    let n = means.len();
    let (sh_degree, coefficients) = attributes.harmonics()?;
    let scales = vec3(&attributes.required_extension("SCALE", 3)?);
    let rotations = attributes.required_extension("ROTATION", 4)?;
    let opacities = attributes.required_extension("OPACITY", 1)?;
    let colors = attributes.required_extension("SH_DEGREE_0_COEF_0", 3)?;
    let of_gaussian = |i: usize| {
        coefficients
            .iter()
            .map(move |values| values.get(i).copied().unwrap_or_default())
    };
    let scene = Gaussians {
        log_scales: scales.into_iter().map(|s| s.map(f32::ln)).collect(),
        rotations: rotations
            .chunks_exact(4)
            .map(|q| [q[3], q[0], q[1], q[2]])
            .collect(),
        opacity_logits: opacities
            .into_iter()
            .map(|o| logit(o.clamp(0.001, 0.999)))
            .collect(),
        sh_dc: vec3(&colors),
        sh_degree,
        sh_rest: (0..n).flat_map(of_gaussian).collect(),
        features: vec![Vec3::ZERO; n],
        object_ids: vec![0; n],
        means,
    };
    let lengths = [
        scene.log_scales.len(),
        scene.rotations.len(),
        scene.opacity_logits.len(),
        scene.sh_dc.len(),
    ];
    if lengths.iter().any(|length| *length != n) {
        let reason = format!(
            "its attributes have {lengths:?} values, but it has {n} positions; export it again"
        );
        return Err(Error::format(path, reason));
    }
    Ok(scene)
}

/// Refuses node transforms in files of other programs.
fn check_transforms(path: &Path, document: &Value) -> Result<()> {
    let generator = document["asset"]["generator"].as_str();
    let is_ours = generator.is_some_and(|name| name.starts_with("FastLGS"));
    let transforms = |node: &Value| {
        ["matrix", "rotation", "translation", "scale"]
            .iter()
            .any(|part| !node[*part].is_null())
    };
    let mut nodes = document["nodes"].as_array().into_iter().flatten();
    if !is_ours && nodes.any(transforms) {
        return Err(Error::format(
            path,
            "a node transforms its Gaussians; apply the transforms in the program that wrote it and export it again",
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(data: &[u8], at: usize) -> usize {
        u32::from_le_bytes(data[at..at + 4].try_into().unwrap()) as usize
    }

    #[test]
    fn written_files_follow_the_specification_and_round_trip() {
        let mut scene = Gaussians::default();
        scene.push_sphere(Vec3::new(1.0, 2.0, 3.0), 0.25, 0.75, [1.0, 0.5, 0.0]);
        scene.push_sphere(Vec3::new(-1.0, 0.0, 5.0), 0.5, 0.5, [0.2; 3]);
        let mut scene = scene.with_sh_degree(2);
        scene
            .sh_rest
            .iter_mut()
            .enumerate()
            .for_each(|(k, v)| *v = Vec3::splat(k as f32));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.glb");
        write(&path, &scene, Vec3::NEG_Y, &WorldFrame::default()).unwrap();
        let data = std::fs::read(&path).unwrap();
        assert_eq!(
            (word(&data, 0), word(&data, 4), word(&data, 8)),
            (MAGIC as usize, 2, data.len())
        );
        let length = word(&data, 12);
        assert!(length.is_multiple_of(4));
        let document: Value = serde_json::from_slice(&data[20..20 + length]).unwrap();
        let body = &data[20 + length + 8..];
        assert_eq!(word(&data, 20 + length), body.len());
        assert_eq!(document["buffers"][0]["byteLength"], body.len());

        // Required by the schema of the ratified extension.
        let primitive = &document["meshes"][0]["primitives"][0];
        let extension = &primitive["extensions"]["KHR_gaussian_splatting"];
        assert_eq!(
            (&primitive["mode"], &extension["kernel"]),
            (&json!(POINTS), &json!("ellipse"))
        );
        assert!(
            ["srgb_rec709_display", "lin_rec709_display"]
                .iter()
                .any(|space| extension["colorSpace"] == *space)
        );
        assert!(
            ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"]
                .iter()
                .all(|name| {
                    primitive["attributes"][format!("KHR_gaussian_splatting:{name}")].is_u64()
                })
        );
        let names = &primitive["attributes"];
        let values = |name: &str, width: usize| -> Vec<f32> {
            let accessor = &document["accessors"][names[name].as_u64().unwrap() as usize];
            let view = &document["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
            let at = view["byteOffset"].as_u64().unwrap() as usize;
            assert_eq!(view["byteLength"], 4 * width * 2);
            body[at..at + 4 * width * 2]
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
                .collect()
        };
        assert_eq!(values("POSITION", 3), [1.0, 2.0, 3.0, -1.0, 0.0, 5.0]);
        assert_eq!(document["accessors"][0]["min"], json!([-1.0, 0.0, 3.0]));
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(close(
            &values("KHR_gaussian_splatting:SCALE", 3),
            &[0.25, 0.25, 0.25, 0.5, 0.5, 0.5]
        ));
        assert!(close(
            &values("KHR_gaussian_splatting:OPACITY", 1),
            &[0.75, 0.5]
        ));
        assert!(close(
            &values("KHR_gaussian_splatting:ROTATION", 4),
            &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        ));
        assert!(close(
            &values("COLOR_0", 4),
            &[1.0, 0.5, 0.0, 0.75, 0.2, 0.2, 0.2, 0.5]
        ));
        // The last coefficient of degree 2 has index 7 in the first Gaussian and 15 in the second.
        assert!(close(
            &values("KHR_gaussian_splatting:SH_DEGREE_2_COEF_4", 3),
            &[7.0, 7.0, 7.0, 15.0, 15.0, 15.0]
        ));
        assert!(
            names
                .get("KHR_gaussian_splatting:SH_DEGREE_3_COEF_0")
                .is_none()
        );
        let back = read(&path).unwrap();
        assert_eq!(
            (back.sh_degree, &back.sh_rest, &back.means),
            (2, &scene.sh_rest, &scene.means)
        );
        assert!(
            back.log_scales
                .iter()
                .zip(&scene.log_scales)
                .all(|(a, b)| a.distance(*b) < 1e-5)
        );
        assert!(
            back.opacity_logits
                .iter()
                .zip(&scene.opacity_logits)
                .all(|(a, b)| (a - b).abs() < 1e-4)
        );
        std::fs::write(&path, &data[..data.len() - 9]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("cut off"));
        // With a frame, the node moves the scene to its world position.
        let frame = WorldFrame {
            origin: glam::DVec3::new(512_345.6, 5_403_210.9, 431.2),
            scale: 2.0,
        };
        write(&path, &scene, Vec3::Y, &frame).unwrap();
        let data = std::fs::read(&path).unwrap();
        let document: Value = serde_json::from_slice(&data[20..20 + word(&data, 12)]).unwrap();
        assert_eq!(
            (
                &document["nodes"][0]["translation"],
                &document["nodes"][0]["scale"]
            ),
            (&json!(frame.origin.to_array()), &json!([2.0, 2.0, 2.0]))
        );
        assert!(
            write(
                &path,
                &Gaussians::default(),
                Vec3::Y,
                &WorldFrame::default()
            )
            .is_err()
        );
    }
}
