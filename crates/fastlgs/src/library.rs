//! Which scenes of a folder hold what a text names.

use crate::error::{Context, bail};
use crate::session::Texts;
use crate::session::ask::Embedded;
use crate::{Result, Run, eyes, train};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::library::{self, Entry, Found, Library};
use fastlgs_grid::query::{self, QueryConfig};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::{Instant, UNIX_EPOCH};

/// The index of a library, in its folder.
const INDEX: &str = "library.index";
/// How deep below the library's folder scenes are looked for.
const DEPTH: usize = 3;

/// What is asked of a library, beside the text.
#[derive(Clone, Debug)]
pub struct Config {
    /// Most scenes that are named.
    pub scenes: usize,
    /// Share of the names of absent things that a scene may answer all the same.
    pub false_alarms: f32,
    /// Texts that the object must not be nearer to.
    pub negatives: Vec<String>,
    /// A CLIP text tower in place of the one that the scenes remember.
    pub clip_text: Option<PathBuf>,
}

/// An opened library with the encoder of its texts.
pub struct Search {
    root: PathBuf,
    config: Config,
    texts: Texts,
    index: Library,
    skipped: Vec<Skipped>,
    index_ms: f64,
}

/// What a library answers.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// The text.
    pub text: String,
    /// Whether any scene holds it.
    pub found: bool,
    /// The best scenes, those first that hold it best.
    pub scenes: Vec<Row>,
    /// How much was searched.
    pub searched: Searched,
    /// Scenes that were passed over.
    pub skipped: Vec<Skipped>,
    /// Where the time went.
    pub ms: Milliseconds,
}

/// A scene of an answer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    /// Its path below the library.
    pub scene: String,
    /// Its best object.
    pub object: u16,
    /// Score of the object that is most like what is asked for, by which the scene has it or not.
    pub score: f32,
    /// How well the views' masks fit it.
    pub support: f32,
    /// Whether it counts as found.
    pub found: bool,
}

/// How much was searched.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Searched {
    /// Scenes.
    pub scenes: usize,
    /// Their objects.
    pub objects: usize,
}

/// A scene that was passed over.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Skipped {
    /// Its path below the library.
    pub scene: String,
    /// The reason.
    pub why: String,
}

/// Milliseconds of an answer.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Milliseconds {
    /// Opening the index, or making it.
    pub index: f64,
    /// Embedding the text.
    pub encode: f64,
    /// Comparing it.
    pub search: f64,
}

impl Search {
    /// Opens all trained scenes of one encoder below `root`, and makes their index anew where that is out of date.
    ///
    /// # Errors
    /// A folder without trained scenes, or one that cannot be read or written.
    pub fn open(root: &Path, config: Config, run: &Run) -> Result<Self> {
        let started = Instant::now();
        let (scenes, skipped) = scenes_below(root)?;
        for row in &skipped {
            run.warn(&format!("{}: left out: {}", row.scene, row.why));
        }
        let Some((first, manifest)) = scenes.first() else { bail!("{}: no trained scenes are in it", root.display()) };
        let first_folder = SceneFolder::new(root.join(&first.path));
        let index = up_to_date(root, &scenes, run)?;
        let index_ms = started.elapsed().as_secs_f64() * 1e3;
        let texts = Texts::load(&first_folder, manifest, config.clip_text.as_deref())?;
        let search = Self { root: root.to_owned(), config, texts, index, skipped, index_ms };
        search.ask("warm up")?;
        Ok(search)
    }

    /// The scenes that hold what `text` names.
    ///
    /// # Errors
    /// A text that cannot be embedded.
    pub fn ask(&self, text: &str) -> Result<Report> {
        let started = Instant::now();
        let meant = Embedded::words(text, &self.texts, &self.config.negatives)?;
        let encode_ms = started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let mut best: Vec<Found> = Vec::new();
        for query in meant.sought() {
            let found = self.index.search(query, self.config.scenes)?;
            best.extend(found.into_iter().filter(|f| best.iter().all(|known| known.scene != f.scene)).collect::<Vec<_>>());
        }
        let search_ms = started.elapsed().as_secs_f64() * 1e3;
        let config = QueryConfig { false_alarms: self.config.false_alarms, ..QueryConfig::default() };
        // As the scene itself would answer.
        let row = |f: &Found| -> Result<Row> {
            let scene = self.index.scenes[f.scene].path.clone();
            let grid = Grid::load(&SceneFolder::new(self.root.join(&scene)))?;
            let answer = meant.find(&grid, &config);
            let object = answer.targets.first().or(answer.ranked.first()).map_or(f.object, |hit| hit.id);
            let (support, score) = (grid.objects[usize::from(object) - 1].support, query::best_score(&answer.ranked));
            Ok(Row { scene, object, score, support, found: !answer.targets.is_empty() })
        };
        let mut rows = best.iter().map(row).collect::<Result<Vec<Row>>>()?;
        rows.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.scene.cmp(&b.scene)));
        rows.truncate(self.config.scenes);
        Ok(Report {
            text: text.to_owned(),
            found: rows.iter().any(|r| r.found),
            scenes: rows,
            searched: Searched { scenes: self.index.scenes.len(), objects: self.index.len() },
            skipped: self.skipped.clone(),
            ms: Milliseconds { index: self.index_ms, encode: encode_ms, search: search_ms },
        })
    }
}

/// A scene of a library with what made it.
type Scene = (Entry, Manifest);

/// Trained scenes of one encoder below a folder, sorted by path, with the stamp of their tables; and what was passed over, with why.
fn scenes_below(root: &Path) -> Result<(Vec<Scene>, Vec<Skipped>)> {
    let mut folders = Vec::new();
    collect(root, DEPTH, &mut folders)?;
    folders.sort();
    let (mut scenes, mut skipped): (Vec<Scene>, Vec<Skipped>) = (Vec::new(), Vec::new());
    for folder in folders {
        let path = folder.strip_prefix(root).unwrap_or(&folder).to_string_lossy().into_owned();
        let manifest = SceneFolder::new(&folder).manifest();
        let why = match &manifest {
            Err(error) => Some(error.to_string()),
            Ok(own) => match train::Report::of(own, &folder) {
                Err(error) => Some(error.to_string()),
                Ok(None) => Some("it was never trained".to_owned()),
                Ok(Some(_)) => {
                    scenes.first().map(|s| &s.1).filter(|first| eyes::identity_of(first) != eyes::identity_of(own)).map(|first| {
                        let [own, first] = [own, first].map(|m| [m.encoder.as_str(), m.crops.as_str()].join(" ").trim_end().to_owned());
                        format!(
                            "its encoder is another ('{own}') than that of the library ('{first}'); preprocess and train it again with that"
                        )
                    })
                }
            },
        };
        match (why, manifest, stamp(&folder)) {
            (None, Ok(manifest), Ok(stamp)) => scenes.push((Entry { path, stamp }, manifest)),
            (None, _, Err(error)) => skipped.push(Skipped { scene: path, why: error.to_string() }),
            (why, ..) => skipped.push(Skipped { scene: path, why: why.unwrap_or_default() }),
        }
    }
    Ok((scenes, skipped))
}

fn collect(folder: &Path, depth: usize, out: &mut Vec<PathBuf>) -> Result<()> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("{}: the library's folder cannot be read", folder.display()))?;
    for entry in entries {
        let entry = entry?;
        let path = entry.path();
        // Scenes may be linked; names with a dot are of what is not finished.
        if !path.is_dir() || entry.file_name().to_string_lossy().starts_with('.') {
            continue;
        }
        if path.join("scene.json").is_file() {
            out.push(path);
        } else if depth > 1
            && let Err(error) = collect(&path, depth - 1, out)
        {
            tracing::warn!("{error}");
        }
    }
    Ok(())
}

/// Length and time of change of a scene's table.
fn stamp(folder: &Path) -> Result<String> {
    let one = |name: &str| -> Result<String> {
        let path = folder.join(name);
        let data = std::fs::metadata(&path).with_context(|| format!("{}: the scene has no table; train it again", path.display()))?;
        let changed = data.modified()?.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        Ok(format!("{}@{changed}", data.len()))
    };
    Ok(format!("{} {}", one("grid.json")?, one("grid.safetensors")?))
}

/// The library's index, made anew where a scene came, went or changed.
fn up_to_date(root: &Path, scenes: &[Scene], run: &Run) -> Result<Library> {
    let path = root.join(INDEX);
    let entries: Vec<&Entry> = scenes.iter().map(|s| &s.0).collect();
    if path.is_file() {
        match Library::open(&path) {
            Ok(library) if library.scenes.iter().eq(entries.iter().copied()) => return Ok(library),
            Ok(_) => tracing::info!("{}: scenes have changed; it is made anew", path.display()),
            Err(error) => tracing::warn!("{error}; doing that now"),
        }
    }
    let work = run.work("library", entries.len() as u64);
    let load = |(entry, manifest): &Scene| -> Result<(Entry, Grid)> {
        work.advance()?;
        let folder = SceneFolder::new(root.join(&entry.path));
        let grid = Grid::load(&folder).with_context(|| format!("{}: its table cannot be read; train it again", entry.path))?;
        eyes::check_version(manifest, &grid, &folder)?;
        Ok((entry.clone(), grid))
    };
    let tables = scenes.iter().map(load).collect::<Result<Vec<_>>>()?;
    if let Err(error) = library::write(&path, &tables) {
        // Where the folder may only be read, it is made in each run anew.
        tracing::info!("{}: the index cannot be kept: {error}", path.display());
        let folder = tempfile::tempdir()?;
        let path = folder.path().join(INDEX);
        library::write(&path, &tables).context("the library's index cannot be written")?;
        // What is open can be read when its folder is gone.
        return Ok(Library::open(&path)?);
    }
    Ok(Library::open(&path)?)
}
