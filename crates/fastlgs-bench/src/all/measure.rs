//! Measures a row of `fastlgs-bench all`.

use super::plan::{Planned, SceneSource};
use super::ways::{BASE, How};
use crate::command::run_command;
use crate::disturb::{self, Album, PhotoChange};
use crate::trial::{Trial, evaluate, text};
use anyhow::{Context, Result};
use fastlgs::{Run, SceneNotes};
use fastlgs_core::{Gaussians, SceneFolder, fs, ply};
use fastlgs_grid::Grid;
use fastlgs_raster::density::State;
use fastlgs_raster::{CpuEngine, Engine};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Side to which photos are reduced, in pixels.
const MAX_SIDE: &str = "480";
/// Size of generated photos.
const GENERATED_SIZE: &str = "480x360";

/// Measures rows. Scenes of [`BASE`] are kept in the work folder, because most ways start from them.
pub struct Measure<'a> {
    pub run: &'a Run<'a>,
    pub work: &'a Path,
    /// Iterations of all trainings, instead of those of the presets.
    pub iterations: Option<String>,
}

/// A scene of [`BASE`].
struct Base {
    scene: PathBuf,
    labels: PathBuf,
    /// Its row.
    row: Value,
}

/// Returns seconds by stage.
fn seconds(preprocess: &Value, train: &Value, objects: &Value) -> Value {
    json!({ "preprocess": preprocess, "train": train, "objects": objects })
}

/// Returns the figures of a row.
fn figures(scored: &Value, seconds: Value) -> Value {
    let mut row = json!({
        "seconds": seconds,
        "right": scored["outcomes"]["right"].as_u64().unwrap_or(0),
        "labels": scored["labels_scored"],
    });
    for name in [
        "oracle_miou",
        "miou",
        "psnr",
        "gaussians",
        "objects",
        "scene_bytes",
        "absent_rejected",
        "absent_texts",
        "apart",
        "size",
        "adapter",
    ] {
        row[name] = scored[name].clone();
    }
    row["machine"] = json!(machine());
    row["query_ms"] = scored["query_ms_first"].clone();
    row
}

impl Measure<'_> {
    /// Measures a row and returns its figures.
    pub fn row(&self, planned: &Planned) -> Result<Value> {
        let (scene, seed) = (planned.scene, planned.seed);
        if planned.way.name == BASE || !scene.given {
            return Ok(self.base(scene, seed)?.row);
        }
        if let How::Make(options) = planned.way.how {
            let folder = tempfile::tempdir_in(self.work)?;
            let (photos, labels) = self.photos(scene, seed)?;
            let scene = folder.path().join("scene");
            return self.make(&photos, &labels, &scene, options, seed);
        }
        let base = self.base(scene, seed)?;
        if let How::Photos(change) = planned.way.how {
            return self.make_from_changed(&base, change, seed);
        }
        let run = Run { seed, ..*self.run };
        let trial = Trial::new(&base.scene, self.work, &run)?;
        self.changed(planned.way.how, &base, &trial, seed)
    }

    /// Changes a copy of the base scene and returns its figures.
    fn changed(&self, how: How, base: &Base, trial: &Trial, seed: u64) -> Result<Value> {
        let folder = trial.scene();
        let evaluated = || Ok(figures(&trial.eval()?, Value::Null));
        match how {
            How::Make(_) | How::Photos(_) => unreachable!("these start from photos"),
            How::Train(options) => {
                let trained = timed_training(trial, &self.with_iterations(options), seed)?;
                let spent = seconds(
                    &base.row["seconds"]["preprocess"],
                    &trained["seconds"],
                    &trained["mapping_seconds"],
                );
                Ok(figures(&trial.eval()?, spent))
            }
            How::Remap(options) => self.remapped(base, trial, "SCENE/scene.ply", options, seed),
            How::Masks(change) => {
                disturb::masks(&folder, change, seed + 1)?;
                self.remapped(base, trial, "SCENE/scene.ply", &[], seed)
            }
            How::Embeddings(noise) => {
                disturb::embeddings(&folder, noise, seed + 1)?;
                evaluated()
            }
            How::WithoutDetector => {
                let mut grid = Grid::load(&folder)?;
                grid.objects.iter_mut().for_each(|o| o.detected = None);
                grid.save(&folder)?;
                let mut row = figures(&trial.eval()?, base.row["seconds"].clone());
                row["query_ms"] = base.row["query_ms"].clone();
                Ok(row)
            }
            How::Baseline(method) => self.baseline(method, trial, base, seed),
            How::Format(ending) => self.exported(base, trial, ending, seed),
            How::Compact => Ok(figures(&self.compact(trial, seed)?, Value::Null)),
            How::Degree(degree) => {
                ply::write(
                    &folder.ply_path(),
                    &folder.gaussians()?.with_sh_degree(degree),
                )?;
                evaluated()
            }
            How::Kept(share) => {
                let all = folder.gaussians()?;
                let mut kept = most_important(&folder, &all, share)?;
                kept.sort_unstable();
                ply::write(&folder.ply_path(), &all.select(&kept))?;
                evaluated()
            }
        }
    }

    /// Maps the objects again to the Gaussians of `file`, and returns the figures.
    fn remapped(
        &self,
        base: &Base,
        trial: &Trial,
        file: &str,
        options: &[&str],
        seed: u64,
    ) -> Result<Value> {
        let start = ["--init", file, "--iterations", "0"];
        let trained = timed_training(trial, &[&start, options].concat(), seed)?;
        let before = &base.row["seconds"];
        let spent = seconds(
            &before["preprocess"],
            &before["train"],
            &trained["mapping_seconds"],
        );
        Ok(figures(&trial.eval()?, spent))
    }

    /// Exports the Gaussians to a file, maps the objects to them again, and returns the figures. The
    /// file has no object ids, so 2 bytes a Gaussian are added.
    fn exported(&self, base: &Base, trial: &Trial, ending: &str, seed: u64) -> Result<Value> {
        let folder = trial.scene();
        let file = folder.root.with_file_name(format!("scene.{ending}"));
        let arguments = [text(&folder.root), text(&file)];
        run_command(self.run, seed, "export", &arguments)?;
        let mut row = self.remapped(base, trial, text(&file), &[], seed)?;
        let length = |path: &Path| -> Result<u64> { Ok(std::fs::metadata(path)?.len()) };
        let others = row["scene_bytes"].as_u64().unwrap_or(0) - length(&folder.ply_path())?;
        let ids = 2 * row["gaussians"].as_u64().unwrap_or(0);
        row["scene_bytes"] = json!(others + length(&file)? + ids);
        row["seconds"] = Value::Null;
        Ok(row)
    }

    /// Returns the folders of photos and labels. Generates them if the scene has none.
    fn photos(&self, scene: &SceneSource, seed: u64) -> Result<(PathBuf, PathBuf)> {
        let photos = match &scene.photos {
            Some(photos) => photos.clone(),
            None => self.work.join(format!("{}-{seed}-photos", scene.name)),
        };
        if scene.photos.is_none() && !photos.join("transforms.json").is_file() {
            let size = if self.iterations.is_some() {
                "240x180"
            } else {
                GENERATED_SIZE
            };
            let arguments = [&scene.name, "-o", text(&photos), "--size", size];
            run_command(self.run, seed, "synth", &arguments)?;
        }
        let labels = photos.join("labels");
        Ok((photos, labels))
    }

    /// Returns the scene of [`BASE`]; makes it if it is missing.
    fn base(&self, source: &SceneSource, seed: u64) -> Result<Base> {
        let (photos, labels) = self.photos(source, seed)?;
        let scene = self.work.join(format!("{}-{seed}", source.name));
        // Written last: a scene without it is incomplete.
        let finished = scene.with_extension("row.json");
        if !finished.is_file() {
            let _ = std::fs::remove_dir_all(&scene);
            let options: &[&str] = match source.photos {
                Some(_) => &[],
                None => &["--segmenter", "import"],
            };
            let row = self.make(&photos, &labels, &scene, options, seed)?;
            fs::write_json(&finished, &row)?;
        }
        let row = fs::read_json(&finished)?;
        Ok(Base { scene, labels, row })
    }

    /// Preprocesses photos, trains with preset quick, and evaluates.
    fn make(
        &self,
        photos: &Path,
        labels: &Path,
        scene: &Path,
        options: &[&str],
        seed: u64,
    ) -> Result<Value> {
        let side: &[&str] = if options.contains(&"--max-side") {
            &[]
        } else {
            &["--max-side", MAX_SIDE]
        };
        let arguments = [&[text(photos), "-o", text(scene)], side, options].concat();
        let prepared = run_command(self.run, seed, "preprocess", &arguments)?;
        let training = self.with_iterations(&[text(scene), "--preset", BASE]);
        let trained = run_command(self.run, seed, "train", &training)?;
        let labels = labels.is_dir().then_some(labels);
        let scored = evaluate(self.run, seed, scene, labels)?;
        let spent = seconds(
            &prepared["seconds_total"],
            &trained["seconds"],
            &trained["mapping_seconds"],
        );
        let mut row = figures(&scored, spent);
        row["photos"] = prepared["training_photos"].clone();
        Ok(row)
    }

    fn make_from_changed(&self, base: &Base, change: PhotoChange, seed: u64) -> Result<Value> {
        let folder = tempfile::tempdir_in(self.work)?;
        let [photos, scene] = ["photos", "scene"].map(|name| folder.path().join(name));
        Album::of(&SceneFolder::open(&base.scene)?, &base.labels)?.write(
            &photos,
            change,
            seed + 1,
        )?;
        let labels = photos.join("labels");
        self.make(
            &photos,
            &labels,
            &scene,
            &["--holdout-labels", text(&labels)],
            seed,
        )
    }

    /// Runs `fastlgs-bench baseline`. Fields with codes use the scene's objects, so their seconds
    /// include its mapping. Fields without objects have no best object, and the time of their
    /// queries is that of rendering alone.
    fn baseline(&self, method: &str, trial: &Trial, base: &Base, seed: u64) -> Result<Value> {
        let scene = trial.scene();
        let arguments = ["baseline", text(&scene.root), "--method", method];
        let found = run_command(self.run, seed, "bench", &arguments)?;
        let before = &base.row["seconds"];
        let mut field = found["seconds"]
            .as_f64()
            .context("the seconds of a baseline")?;
        let has_objects = !found["wrong_pixels"].is_null();
        if has_objects {
            field += before["objects"].as_f64().unwrap_or(0.0);
        }
        let mut row = figures(
            &found,
            seconds(&before["preprocess"], &before["train"], &json!(field)),
        );
        row["right"] = Value::Null;
        row["scene_bytes"] = Value::Null;
        if !has_objects {
            row["oracle_miou"] = Value::Null;
            row["query_ms"] = found["render_ms"].clone();
        }
        Ok(row)
    }

    /// Exports the trial's scene as a compact scene folder and evaluates that.
    fn compact(&self, trial: &Trial, seed: u64) -> Result<Value> {
        let folder = tempfile::tempdir_in(self.work)?;
        let (scene, small) = (trial.scene(), folder.path().join("small"));
        run_command(self.run, seed, "export", &[text(&scene.root), text(&small)])?;
        // The export has no photos. PSNR needs the held-out ones.
        let to = SceneFolder::new(&small);
        for camera in scene.manifest()?.held_out(&scene.cameras()?) {
            let name = &camera.name;
            for (from, to) in [
                (scene.photo_path(name), to.photo_path(name)),
                (scene.alpha_path(name), to.alpha_path(name)),
                (scene.ignore_path(name), to.ignore_path(name)),
            ] {
                if from.is_file() {
                    std::fs::create_dir_all(to.parent().unwrap_or(&small))?;
                    std::fs::copy(from, to)?;
                }
            }
        }
        trial.eval_of(&small)
    }

    /// Adds the number of iterations, if it is set.
    fn with_iterations<'b>(&'b self, options: &[&'b str]) -> Vec<&'b str> {
        let number = self.iterations.iter().flat_map(|n| ["--iterations", n]);
        options.iter().copied().chain(number).collect()
    }
}

/// Trains and returns the report. Its seconds of mapping include those of Algorithm 1, which runs
/// while the masks are read and is part of no time in the report. They also include the loading of
/// the scene.
fn timed_training(trial: &Trial, options: &[&str], seed: u64) -> Result<Value> {
    let started = Instant::now();
    let mut report = trial.train(options, seed)?;
    if report["mapping"] == "paper" {
        let all = started.elapsed().as_secs_f64();
        report["mapping_seconds"] = json!(all - report["seconds"].as_f64().unwrap_or(0.0));
    }
    Ok(report)
}

/// Returns the indices of the `share` of Gaussians that change the training views most.
fn most_important(folder: &SceneFolder, scene: &Gaussians, share: f64) -> Result<Vec<usize>> {
    let manifest = folder.manifest()?;
    let trained = SceneNotes::read(&manifest, &folder.root)?
        .train
        .unwrap_or_default();
    let mut engine = CpuEngine::new();
    engine.set_state(&State::of(scene))?;
    let mut scores = vec![0.0; scene.len()];
    for camera in manifest.training(&folder.cameras()?) {
        engine.saliency(trained.view(&camera, scene), None, &mut scores)?;
    }
    let mut order: Vec<usize> = (0..scene.len()).collect();
    order.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b)));
    order.truncate((share * scene.len() as f64).round() as usize);
    Ok(order)
}

/// Returns the name of the processor and the number of threads.
fn machine() -> String {
    let about = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = about
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let name = model.map_or("unknown processor", |(_, name)| name);
    format!(
        "{name}, {} threads",
        std::thread::available_parallelism().map_or(1, |n| n.get())
    )
}
