//! Exports a trained scene as a file for other programs, or as a small folder for queries.

use crate::compared::Compared;
use crate::error::{Context, bail};
use crate::output::SceneLock;
use crate::query::selection;
use crate::staged::StagedOutput;
use crate::{Result, Run, Scene, train};
use fastlgs_core::compact::{self, Precision};
use fastlgs_core::metrics::psnr;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, camera_path, splat_file};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Options of `export`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ExportConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Output file or folder. FILE.ply has 3DGS columns; FILE.spz and FILE.sog are compressed and
    /// have no objects; FILE.glb is glTF with KHR_gaussian_splatting; FILE.json has the views as a
    /// camera path of nerfstudio. A folder has all that queries need.
    pub output: PathBuf,
    /// Drop SH coefficients of colour above this degree.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(0..=3)))]
    pub sh_degree: Option<u32>,
}

/// Report of `export`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ExportReport {
    /// Exported scene.
    Scene(Box<SceneReport>),
    /// Exported camera path.
    Path {
        /// Scene folder.
        scene: PathBuf,
        /// Written file.
        output: PathBuf,
        /// Number of frames.
        frames: usize,
    },
}

/// Report of an exported scene.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneReport {
    /// Scene folder.
    pub scene: PathBuf,
    /// Written file or folder.
    pub output: PathBuf,
    /// Size of the output in bytes.
    pub bytes: u64,
    /// Size of all files of the scene that queries need, in bytes.
    pub bytes_before: u64,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// SH degree of colour.
    pub sh_degree: u32,
    /// Bytes per value of each group in a small folder; `None` for a file.
    pub bytes_a_value: Option<BTreeMap<String, u8>>,
    /// Mean PSNR of the held-out views in dB; `None` if their photos are missing.
    pub psnr_held_out: BeforeAfter,
    /// Mean PSNR of renders of the output against renders of the scene, in dB.
    pub psnr_against_original: f64,
    /// Name of the device.
    pub adapter: String,
}

/// PSNR before and after the export, in dB.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct BeforeAfter {
    /// PSNR of the scene.
    pub before: Option<f64>,
    /// PSNR of the output.
    pub after: Option<f64>,
}

/// Number of training views that decide the precision of a small folder.
const PRECISION_VIEWS: usize = 4;
/// PSNR that each group of values may lose in these views, in dB.
const PRECISION_LOSS: f64 = 0.01;

/// Files and folders of an earlier small folder that the export replaces, besides the manifest.
const REPLACED: [&str; 4] = [
    "scene.safetensors",
    "grid.json",
    "grid.safetensors",
    "cameras",
];

/// Returns whether a path denotes a folder: one exists there, or the path ends with a separator.
pub fn names_folder(path: &Path) -> bool {
    path.as_os_str()
        .to_string_lossy()
        .ends_with(std::path::MAIN_SEPARATOR)
        || path.is_dir()
}

/// Exports a trained scene to `config.output`.
///
/// # Errors
/// A scene that was never trained, an output that cannot be written, or a failing device.
pub fn export(config: &ExportConfig, run: &Run) -> Result<ExportReport> {
    match output_kind(&config.output)? {
        OutputKind::CameraPath => {
            let folder = SceneFolder::open(&config.scene)?;
            let cameras = folder.cameras()?;
            camera_path::write(&config.output, &cameras, &folder.manifest()?.frame)?;
            Ok(ExportReport::Path {
                scene: config.scene.clone(),
                output: config.output.clone(),
                frames: cameras.len(),
            })
        }
        kind => Ok(ExportReport::Scene(Box::new(export_scene(
            config, kind, run,
        )?))),
    }
}

/// What an export writes.
#[derive(PartialEq)]
enum OutputKind {
    /// A JSON file of all cameras.
    CameraPath,
    /// A file of Gaussians, such as .spz.
    Gaussians,
    /// A scene folder with everything that queries need.
    Folder,
}

fn output_kind(path: &Path) -> Result<OutputKind> {
    let ending = path.extension().and_then(|e| e.to_str());
    let ending = ending.unwrap_or_default();
    if ending == "json" {
        Ok(OutputKind::CameraPath)
    } else if names_folder(path) || ending.is_empty() {
        Ok(OutputKind::Folder)
    } else if selection::EXTENSIONS.contains(&ending) {
        Ok(OutputKind::Gaussians)
    } else {
        bail!(
            "{}: the format .{ending} is unknown; use .ply, .spz, .sog, .glb or .json, or name a folder (without extension, or with / at the end)",
            path.display()
        )
    }
}

/// Exports Gaussians or a folder, and compares the result with the scene.
fn export_scene(config: &ExportConfig, kind: OutputKind, run: &Run) -> Result<SceneReport> {
    let mut scene = Scene::open(&config.scene, run.device)?;
    let held_out = scene.manifest().held_out(scene.cameras());
    // Without held-out views, one training view measures the loss.
    let measured_views = if held_out.is_empty() {
        scene.cameras().iter().take(1).cloned().collect()
    } else {
        held_out.clone()
    };
    let before = pictures(&mut scene, &measured_views)?;
    let degree = config
        .sh_degree
        .unwrap_or(scene.gaussians().sh_degree)
        .min(scene.gaussians().sh_degree);
    if degree < scene.gaussians().sh_degree {
        scene.set_gaussians(scene.gaussians().clone().with_sh_degree(degree))?;
    }
    let (written, bytes_a_value) = if kind == OutputKind::Gaussians {
        let world = selection::World::of(scene.manifest(), scene.cameras());
        selection::write(&config.output, scene.gaussians(), &world)?;
        // glTF stores the floats unchanged.
        let written = if config.output.extension().is_some_and(|e| e == "glb") {
            scene.gaussians().clone()
        } else {
            splat_file::read(&config.output, &world.frame)?.0
        };
        (written, None)
    } else {
        let (written, precision) = small_folder(&mut scene, &config.output)?;
        let by_group = precision.by_group().into_iter();
        let by_group = by_group.map(|(group, bytes)| (group.to_owned(), bytes));
        (written, Some(by_group.collect()))
    };
    scene.set_gaussians(written)?;
    let after = pictures(&mut scene, &measured_views)?;
    // Compare renders with renders: an exported scene may have no photos.
    let same: Vec<f64> = before.iter().zip(&after).map(|(a, b)| psnr(b, a)).collect();
    Ok(SceneReport {
        scene: config.scene.clone(),
        output: config.output.clone(),
        bytes: bytes_of(&config.output),
        bytes_before: crate::scene::query_file_bytes(&config.scene),
        gaussians: scene.gaussians().len(),
        sh_degree: scene.gaussians().sh_degree,
        bytes_a_value,
        psnr_held_out: BeforeAfter {
            before: mean_psnr_to_photos(&scene, &held_out, &before)?,
            after: mean_psnr_to_photos(&scene, &held_out, &after)?,
        },
        psnr_against_original: same.iter().sum::<f64>() / same.len().max(1) as f64,
        adapter: scene.adapter(),
    })
}

/// Renders the colours of views, `[3][h][w]` each.
fn pictures(scene: &mut Scene, views: &[Camera]) -> Result<Vec<Vec<f32>>> {
    views
        .iter()
        .map(|camera| Ok(scene.render(camera)?.color().to_vec()))
        .collect()
}

/// Returns whether the photos of all views exist. An exported scene has none.
fn have_photos(scene: &Scene, views: &[Camera]) -> bool {
    views
        .iter()
        .all(|view| scene.folder().photo_path(&view.name).is_file())
}

/// Returns the mean PSNR of renders against photos in dB, over the pixels that count; `None` if
/// photos are missing.
fn mean_psnr_to_photos(
    scene: &Scene,
    views: &[Camera],
    pictures: &[Vec<f32>],
) -> Result<Option<f64>> {
    if !have_photos(scene, views) {
        return Ok(None);
    }
    let background = train::Background {
        color: scene.trained().background,
        learn: false,
    };
    let mut each = Vec::new();
    for (camera, picture) in views.iter().zip(pictures) {
        let target = train::target(scene.folder(), camera, None, &background)?;
        each.extend(Compared::of(&target, picture).map(|compared| compared.psnr()));
    }
    Ok((!each.is_empty()).then(|| each.iter().sum::<f64>() / each.len() as f64))
}

/// Returns the smallest precision at which no group of values costs more than [`PRECISION_LOSS`] in
/// a few training views. Returns the default precision if their photos are missing.
fn precision(scene: &mut Scene) -> Result<Precision> {
    let training = scene.manifest().training(scene.cameras());
    let views: Vec<Camera> = training
        .iter()
        .step_by(training.len().div_ceil(PRECISION_VIEWS).max(1))
        .cloned()
        .collect();
    let original = scene.gaussians().clone();
    let before = pictures(scene, &views)?;
    if mean_psnr_to_photos(scene, &views, &before)?.is_none() {
        return Ok(Precision::default());
    }
    let chosen = Precision::choose(&original, PRECISION_LOSS, |gaussians| {
        scene.set_gaussians(gaussians.clone())?;
        let pictures = pictures(scene, &views)?;
        mean_psnr_to_photos(scene, &views, &pictures)?
            .context("the photos of the scene are missing now; run 'fastlgs preprocess' again")
    })?;
    scene.set_gaussians(original)?;
    Ok(chosen)
}

/// Writes a folder with all that queries need: compact scene, object table, cameras and manifest.
/// Returns the scene as it reads back, and its precision.
///
/// # Errors
/// The folder is a trained scene, or the features of the scene are not the codes of its objects.
fn small_folder(scene: &mut Scene, root: &Path) -> Result<(Gaussians, Precision)> {
    if std::fs::canonicalize(root).ok() == std::fs::canonicalize(&scene.folder().root).ok() {
        bail!(
            "{}: this folder is the scene itself; choose another folder",
            root.display()
        );
    }
    let folder = SceneFolder::new(root);
    let _lock = SceneLock::take(root, "export")?;
    if folder.manifest().is_ok() && !folder.is_compact() {
        bail!(
            "{}: this folder is a trained scene, not an export; choose a new folder",
            root.display()
        );
    }
    let grid = scene.grid()?;
    if scene
        .gaussians()
        .object_ids
        .iter()
        .zip(&scene.gaussians().features)
        .any(|(id, f)| grid.code_of(*id) != *f)
    {
        bail!(
            "the features of the scene were trained by gradient descent, and a small folder cannot store them; export FILE.ply instead"
        );
    }
    let precision = precision(scene)?;
    let staged = StagedOutput::new(&folder, "export")?;
    let (kept, dropped) = scene.gaussians().without_far_outliers();
    if dropped > 0 {
        tracing::warn!(
            "{}: {dropped} Gaussians far outside of the scene were left out, because they would reduce the precision of all others",
            root.display()
        );
    }
    compact::write(&staged.folder.compact_path(), &kept, &precision)?;
    grid.save(&staged.folder)?;
    staged.folder.save_cameras(scene.cameras())?;
    // The export contains no other files of the scene.
    let manifest = Manifest {
        files: Default::default(),
        ..scene.manifest().clone()
    };
    staged.publish(&folder, &REPLACED, [], &manifest)?;
    let mut written = folder.gaussians()?;
    grid.set_codes(&mut written);
    Ok((written, precision))
}

/// Returns the size of a file, or of all files in a scene folder that queries need, in bytes.
fn bytes_of(path: &Path) -> u64 {
    if path.is_dir() {
        crate::scene::query_file_bytes(path)
    } else {
        std::fs::metadata(path).map_or(0, |m| m.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extension_decides_what_is_written() {
        let kind = |path: &str| output_kind(Path::new(path)).map_err(|e| e.to_string());
        assert!(kind("a.json") == Ok(OutputKind::CameraPath));
        assert!(kind("a.spz") == Ok(OutputKind::Gaussians));
        assert!(kind("folder") == Ok(OutputKind::Folder));
        assert!(kind("folder.v2/") == Ok(OutputKind::Folder));
        assert!(kind("a.xyz").is_err_and(|e| e.contains(".xyz")));
    }
}
