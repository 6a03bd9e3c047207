//! The scene folder: paths, manifest and files that the stages share.

use crate::dataset::SfmPoint;
use crate::{
    Camera, Error, Gaussians, LabelMap, MaskList, Result, WorldFrame, compact, fs, image_io, ply,
};
use image::RgbImage;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Component, Path, PathBuf};

/// File name of the manifest; a folder with it is a scene.
pub const MANIFEST: &str = "scene.json";

/// A model file that was used to make a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelFile {
    /// Path at that time.
    pub path: PathBuf,
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal digits.
    pub sha256: String,
}

/// Manifest of a scene (`scene.json`): its inputs, options and files.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of FastLGS that wrote it.
    pub version: String,
    /// Folder of the input photos.
    pub photos: PathBuf,
    /// Every n-th view in sorted order is held out; 0 holds out none.
    pub holdout: usize,
    /// Views that are held out by name because they have evaluation labels.
    #[serde(default)]
    pub held_out_views: Vec<String>,
    /// Name of the segmenter that made the masks.
    pub segmenter: String,
    /// Name of the encoder that made the embeddings; queries must use the same one.
    pub encoder: String,
    /// Background around masks in the image crops for CLIP; empty for grey.
    #[serde(default)]
    pub crops: String,
    /// Model files by role (`clip_image`, `clip_text`, `sam_encoder`, `sam_decoder`).
    #[serde(default)]
    pub models: BTreeMap<String, ModelFile>,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Warnings about the input that did not stop the run.
    pub warnings: Vec<String>,
    /// Views that are excluded from training because their poses contradict the others.
    #[serde(default)]
    pub excluded: Vec<String>,
    /// Origin and unit of scene coordinates in the world of the input poses.
    #[serde(default, skip_serializing_if = "WorldFrame::is_identity")]
    pub frame: WorldFrame,
    /// Files of the scene, relative to its folder, with '/' as separator. Stages move and remove
    /// only these.
    #[serde(default)]
    pub files: BTreeSet<String>,
    /// Duration of each stage in seconds, by name.
    #[serde(default)]
    pub seconds: BTreeMap<String, f64>,
    /// Notes of later stages, such as preset, adapter and metrics.
    #[serde(default)]
    pub notes: BTreeMap<String, serde_json::Value>,
}

impl Manifest {
    /// Returns the training views in order: neither held out nor excluded.
    pub fn training(&self, cameras: &[Camera]) -> Vec<Camera> {
        let usable = |(i, c): &(usize, &Camera)| {
            !self.is_held_out(*i, &c.name) && !self.excluded.contains(&c.name)
        };
        cameras
            .iter()
            .enumerate()
            .filter(usable)
            .map(|(_, c)| c.clone())
            .collect()
    }

    /// Returns the held-out views in order.
    pub fn held_out(&self, cameras: &[Camera]) -> Vec<Camera> {
        cameras
            .iter()
            .enumerate()
            .filter(|(i, c)| self.is_held_out(*i, &c.name))
            .map(|(_, c)| c.clone())
            .collect()
    }

    /// Returns whether a view is held out. `index` is its position in sorted order.
    pub fn is_held_out(&self, index: usize, name: &str) -> bool {
        is_held_out(index, self.holdout) || self.held_out_views.iter().any(|v| v == name)
    }
}

/// A scene folder on disk. Its methods return paths and read files; nothing is cached.
#[derive(Clone, Debug)]
pub struct SceneFolder {
    /// Path of the folder.
    pub root: PathBuf,
}

impl SceneFolder {
    /// Creates the handle of a folder, which need not exist yet.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// Opens a folder that `preprocess` has finished.
    ///
    /// # Errors
    /// [`Error::Invalid`] without `scene.json`.
    pub fn open(root: &Path) -> Result<Self> {
        let folder = Self::new(root);
        if !folder.manifest_path().is_file() {
            return Err(Error::Invalid(format!(
                "{}: not a scene (no scene.json); run 'fastlgs preprocess' first",
                root.display()
            )));
        }
        Ok(folder)
    }

    fn manifest_path(&self) -> PathBuf {
        self.root.join(MANIFEST)
    }

    /// Returns the path of the trained scene.
    pub fn ply_path(&self) -> PathBuf {
        self.root.join("scene.ply")
    }

    /// Reads `scene.json`.
    ///
    /// # Errors
    /// A missing or damaged file, or a listed file outside the scene folder.
    pub fn manifest(&self) -> Result<Manifest> {
        let manifest: Manifest = fs::read_json(&self.manifest_path())?;
        let leads_out = |file: &&String| {
            !Path::new(file)
                .components()
                .all(|part| matches!(part, Component::Normal(_)))
        };
        match manifest.files.iter().find(leads_out) {
            Some(file) => Err(Error::format(
                self.manifest_path(),
                format!("it lists the file '{file}', which is not inside the scene folder"),
            )),
            None => Ok(manifest),
        }
    }

    /// Writes `scene.json`. This is the last step of a stage.
    ///
    /// # Errors
    /// [`Error::Io`] with the path.
    pub fn save_manifest(&self, manifest: &Manifest) -> Result<()> {
        fs::write_json(&self.manifest_path(), manifest)
    }

    /// Returns the path of the compact scene.
    pub fn compact_path(&self) -> PathBuf {
        self.root.join("scene.safetensors")
    }

    /// Returns whether only the compact file exists. It has no features; they follow from the codes
    /// of the objects.
    pub fn is_compact(&self) -> bool {
        !self.ply_path().is_file() && self.compact_path().is_file()
    }

    /// Reads the trained Gaussians.
    ///
    /// # Errors
    /// When the scene was never trained or its file is damaged.
    pub fn gaussians(&self) -> Result<Gaussians> {
        if self.is_compact() {
            return compact::read(&self.compact_path());
        }
        let path = self.ply_path();
        if !path.is_file() {
            let root = self.root.display();
            return Err(Error::Invalid(format!(
                "{root}: this scene was never trained (no scene.ply); run 'fastlgs train {root}' first"
            )));
        }
        ply::read(&path)
    }

    /// Writes the initial cameras, sorted by name, and removes trained ones.
    ///
    /// # Errors
    /// [`Error::Io`] with the path.
    pub fn save_cameras(&self, cameras: &[Camera]) -> Result<()> {
        fs::write_json(&self.root.join("cameras/cameras.json"), &cameras)?;
        self.save_trained_cameras(None)
    }

    /// Reads the initial cameras, sorted by name.
    ///
    /// # Errors
    /// A missing or damaged file.
    pub fn initial_cameras(&self) -> Result<Vec<Camera>> {
        fs::read_json(&self.root.join("cameras/cameras.json"))
    }

    fn trained_cameras_path(&self) -> PathBuf {
        self.root.join("cameras/trained.json")
    }

    /// Writes the cameras after training. `None` removes the file: training did not move them.
    ///
    /// # Errors
    /// [`Error::Io`] with the path.
    pub fn save_trained_cameras(&self, cameras: Option<&[Camera]>) -> Result<()> {
        let path = self.trained_cameras_path();
        match cameras {
            Some(cameras) => fs::write_json(&path, &cameras),
            None if path.is_file() => std::fs::remove_file(&path).map_err(Error::io(&path)),
            None => Ok(()),
        }
    }

    /// Reads the cameras, sorted by name: the trained ones if they exist, else the initial ones.
    ///
    /// # Errors
    /// A missing or damaged file.
    pub fn cameras(&self) -> Result<Vec<Camera>> {
        let trained = self.trained_cameras_path();
        if trained.is_file() {
            fs::read_json(&trained)
        } else {
            self.initial_cameras()
        }
    }

    /// Finds a view by its file name, or by its name without extension if that is unique.
    ///
    /// # Errors
    /// [`Error::Invalid`] for an unknown name; the message lists the first views.
    pub fn view_index(&self, cameras: &[Camera], name: &str) -> Result<usize> {
        find_view(cameras.iter().map(|c| c.name.as_str()), name).ok_or_else(|| {
            let names: Vec<&str> = cameras.iter().take(6).map(|c| c.name.as_str()).collect();
            let (root, n, names) = (self.root.display(), cameras.len(), names.join(", "));
            Error::NotFound(format!(
                "no view '{name}' in {root}; it has {n} views: {names}, ..."
            ))
        })
    }

    /// Returns the path of a prepared photo.
    pub fn photo_path(&self, view: &str) -> PathBuf {
        self.root.join("photos").join(format!("{view}.png"))
    }

    /// Returns the path of the alpha channel of a prepared photo, if it has one.
    pub fn alpha_path(&self, view: &str) -> PathBuf {
        self.root.join("alpha").join(format!("{view}.png"))
    }

    /// Returns the path of a view's ignore mask. Its black pixels are ignored.
    pub fn ignore_path(&self, view: &str) -> PathBuf {
        self.root.join("ignore").join(format!("{view}.png"))
    }

    /// Reads a prepared photo.
    ///
    /// # Errors
    /// A missing or damaged file.
    pub fn photo(&self, view: &str) -> Result<RgbImage> {
        image_io::load_rgb(&self.photo_path(view))
    }

    /// Returns the path of the segmenter's masks of a view.
    pub fn masks_path(&self, view: &str) -> PathBuf {
        self.root.join("masks").join(format!("{view}.json"))
    }

    /// Reads the segmenter's masks of a view.
    ///
    /// # Errors
    /// A missing or damaged file, or masks of another size than the view's camera.
    pub fn masks(&self, camera: &Camera) -> Result<MaskList> {
        let path = self.masks_path(&camera.name);
        let (width, height) = (camera.width, camera.height);
        if !path.is_file() {
            return Err(Error::Invalid(format!(
                "{} is missing; run 'fastlgs preprocess' again",
                path.display()
            )));
        }
        let list = MaskList::load(&path)?;
        match (list.width, list.height) {
            _ if list.masks.is_empty() => Ok(MaskList::new(width, height)),
            size if size == (width, height) => Ok(list),
            _ => Err(Error::format(
                &path,
                "its size differs from that of the view's camera; run 'fastlgs preprocess' again",
            )),
        }
    }

    /// Returns the path of a view's label map of object ids.
    pub fn objects_path(&self, view: &str) -> PathBuf {
        self.root.join(Self::objects_name(view))
    }

    /// Returns the same path relative to the scene folder, as in the manifest.
    pub fn objects_name(view: &str) -> String {
        format!("masks/objects/{view}.png")
    }

    /// Reads the label map of object ids of a view.
    ///
    /// # Errors
    /// A missing or damaged file.
    pub fn objects(&self, view: &str) -> Result<LabelMap> {
        LabelMap::load(&self.objects_path(view))
    }

    /// Writes the initial points as tensors: `position` `[points][3]`, `color` `[points][3]` from 0
    /// to 255, and `seen` `[pairs][2]`, the indices of a point and of a training view in which it
    /// is visible.
    ///
    /// # Errors
    /// [`Error::Io`] with the path.
    pub fn save_points(&self, points: &[SfmPoint]) -> Result<()> {
        let position: Vec<f32> = points.iter().flat_map(|p| p.position.to_array()).collect();
        let color: Vec<f32> = points.iter().flat_map(|p| p.color.map(f32::from)).collect();
        let seen = points
            .iter()
            .enumerate()
            .flat_map(|(k, p)| p.seen_by.iter().map(move |view| [k as f32, *view as f32]));
        let seen: Vec<f32> = seen.flatten().collect();
        let (shape, pairs) = (vec![points.len(), 3], vec![seen.len() / 2, 2]);
        let tensors: [(&str, Vec<usize>, &[f32]); 3] = [
            ("position", shape.clone(), &position),
            ("color", shape, &color),
            ("seen", pairs, &seen),
        ];
        save_tensors(&self.root.join("points.safetensors"), &tensors)
    }

    /// Reads the initial points.
    ///
    /// # Errors
    /// A missing or damaged file.
    pub fn points(&self) -> Result<Vec<SfmPoint>> {
        let path = self.root.join("points.safetensors");
        let tensors = load_tensors(&path)?;
        let get = |name: &str| {
            tensors
                .get(name)
                .map(|t| t.1.as_slice())
                .unwrap_or_default()
        };
        let rows = get("position")
            .chunks_exact(3)
            .zip(get("color").chunks_exact(3));
        let point = |(p, c): (&[f32], &[f32])| {
            let color = [c[0] as u8, c[1] as u8, c[2] as u8];
            SfmPoint {
                position: glam::Vec3::from_slice(p),
                color,
                seen_by: Vec::new(),
            }
        };
        let mut points: Vec<SfmPoint> = rows.map(point).collect();
        for pair in get("seen").chunks_exact(2) {
            let Some(point) = points.get_mut(pair[0] as usize) else {
                return Err(Error::format(
                    &path,
                    "a view observes a point that does not exist; run 'fastlgs preprocess' again",
                ));
            };
            point.seen_by.push(pair[1] as u32);
        }
        Ok(points)
    }
}

/// Finds a view by its file name, or by its name without extension if that is unique. A '/' in
/// `name` matches the '_' that joins folders in view names.
pub fn find_view<'a>(names: impl Iterator<Item = &'a str> + Clone, name: &str) -> Option<usize> {
    let joined = name.replace('/', "_");
    let name = if names.clone().any(|n| n == name) {
        name
    } else {
        joined.as_str()
    };
    let bare = |n: &&str| Path::new(n).file_stem().is_some_and(|s| s == name);
    let mut stem_matches = names
        .clone()
        .enumerate()
        .filter(|(_, n)| bare(n))
        .map(|(i, _)| i);
    names.clone().position(|n| n == name).or_else(|| {
        stem_matches
            .next()
            .filter(|_| stem_matches.next().is_none())
    })
}

/// Returns whether the view at `index` in sorted order is one of every `holdout` held-out views.
pub fn is_held_out(index: usize, holdout: usize) -> bool {
    holdout > 0 && index.is_multiple_of(holdout)
}

/// Named float tensors: shape and row-major values.
pub type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Writes f32 tensors as safetensors, atomically.
///
/// # Errors
/// [`Error::Io`] with the path, or [`Error::Format`] when a shape does not match its values.
pub fn save_tensors(path: &Path, tensors: &[(&str, Vec<usize>, &[f32])]) -> Result<()> {
    write_tensors(path, tensors, None)
}

/// Metadata key of the encoder in files of embeddings.
const ENCODER: &str = "encoder";

/// As [`save_tensors`], for embeddings. The name of their encoder is written to the file's
/// metadata.
///
/// # Errors
/// As [`save_tensors`].
pub fn save_embeddings(
    path: &Path,
    tensors: &[(&str, Vec<usize>, &[f32])],
    encoder: &str,
) -> Result<()> {
    write_tensors(
        path,
        tensors,
        Some([(ENCODER.to_owned(), encoder.to_owned())].into()),
    )
}

fn write_tensors(
    path: &Path,
    tensors: &[(&str, Vec<usize>, &[f32])],
    metadata: Option<HashMap<String, String>>,
) -> Result<()> {
    let views = tensors.iter().map(|(name, shape, data)| {
        Ok((
            *name,
            TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(data))?,
        ))
    });
    let views: Result<Vec<_>, safetensors::SafeTensorError> = views.collect();
    let data = views
        .and_then(|v| safetensors::serialize(v, metadata))
        .map_err(|e| Error::format(path, format!("cannot write tensors: {e}")))?;
    fs::write_atomic(path, |file| std::io::Write::write_all(file, &data))
}

/// Reads the f32 tensors of a safetensors file.
///
/// # Errors
/// [`Error::Io`], or [`Error::Format`] for damaged files and tensors of another type.
pub fn load_tensors(path: &Path) -> Result<Tensors> {
    parse_tensors(path, &fs::read(path)?)
}

/// As [`load_tensors`], for a file in memory. Errors name `path`.
///
/// # Errors
/// As [`load_tensors`].
pub fn parse_tensors(path: &Path, data: &[u8]) -> Result<Tensors> {
    let file = SafeTensors::deserialize(data)
        .map_err(|e| Error::format(path, format!("not a complete safetensors file: {e}")))?;
    file.tensors()
        .into_iter()
        .map(|(name, view)| {
            if view.dtype() != Dtype::F32 {
                return Err(Error::format(
                    path,
                    format!(
                        "tensor '{name}' has the type {:?}, but 32-bit floats were expected",
                        view.dtype()
                    ),
                ));
            }
            let values = view
                .data()
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
                .collect();
            Ok((name, (view.shape().to_vec(), values)))
        })
        .collect()
}

/// Returns the encoder of the embeddings in a file in memory, as written by [`save_embeddings`].
/// Empty if the metadata do not name it.
///
/// # Errors
/// As [`load_tensors`].
pub fn embedding_encoder(path: &Path, data: &[u8]) -> Result<String> {
    let (_, head) = SafeTensors::read_metadata(data)
        .map_err(|e| Error::format(path, format!("not a complete safetensors file: {e}")))?;
    Ok(head
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get(ENCODER))
        .cloned()
        .unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tensors_round_trip_and_truncation_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.safetensors");
        save_tensors(&path, &[("a", vec![2, 2], &[1.0, 2.0, 3.0, 4.0])]).unwrap();
        assert_eq!(
            load_tensors(&path).unwrap()["a"],
            (vec![2, 2], vec![1.0, 2.0, 3.0, 4.0])
        );
        let data = std::fs::read(&path).unwrap();
        assert_eq!(embedding_encoder(&path, &data).unwrap(), "");
        save_embeddings(&path, &[("a", vec![1], &[1.0])], "offline 3").unwrap();
        let noted = std::fs::read(&path).unwrap();
        assert_eq!(embedding_encoder(&path, &noted).unwrap(), "offline 3");
        assert_eq!(
            load_tensors(&path).unwrap().len(),
            1,
            "metadata are not a tensor"
        );
        std::fs::write(&path, &data[..data.len() - 3]).unwrap();
        assert!(
            load_tensors(&path)
                .unwrap_err()
                .to_string()
                .contains("t.safetensors")
        );
    }

    #[test]
    fn points_round_trip_with_their_views() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let point = |x: f32, seen_by: &[u32]| SfmPoint {
            position: glam::Vec3::X * x,
            color: [1, 2, 255],
            seen_by: seen_by.to_vec(),
        };
        let points = [point(0.5, &[0, 7, 3]), point(-1.0, &[]), point(2.0, &[12])];
        folder.save_points(&points).unwrap();
        assert_eq!(folder.points().unwrap(), points);
        let path = dir.path().join("points.safetensors");
        let one = [0.0f32; 3];
        let earlier: [(&str, Vec<usize>, &[f32]); 2] =
            [("position", vec![1, 3], &one), ("color", vec![1, 3], &one)];
        save_tensors(&path, &earlier).unwrap();
        assert!(
            folder.points().unwrap()[0].seen_by.is_empty(),
            "`seen` is optional"
        );
        save_tensors(&path, &[("seen", vec![1, 2], &[5.0, 0.0])]).unwrap();
        let message = folder.points().unwrap_err().to_string();
        assert!(
            message.contains("points.safetensors") && message.contains("preprocess"),
            "{message}"
        );
    }

    #[test]
    fn every_eighth_view_is_held_out() {
        let held: Vec<usize> = (0..20).filter(|&i| is_held_out(i, 8)).collect();
        assert_eq!(held, [0, 8, 16]);
        assert!(!is_held_out(0, 0));
    }
}
