//! A trained scene for other programs, or a small folder with just what a query needs.

use crate::compared::Compared;
use crate::error::{Context, bail};
use crate::output::SceneLock;
use crate::session::selection;
use crate::staged::StagedOutput;
use crate::{Result, Run, Session, train};
use fastlgs_core::compact::{self, Precision};
use fastlgs_core::metrics::psnr;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, camera_path, splat_file};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What is exported, and to where.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Config {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// FILE.ply (3DGS columns), FILE.spz or FILE.sog (compressed, without objects), FILE.glb (glTF with KHR_gaussian_splatting), FILE.json (the
    /// views as a camera path of nerfstudio's form), or a folder for everything that queries need.
    pub output: PathBuf,
    /// Drop colour's SH coefficients above this degree.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(0..=3)))]
    pub sh_degree: Option<u32>,
}

/// What was written.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Report {
    /// A scene.
    Scene(Box<SceneReport>),
    /// The views as a camera path.
    Path {
        /// The scene.
        scene: PathBuf,
        /// The file.
        output: PathBuf,
        /// Its frames.
        frames: usize,
    },
}

/// A scene that was written, and what that cost.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneReport {
    /// The scene.
    pub scene: PathBuf,
    /// File or folder.
    pub output: PathBuf,
    /// Bytes of what was written.
    pub bytes: u64,
    /// Bytes of everything that queries of the scene need.
    pub bytes_before: u64,
    /// Gaussians.
    pub gaussians: usize,
    /// SH degree of colour.
    pub sh_degree: u32,
    /// Bytes of each value, by group, of a small folder.
    pub bytes_a_value: Option<BTreeMap<String, u8>>,
    /// Mean PSNR of the held-out views against their photos in dB, where these are there.
    pub psnr_held_out: Loss,
    /// Mean PSNR of what was written against the scene in dB.
    pub psnr_against_original: f64,
    /// The device's name.
    pub adapter: String,
}

/// A figure before and after.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Loss {
    /// Of the scene.
    pub before: Option<f64>,
    /// Of what was written.
    pub after: Option<f64>,
}

/// Training views that the precision of the small folder is tried on.
const PRECISION_VIEWS: usize = 4;
/// What each group of values may lose there, in dB.
const PRECISION_LOSS: f64 = 0.01;

/// All that a small folder has, beside the manifest.
const LEFT: [&str; 4] = ["scene.safetensors", "grid.json", "grid.safetensors", "cameras"];

/// Whether a folder is meant, whatever the ending of its name.
pub fn names_folder(path: &Path) -> bool {
    path.as_os_str().to_string_lossy().ends_with(std::path::MAIN_SEPARATOR) || path.is_dir()
}

/// Writes a trained scene for other programs.
///
/// # Errors
/// A scene that was never trained, a place that cannot be written, or a device that fails.
pub fn export(config: &Config, run: &Run) -> Result<Report> {
    if config.output.extension().is_some_and(|e| e == "json") {
        let folder = SceneFolder::open(&config.scene)?;
        let cameras = folder.cameras()?;
        camera_path::write(&config.output, &cameras, &folder.manifest()?.frame)?;
        return Ok(Report::Path { scene: config.scene.clone(), output: config.output.clone(), frames: cameras.len() });
    }
    let ending = config.output.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let folder = names_folder(&config.output);
    let file = !folder && selection::ENDINGS.contains(&ending);
    if !folder && !file && !ending.is_empty() {
        let path = config.output.display();
        bail!(
            "{path}: nothing is written as .{ending}; there are .ply, .spz, .sog, .glb and .json, and folders, whose names have no ending or end with /"
        );
    }
    let mut scene = Session::open(&config.scene, run.device)?;
    let held_out = scene.manifest.held_out(&scene.cameras);
    // Also where none is held out, a picture tells what writing has cost.
    let shown = if held_out.is_empty() { scene.cameras.iter().take(1).cloned().collect() } else { held_out.clone() };
    let before = pictures(&mut scene, &shown)?;
    let degree = config.sh_degree.unwrap_or(scene.gaussians.sh_degree).min(scene.gaussians.sh_degree);
    if degree < scene.gaussians.sh_degree {
        scene.show(scene.gaussians.clone().with_sh_degree(degree))?;
    }
    let (written, precision) = if file {
        let world = selection::World::of(&scene.manifest, &scene.cameras);
        selection::write(&config.output, &scene.gaussians, &world)?;
        let written = match ending {
            // It holds the same floats as before.
            "glb" => scene.gaussians.clone(),
            _ => splat_file::read(&config.output, &world.frame)?.0,
        };
        (written, None)
    } else {
        let (written, precision) = small_folder(&mut scene, &config.output)?;
        (written, Some(precision.by_group().into_iter().map(|(group, bytes)| (group.to_owned(), bytes)).collect()))
    };
    scene.show(written)?;
    let after = pictures(&mut scene, &shown)?;
    // Both against each other, not against photos: an exported scene may have none.
    let same: Vec<f64> = before.iter().zip(&after).map(|(a, b)| psnr(b, a)).collect();
    Ok(Report::Scene(Box::new(SceneReport {
        scene: config.scene.clone(),
        output: config.output.clone(),
        bytes: bytes_of(&config.output),
        bytes_before: crate::session::bytes(&config.scene),
        gaussians: scene.gaussians.len(),
        sh_degree: scene.gaussians.sh_degree,
        bytes_a_value: precision,
        psnr_held_out: Loss { before: against_photos(&scene, &held_out, &before)?, after: against_photos(&scene, &held_out, &after)? },
        psnr_against_original: same.iter().sum::<f64>() / same.len().max(1) as f64,
        adapter: scene.engine.name(),
    })))
}

/// Colours of these views.
fn pictures(scene: &mut Session, views: &[Camera]) -> Result<Vec<Vec<f32>>> {
    views.iter().map(|camera| Ok(scene.render(camera)?.channels(0, 3).to_vec())).collect()
}

/// Whether the photos of all these views are there: an exported scene has none.
fn have_photos(scene: &Session, views: &[Camera]) -> bool {
    views.iter().all(|view| scene.folder.photo_path(&view.name).is_file())
}

/// Mean PSNR against the photos, as far as these count; nothing where the scene has them no more.
fn against_photos(scene: &Session, views: &[Camera], pictures: &[Vec<f32>]) -> Result<Option<f64>> {
    if !have_photos(scene, views) {
        return Ok(None);
    }
    let background = train::Background { color: scene.trained.background, learn: false };
    let mut each = Vec::new();
    for (camera, picture) in views.iter().zip(pictures) {
        let target = train::target(&scene.folder, camera, None, &background)?;
        each.extend(Compared::of(&target, picture).map(|compared| compared.psnr()));
    }
    Ok((!each.is_empty()).then(|| each.iter().sum::<f64>() / each.len() as f64))
}

/// The precision that some training views show to be enough; the default where they have no photos.
fn precision(scene: &mut Session) -> Result<Precision> {
    let training = scene.manifest.training(&scene.cameras);
    let views: Vec<Camera> = training.iter().step_by(training.len().div_ceil(PRECISION_VIEWS).max(1)).cloned().collect();
    let original = scene.gaussians.clone();
    let before = pictures(scene, &views)?;
    if against_photos(scene, &views, &before)?.is_none() {
        return Ok(Precision::default());
    }
    let chosen = Precision::choose(&original, PRECISION_LOSS, |gaussians| {
        scene.show(gaussians.clone())?;
        let pictures = pictures(scene, &views)?;
        against_photos(scene, &views, &pictures)?.context("the scene's photos are there no more; run 'fastlgs preprocess' again")
    })?;
    scene.show(original)?;
    Ok(chosen)
}

/// Writes what queries need: the compact scene, grid, cameras and manifest. Returns the scene as it reads.
fn small_folder(scene: &mut Session, root: &Path) -> Result<(Gaussians, Precision)> {
    if std::fs::canonicalize(root).ok() == std::fs::canonicalize(&scene.folder.root).ok() {
        bail!("{}: this is the scene itself; name another folder", root.display());
    }
    let folder = SceneFolder::new(root);
    let _lock = SceneLock::take(root, "export")?;
    if folder.manifest().is_ok() && !folder.is_compact() {
        bail!("{}: this is a scene that was trained, not an export; name a new folder", root.display());
    }
    let grid = scene.grid()?;
    if scene.gaussians.object_ids.iter().zip(&scene.gaussians.features).any(|(id, f)| grid.code_of(*id) != *f) {
        bail!("the scene's features were trained by descent, which a small folder cannot hold; export FILE.ply instead");
    }
    let precision = precision(scene)?;
    let staged = StagedOutput::new(&folder, "export")?;
    let (kept, dropped) = scene.gaussians.without_far_outliers();
    if dropped > 0 {
        tracing::warn!(
            "{}: {dropped} Gaussians far outside of the scene were left out, as the precision of all would suffer",
            root.display()
        );
    }
    compact::write(&staged.folder.compact_path(), &kept, &precision)?;
    grid.save(&staged.folder)?;
    staged.folder.save_cameras(&scene.cameras)?;
    // The export has none of the scene's other files.
    let manifest = Manifest { files: Default::default(), ..scene.manifest.clone() };
    staged.publish(&folder, &LEFT, [], &manifest)?;
    let mut written = folder.gaussians()?;
    grid.set_codes(&mut written);
    Ok((written, precision))
}

fn bytes_of(path: &Path) -> u64 {
    if path.is_dir() { crate::session::bytes(path) } else { std::fs::metadata(path).map_or(0, |m| m.len()) }
}
