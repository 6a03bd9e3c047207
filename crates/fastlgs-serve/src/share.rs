//! Exports a scene as a static folder for any web server: the page, the Gaussians, and answers for
//! common words.

use crate::scene_worker::SceneWorker;
use crate::shared::views;
use crate::{page, splats, subject_distance};
use anyhow::{Context, Result, bail};
use fastlgs::Run;
use fastlgs::query::phrase::normalised;
use fastlgs_core::camera::mean_up;
use fastlgs_core::fs::{write_atomic, write_json};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{self, Hit, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use fastlgs_vision::names;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Component, Path, PathBuf};

/// Default number of common words.
pub const DEFAULT_WORDS: usize = 20_000;
/// Number of words that are embedded together.
const BATCH: usize = 256;
/// Number of objects that are stored for each word. `web/files.js` must have the same number.
const CANDIDATES: usize = 8;
/// JPEG quality of the pictures of objects, 1 to 100.
const JPEG_QUALITY: u8 = 80;

/// Options of [`share`].
#[derive(Clone, Debug)]
pub struct ShareConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Output folder.
    pub output: PathBuf,
    /// Largest SH degree to keep; all if `None`.
    pub sh_degree: Option<u32>,
    /// Number of common words to answer.
    pub words: usize,
    /// CLIP text tower, instead of the one that the scene names.
    pub clip_text: Option<PathBuf>,
}

/// Report of [`share`].
#[derive(Clone, Debug, Serialize)]
pub struct ShareReport {
    /// Scene folder.
    pub scene: PathBuf,
    /// Output folder.
    pub output: PathBuf,
    /// Size of the files in bytes.
    pub bytes: u64,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of words that are answered, including taught names.
    pub words: usize,
    /// Number of words that name an object of the scene.
    pub found: usize,
}

/// Writes the folder. Files of an earlier export are replaced when the new ones are complete; other
/// files are kept.
///
/// # Errors
/// The scene cannot be queried, the folder holds something else, or a file cannot be written.
pub fn share(config: &ShareConfig, run: &Run) -> Result<ShareReport> {
    let root = &config.output;
    let listed = exported_files(root);
    let is_export = !listed.is_empty();
    if root.exists()
        && !is_export
        && root
            .read_dir()
            .map_or(true, |mut entries| entries.next().is_some())
    {
        bail!(
            "{}: exists and holds no exported page; choose another folder",
            root.display()
        );
    }
    let mut worker = SceneWorker::new(&config.scene, run.device, config.clip_text.clone())?;
    if let Some(degree) = config.sh_degree {
        let lower = worker
            .scene
            .gaussians()
            .clone()
            .with_sh_degree(degree.min(worker.scene.gaussians().sh_degree));
        worker.scene.set_gaussians(lower)?;
    }
    let parent = std::path::absolute(root)?
        .parent()
        .map(Path::to_owned)
        .context("the output folder has no parent folder")?;
    std::fs::create_dir_all(&parent).with_context(|| parent.display().to_string())?;
    // In the same folder, so that it can be renamed to its final name.
    let partial = tempfile::Builder::new()
        .prefix(".share-")
        .tempdir_in(&parent)
        .with_context(|| parent.display().to_string())?;
    let (words, found) = write_files(partial.path(), &mut worker, config, run)?;
    let size = bytes(partial.path());
    if is_export {
        replace_export(root, &listed, partial.path())?;
    } else {
        let partial = partial.keep();
        make_readable(&partial)?;
        std::fs::rename(&partial, root).with_context(|| root.display().to_string())?;
    }
    Ok(ShareReport {
        scene: config.scene.clone(),
        output: root.clone(),
        bytes: size,
        gaussians: worker.gaussians(),
        words,
        found,
    })
}

/// Replaces the files of an earlier export, `listed`, by those in `partial`. Other files stay: the
/// folder may be a repository.
fn replace_export(root: &Path, listed: &BTreeSet<PathBuf>, partial: &Path) -> Result<()> {
    let made = files_below(partial, Path::new(""))?;
    let is_foreign =
        |path: &PathBuf| path.exists() && !listed.iter().any(|own| root.join(own) == *path);
    if let Some(foreign) = made.iter().map(|file| root.join(file)).find(is_foreign) {
        bail!(
            "{}: this file was not written by FastLGS and would be overwritten; move it, or choose another folder",
            foreign.display()
        );
    }
    for file in &made {
        let place = root.join(file);
        let parent = place.parent().unwrap_or(root);
        std::fs::create_dir_all(parent).with_context(|| parent.display().to_string())?;
        std::fs::rename(partial.join(file), &place).with_context(|| place.display().to_string())?;
    }
    for old in listed.difference(&made) {
        let _ = std::fs::remove_file(root.join(old));
    }
    Ok(())
}

/// First line of `files.txt`. It identifies a folder as an export.
const MARKER: &str = "A scene of FastLGS. Any web server can give out this folder; opened as a file, browsers do not load it.";

/// Returns the files of an earlier export, or nothing if the folder is not an export.
fn exported_files(root: &Path) -> BTreeSet<PathBuf> {
    let text = std::fs::read_to_string(root.join("files.txt")).unwrap_or_default();
    let is_below = |file: &PathBuf| {
        file.components()
            .all(|part| matches!(part, Component::Normal(_)))
    };
    match text.strip_prefix(MARKER) {
        Some(list) => list
            .lines()
            .filter(|line| !line.is_empty())
            .map(PathBuf::from)
            .filter(is_below)
            .collect(),
        None => BTreeSet::new(),
    }
}

/// Returns the paths of all files below `folder`, relative to `root`.
fn files_below(root: &Path, folder: &Path) -> Result<BTreeSet<PathBuf>> {
    let mut found = BTreeSet::new();
    for entry in std::fs::read_dir(root.join(folder))? {
        let entry = entry?;
        let path = folder.join(entry.file_name());
        if entry.path().is_dir() {
            found.extend(files_below(root, &path)?);
        } else {
            found.insert(path);
        }
    }
    Ok(found)
}

/// Makes a folder readable for the web server. Temporary folders are private to their owner.
fn make_readable(folder: &Path) -> Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o755))?;
    }
    let _ = folder;
    Ok(())
}

/// Writes all files. Returns the number of words, and the number of those that name an object.
fn write_files(
    root: &Path,
    worker: &mut SceneWorker,
    config: &ShareConfig,
    run: &Run,
) -> Result<(usize, usize)> {
    let data = root.join("data");
    let (words, rows, found) = words(worker, config.words, run)?;
    write_json(&data.join("words.json"), &words)?;
    write_json(&data.join("names.json"), &worker.scene.taught_names()?)?;
    write(&data.join("words.bin"), &rows)?;
    let cameras = &worker.scene.cameras();
    let focus: Vec<f32> = cameras
        .iter()
        .map(|camera| subject_distance(&worker.scene.gaussians().means, camera))
        .collect();
    let mut views = views(worker.scene.folder(), cameras, &focus)?;
    // Photos are not exported.
    views
        .iter_mut()
        .for_each(|view| view["photo"] = json!(false));
    let scene = config
        .scene
        .canonicalize()
        .unwrap_or_else(|_| config.scene.clone());
    let mut about = worker.description();
    about["name"] = json!(scene.file_name().unwrap_or_default().to_string_lossy());
    about["up"] = json!(mean_up(cameras).to_array());
    about["views"] = json!(views);
    about["trained_here"] = json!(false);
    about["shared"] = json!({ "words": words.len() });
    write_json(&data.join("scene.json"), &about)?;
    write(
        &data.join("splats.bin"),
        &splats::pack(worker.scene.gaussians()),
    )?;
    write_json(&data.join("objects.json"), &worker.objects()?)?;
    write_json(&data.join("objects/names.json"), &worker.object_names()?)?;
    for id in 1..=worker.grid.objects.len() as u16 {
        if let Some(picture) = worker.picture(id)? {
            let mut jpeg = Vec::new();
            picture.write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY))?;
            write(&data.join(format!("objects/{id}/thumbnail.jpg")), &jpeg)?;
        }
        write_json(
            &data.join(format!("objects/{id}/view.json")),
            &json!({ "view": worker.best_view(id)? }),
        )?;
    }
    for (name, content) in page::files() {
        write(&root.join(name), content.as_bytes())?;
    }
    let list = root.join("files.txt");
    write(&list, b"")?;
    let files: String = files_below(root, Path::new(""))?
        .iter()
        .map(|file| format!("{}\n", file.display()))
        .collect();
    write(&list, format!("{MARKER}\n{files}").as_bytes())?;
    Ok((words.len(), found))
}

/// Returns the size of all files below a folder, in bytes.
fn bytes(folder: &Path) -> u64 {
    let entries = folder
        .read_dir()
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    entries
        .map(|path| {
            if path.is_dir() {
                bytes(&path)
            } else {
                path.metadata().map_or(0, |m| m.len())
            }
        })
        .sum()
}

fn write(path: &Path, content: &[u8]) -> Result<()> {
    Ok(write_atomic(path, |file| file.write_all(content))?)
}

/// Returns the words, one [`Row`] for each, and the number of words that name an object.
fn words(worker: &SceneWorker, common: usize, run: &Run) -> Result<(Vec<String>, Vec<u8>, usize)> {
    let taught = worker
        .scene
        .taught_names()?
        .into_iter()
        .map(|name| name.to_lowercase());
    // Removes duplicates: some words differ only by a hyphen.
    let mut seen = BTreeSet::new();
    let known = names::common_words(usize::MAX)?
        .into_iter()
        .map(|word| normalised(&word));
    let known = known
        .filter(|word| !word.is_empty() && seen.insert(word.clone()))
        .take(common);
    let words: BTreeSet<String> = known.chain(taught).collect();
    let mut words: Vec<String> = words.into_iter().collect();
    // Texts of similar length need less padding in a batch.
    words.sort_by_key(|word| (word.split_whitespace().count(), word.len()));
    let work = run.work("words", words.len().div_ceil(BATCH) as u64);
    let (grid, config) = (&worker.grid, QueryConfig::default());
    let mut rows = Vec::new();
    for batch in words.chunks(BATCH) {
        let queries = worker.scene.text_queries(batch)?;
        rows.par_extend(queries.par_iter().map(|query| row(grid, query, &config)));
        work.advance()?;
    }
    let found = rows.iter().filter(|row| row[1] > 0).count();
    Ok((words, rows.into_flattened(), found))
}

/// Answer to a word: best score, number of targets, then [`CANDIDATES`] objects with scores,
/// targets first.
///
/// A score is one byte, 0 to 255 for 0 to 1. An object is a little-endian id of two bytes, 0 for
/// none, and its score.
type Row = [u8; 2 + 3 * CANDIDATES];

fn row(grid: &Grid, query: &TextQuery, config: &QueryConfig) -> Row {
    let ranked = query::rank(grid, query);
    let targets = query::select(grid, &ranked, query, config);
    let byte = |score: f32| (score.clamp(0.0, 1.0) * 255.0).round() as u8;
    let mut row = [0; 2 + 3 * CANDIDATES];
    row[0] = byte(query::best_score(&ranked));
    row[1] = targets.len().min(CANDIDATES) as u8;
    let others = ranked
        .iter()
        .filter(|hit| !targets.iter().any(|m| m.id == hit.id));
    for (place, Hit { id, score }) in row[2..]
        .chunks_exact_mut(3)
        .zip(targets.iter().chain(others))
    {
        place[..2].copy_from_slice(&id.to_le_bytes());
        place[2] = byte(*score);
    }
    row
}
