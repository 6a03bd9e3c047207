//! Which scenes of a folder hold what a text names.

use crate::error::{Context, bail};
use crate::session::Texts;
use crate::session::ask::Embedded;
use crate::{Result, Run, eyes, train};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::query::{self, QueryConfig};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

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
    config: Config,
    texts: Texts,
    scenes: Vec<Opened>,
    skipped: Vec<Skipped>,
    load_ms: f64,
}

/// The object table of a scene.
struct Opened {
    /// Path below the library's folder.
    path: String,
    grid: Grid,
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
    /// Loading the object tables of all scenes.
    pub load: f64,
    /// Embedding the text.
    pub encode: f64,
    /// Comparing it.
    pub search: f64,
}

impl Search {
    /// Loads the object tables of all trained scenes of one encoder below `root`.
    ///
    /// # Errors
    /// A folder without trained scenes, or a file that cannot be read.
    pub fn open(root: &Path, config: Config, run: &Run) -> Result<Self> {
        let started = Instant::now();
        let (trained, skipped) = scenes_below(root)?;
        for row in &skipped {
            run.warn(&format!("{}: left out: {}", row.scene, row.why));
        }
        let Some((first, manifest)) = trained.first() else { bail!("{}: no trained scenes are in it", root.display()) };
        let work = run.work("library", trained.len() as u64);
        let load = |(path, manifest): &(String, Manifest)| -> Result<Opened> {
            work.advance()?;
            let folder = SceneFolder::new(root.join(path));
            let grid = Grid::load(&folder).with_context(|| format!("{path}: its object table cannot be read; train it again"))?;
            eyes::check_version(manifest, &grid, &folder)?;
            Ok(Opened { path: path.clone(), grid })
        };
        let scenes = trained.iter().map(load).collect::<Result<Vec<_>>>()?;
        let load_ms = started.elapsed().as_secs_f64() * 1e3;
        let texts = Texts::load(&SceneFolder::new(root.join(first)), manifest, config.clip_text.as_deref())?;
        let search = Self { config, texts, scenes, skipped, load_ms };
        search.ask("warm up")?;
        Ok(search)
    }

    /// Returns the scenes that contain what `text` names: each scene answers by itself.
    ///
    /// # Errors
    /// A text that cannot be embedded.
    pub fn ask(&self, text: &str) -> Result<Report> {
        let started = Instant::now();
        let embedded = Embedded::words(text, &self.texts, &self.config.negatives)?;
        let encode_ms = started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let config = QueryConfig { false_alarms: self.config.false_alarms, ..QueryConfig::default() };
        let row = |scene: &Opened| -> Option<Row> {
            let answer = embedded.find(&scene.grid, &config);
            let object = answer.targets.first().or(answer.ranked.first())?.id;
            let support = scene.grid.objects[usize::from(object) - 1].support;
            let score = query::best_score(&answer.ranked);
            Some(Row { scene: scene.path.clone(), object, score, support, found: !answer.targets.is_empty() })
        };
        let mut rows: Vec<Row> = self.scenes.par_iter().filter_map(row).collect();
        rows.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.scene.cmp(&b.scene)));
        rows.truncate(self.config.scenes);
        let search_ms = started.elapsed().as_secs_f64() * 1e3;
        let objects = self.scenes.iter().map(|scene| scene.grid.objects.len()).sum();
        Ok(Report {
            text: text.to_owned(),
            found: rows.iter().any(|r| r.found),
            scenes: rows,
            searched: Searched { scenes: self.scenes.len(), objects },
            skipped: self.skipped.clone(),
            ms: Milliseconds { load: self.load_ms, encode: encode_ms, search: search_ms },
        })
    }
}

/// The path of a scene below the library's folder, and its manifest.
type Scene = (String, Manifest);

/// Trained scenes of one encoder below a folder, sorted by path; and those that were left out, with the reason.
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
        match (why, manifest) {
            (None, Ok(manifest)) => scenes.push((path, manifest)),
            (why, _) => skipped.push(Skipped { scene: path, why: why.unwrap_or_default() }),
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
