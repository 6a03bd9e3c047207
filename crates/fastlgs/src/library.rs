//! Searches many scenes for the object that a text names.

use crate::SceneNotes;
use crate::error::{Context, bail};
use crate::query::Texts;
use crate::query::object_query::Embedded;
use crate::{Result, Run, model_choice};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::query::{self, QueryConfig};
use fastlgs_grid::relevancy::Rule;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Depth of folders below the library in which scenes are searched.
const DEPTH: usize = 3;

/// Options of a library query, besides the text.
#[derive(Clone, Debug)]
pub struct SearchConfig {
    /// Largest number of scenes in an answer.
    pub scenes: usize,
    /// Accepted share of absent names that a scene answers.
    pub false_alarms: f32,
    /// Texts that must not fit an object better than the query.
    pub negatives: Vec<String>,
    /// CLIP text tower to use instead of the one that the scenes record.
    pub clip_text: Option<PathBuf>,
}

/// An opened library and its text encoder.
pub struct Search {
    config: SearchConfig,
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

/// Answer of a library.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SearchReport {
    /// Text of the query.
    pub text: String,
    /// Whether any scene contains the object.
    pub found: bool,
    /// Best scenes, sorted by score in descending order.
    pub scenes: Vec<Row>,
    /// Number of scenes and objects that were searched.
    pub searched: Searched,
    /// Scenes that were left out.
    pub skipped: Vec<Skipped>,
    /// Duration of each step.
    pub ms: Milliseconds,
}

/// A scene in an answer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    /// Path below the folder of the library.
    pub scene: String,
    /// Id of its best object.
    pub object: u16,
    /// Largest score of its objects, which decides whether the scene contains the target.
    pub score: f32,
    /// Support of the best object, 0 to 1.
    pub support: f32,
    /// Whether the scene contains the target.
    pub found: bool,
}

/// Number of scenes and objects that were searched.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Searched {
    /// Number of scenes.
    pub scenes: usize,
    /// Number of their objects.
    pub objects: usize,
}

/// A scene that was left out.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Skipped {
    /// Path below the folder of the library.
    pub scene: String,
    /// The reason.
    pub why: String,
}

/// Duration of the steps of an answer, in milliseconds.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Milliseconds {
    /// Loading the object tables of all scenes.
    pub load: f64,
    /// Embedding the text.
    pub encode: f64,
    /// Comparing it with all objects.
    pub search: f64,
}

impl Search {
    /// Loads the object tables of all trained scenes of one encoder below `root`.
    ///
    /// # Errors
    /// A folder without trained scenes, or a file that cannot be read.
    pub fn open(root: &Path, config: SearchConfig, run: &Run) -> Result<Self> {
        let started = Instant::now();
        let (trained, skipped) = scenes_below(root)?;
        for row in &skipped {
            run.warn(&format!(
                "{}: this scene is not searched: {}",
                row.scene, row.why
            ));
        }
        let Some((first, manifest)) = trained.first() else {
            bail!(
                "{}: this folder contains no trained scenes; train one first",
                root.display()
            )
        };
        let work = run.work("library", trained.len() as u64);
        let load = |(path, manifest): &(String, Manifest)| -> Result<Opened> {
            work.advance()?;
            let folder = SceneFolder::new(root.join(path));
            let grid = Grid::load(&folder).with_context(|| {
                format!("{path}: the object table cannot be read; train this scene again")
            })?;
            model_choice::check_version(manifest, &grid, &folder)?;
            Ok(Opened {
                path: path.clone(),
                grid,
            })
        };
        let scenes = trained.iter().map(load).collect::<Result<Vec<_>>>()?;
        let load_ms = started.elapsed().as_secs_f64() * 1e3;
        let texts = Texts::load(
            &SceneFolder::new(root.join(first)),
            manifest,
            config.clip_text.as_deref(),
            // Scores of different scenes are comparable only if they are calibrated.
            Rule::Calibrated,
        )?;
        let search = Self {
            config,
            texts,
            scenes,
            skipped,
            load_ms,
        };
        search.ask("warm up")?;
        Ok(search)
    }

    /// Returns the best scenes for a text. Each scene is queried on its own.
    ///
    /// # Errors
    /// A text that cannot be embedded.
    pub fn ask(&self, text: &str) -> Result<SearchReport> {
        let started = Instant::now();
        let embedded = Embedded::from_text(text, &self.texts, &self.config.negatives)?;
        let encode_ms = started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let config = QueryConfig {
            false_alarms: self.config.false_alarms,
            ..QueryConfig::default()
        };
        let row = |scene: &Opened| -> Option<Row> {
            let answer = embedded.find(&scene.grid, &config);
            let object = answer.targets.first().or(answer.ranked.first())?.id;
            let support = scene.grid.objects[usize::from(object) - 1].support;
            let score = query::best_score(&answer.ranked);
            Some(Row {
                scene: scene.path.clone(),
                object,
                score,
                support,
                found: !answer.targets.is_empty(),
            })
        };
        let mut rows: Vec<Row> = self.scenes.par_iter().filter_map(row).collect();
        rows.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.scene.cmp(&b.scene)));
        rows.truncate(self.config.scenes);
        let search_ms = started.elapsed().as_secs_f64() * 1e3;
        let objects = self
            .scenes
            .iter()
            .map(|scene| scene.grid.objects.len())
            .sum();
        Ok(SearchReport {
            text: text.to_owned(),
            found: rows.iter().any(|r| r.found),
            scenes: rows,
            searched: Searched {
                scenes: self.scenes.len(),
                objects,
            },
            skipped: self.skipped.clone(),
            ms: Milliseconds {
                load: self.load_ms,
                encode: encode_ms,
                search: search_ms,
            },
        })
    }
}

/// The path of a scene below the library's folder, and its manifest.
type Scene = (String, Manifest);

/// Returns the trained scenes of one encoder below a folder, sorted by path, and the scenes that
/// were left out with the reasons.
fn scenes_below(root: &Path) -> Result<(Vec<Scene>, Vec<Skipped>)> {
    let mut folders = Vec::new();
    collect(root, DEPTH, &mut folders)?;
    folders.sort();
    let (mut scenes, mut skipped): (Vec<Scene>, Vec<Skipped>) = (Vec::new(), Vec::new());
    for folder in folders {
        let path = folder
            .strip_prefix(root)
            .unwrap_or(&folder)
            .to_string_lossy()
            .into_owned();
        let manifest = SceneFolder::new(&folder).manifest();
        let why = match &manifest {
            Err(error) => Some(error.to_string()),
            Ok(own) => match SceneNotes::read(own, &folder).map(|notes| notes.train) {
                Err(error) => Some(error.to_string()),
                Ok(None) => Some("it was never trained".to_owned()),
                Ok(Some(_)) => {
                    scenes.first().map(|s| &s.1).filter(|first| model_choice::identity_of(first) != model_choice::identity_of(own)).map(|first| {
                        let [own, first] = [own, first].map(|m| [m.encoder.as_str(), m.crops.as_str()].join(" ").trim_end().to_owned());
                        format!(
                            "its encoder is '{own}', but the other scenes have '{first}'; preprocess and train it again with the encoder of the other scenes"
                        )
                    })
                }
            },
        };
        match (why, manifest) {
            (None, Ok(manifest)) => scenes.push((path, manifest)),
            (why, _) => skipped.push(Skipped {
                scene: path,
                why: why.unwrap_or_default(),
            }),
        }
    }
    Ok((scenes, skipped))
}

/// Adds the scene folders in `folder` and in `depth - 1` levels of subfolders to `out`.
fn collect(folder: &Path, depth: usize, out: &mut Vec<PathBuf>) -> Result<()> {
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("{}: the library's folder cannot be read", folder.display()))?;
    for entry in entries {
        let entry = entry?;
        let path = entry.path();
        // Links to scenes are followed. Names that begin with a dot belong to unfinished output.
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
