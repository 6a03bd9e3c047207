//! `fastlgs query --library`: which scenes of a folder hold what a text names.

use super::Args;
use crate::scene::Texts;
use crate::{Outcome, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::library::{self, Entry, Found, Library};
use serde_json::{Value, json};
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::{Instant, UNIX_EPOCH};

/// The index of a library, in its folder.
const INDEX: &str = "library.index";
/// How deep below the library's folder scenes are looked for.
const DEPTH: usize = 3;

/// Answers all texts; `texts` may be `-` for lines of standard input.
pub fn run(args: &Args, root: &Path, texts: &[String], common: &ui::Common) -> Result<Outcome> {
    if !args.image.is_empty() || !args.point.is_empty() || args.output.is_some() || args.export.is_some() || args.export_rest.is_some() {
        bail!("--library answers texts with scenes; ask one of these scenes for pictures, points and selections");
    }
    let started = Instant::now();
    let (scenes, skipped) = scenes_below(root)?;
    let Some((first, manifest)) = scenes.first() else { bail!("{}: no trained scenes are in it", root.display()) };
    let first_folder = SceneFolder::new(root.join(&first.path));
    let index = up_to_date(root, &scenes, common)?;
    let index_ms = started.elapsed().as_secs_f64() * 1e3;
    let encoder = Texts::load(&first_folder, manifest, args.clip_text.as_deref())?;
    let session = Session { args, texts: encoder, index, skipped, index_ms };
    session.search("warm up")?;
    if texts == ["-"] {
        let mut out = std::io::stdout();
        for line in std::io::stdin().lock().lines() {
            let line = line?;
            if !line.trim().is_empty() {
                let answer = session.search(line.trim()).unwrap_or_else(|e| json!({ "text": line.trim(), "error": format!("{e:#}") }));
                writeln!(out, "{answer}")?;
                out.flush()?;
            }
        }
        return Ok(Outcome::Done);
    }
    let mut answers = texts.iter().map(|text| session.search(text)).collect::<Result<Vec<_>>>()?;
    let found = answers.iter().any(|a| a["found"] == true);
    if common.json.is_some() {
        report::give(common, &if answers.len() == 1 { answers.remove(0) } else { Value::Array(answers) })?;
    } else if !common.quiet {
        answers.iter().for_each(print);
    }
    Ok(if found { Outcome::Done } else { Outcome::NotFound })
}

/// An opened library with the encoder of its texts.
struct Session<'a> {
    args: &'a Args,
    texts: Texts,
    index: Library,
    skipped: Vec<Value>,
    index_ms: f64,
}

impl Session<'_> {
    fn search(&self, text: &str) -> Result<Value> {
        let started = Instant::now();
        let mut query = self.texts.query(text)?;
        for negative in &self.args.negative {
            query.canonical.push(self.texts.query(negative)?.text);
        }
        let encode_ms = started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let best = self.index.search(&query, self.args.scenes)?;
        let search_ms = started.elapsed().as_secs_f64() * 1e3;
        let least = self.args.min_score.unwrap_or(self.texts.min_score());
        let row = |f: &Found| {
            let scene = &self.index.scenes[f.scene].path;
            json!({ "scene": scene, "object": f.hit.id, "score": f.hit.score, "support": f.support, "found": f.hit.score >= least })
        };
        let rows: Vec<Value> = best.iter().map(row).collect();
        Ok(json!({
            "text": text,
            "found": rows.iter().any(|r| r["found"] == true),
            "scenes": rows,
            "searched": { "scenes": self.index.scenes.len(), "objects": self.index.len() },
            "skipped": self.skipped,
            "ms": { "index": self.index_ms, "encode": encode_ms, "search": search_ms },
        }))
    }
}

fn print(answer: &Value) {
    let rows = answer["scenes"].as_array().into_iter().flatten();
    let found: Vec<&Value> = rows.filter(|r| r["found"] == true).collect();
    let of = &answer["searched"]["scenes"];
    println!("{}: in {} of {of} scenes ({:.1} ms)", answer["text"], found.len(), answer["ms"]["search"].as_f64().unwrap_or(f64::NAN));
    for row in found {
        println!(
            "  {:.3}  object {:<5} {}",
            row["score"].as_f64().unwrap_or(f64::NAN),
            row["object"],
            row["scene"].as_str().unwrap_or_default()
        );
    }
}

/// A scene of a library with what made it.
type Scene = (Entry, Manifest);

/// Trained scenes of one encoder below a folder, sorted by path, with the stamp of their tables; and what was passed over, with why.
fn scenes_below(root: &Path) -> Result<(Vec<Scene>, Vec<Value>)> {
    let mut folders = Vec::new();
    collect(root, DEPTH, &mut folders)?;
    folders.sort();
    let (mut scenes, mut skipped): (Vec<Scene>, Vec<Value>) = (Vec::new(), Vec::new());
    for folder in folders {
        let path = folder.strip_prefix(root).unwrap_or(&folder).to_string_lossy().into_owned();
        let manifest = SceneFolder::new(&folder).manifest();
        let why = match &manifest {
            Err(error) => Some(error.to_string()),
            Ok(own) if !own.notes.contains_key("train") => Some("it was never trained".to_owned()),
            Ok(own) => scenes
                .first()
                .map(|s| &s.1)
                .filter(|first| first.encoder != own.encoder)
                .map(|first| format!("its encoder is '{}', that of the library '{}'", own.encoder, first.encoder)),
        };
        match (why, manifest) {
            (None, Ok(manifest)) => scenes.push((Entry { path, stamp: stamp(&folder)? }, manifest)),
            (why, _) => skipped.push(json!({ "scene": path, "why": why })),
        }
    }
    for row in &skipped {
        tracing::warn!("{}: left out: {}", row["scene"], row["why"]);
    }
    Ok((scenes, skipped))
}

fn collect(folder: &Path, depth: usize, out: &mut Vec<PathBuf>) -> Result<()> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("{}: the library's folder cannot be read", folder.display()))?;
    for entry in entries {
        let entry = entry?;
        let path = entry.path();
        if !entry.file_type()?.is_dir() {
            continue;
        }
        if path.join("scene.json").is_file() {
            out.push(path);
        } else if depth > 1 {
            collect(&path, depth - 1, out)?;
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
fn up_to_date(root: &Path, scenes: &[Scene], common: &ui::Common) -> Result<Library> {
    let path = root.join(INDEX);
    let entries: Vec<&Entry> = scenes.iter().map(|s| &s.0).collect();
    if path.is_file() {
        match Library::open(&path) {
            Ok(library) if library.scenes.iter().eq(entries.iter().copied()) => return Ok(library),
            Ok(_) => tracing::info!("{}: scenes have changed; it is made anew", path.display()),
            Err(error) => tracing::warn!("{error}; doing that now"),
        }
    }
    let bar = ui::bar(common, entries.len() as u64, "library");
    let load = |entry: &Entry| -> Result<(Entry, Grid)> {
        bar.inc(1);
        let grid = Grid::load(&SceneFolder::new(root.join(&entry.path)));
        Ok((entry.clone(), grid.with_context(|| format!("{}: its table cannot be read; train it again", entry.path))?))
    };
    let tables = entries.into_iter().map(load).collect::<Result<Vec<_>>>()?;
    bar.finish_and_clear();
    library::write(&path, &tables).context("the library's index cannot be written")?;
    Ok(Library::open(&path)?)
}
