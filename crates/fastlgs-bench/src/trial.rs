//! Trials: the program's own commands on copies of scenes, so that every figure can be had again by hand.

use crate::command::call;
use anyhow::{Context, Result, bail};
use fastlgs::Run;
use fastlgs_core::SceneFolder;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap_or_default()
}

/// An empty folder for trials below `output`; what a killed run left there is removed.
pub fn workshop(output: &Path) -> Result<PathBuf> {
    let work = output.join(".trials");
    let _ = std::fs::remove_dir_all(&work);
    std::fs::create_dir_all(&work).with_context(|| work.display().to_string())?;
    Ok(work.canonicalize()?)
}

/// Views and size of the generated scenes of quick suites.
pub const QUICK: (usize, &str) = (32, "240x180");

/// Makes a generated scene and preprocesses it with its exact masks, unless it is there; returns the scene folder.
pub fn generated(run: &Run, work: &Path, kind: &str, views: usize, size: &str) -> Result<PathBuf> {
    let (photos, scene) = (work.join(kind).join("photos"), work.join(kind).join(kind));
    if !scene.is_dir() {
        call(run, run.seed, "synth", &[kind, "-o", text(&photos), "--size", size, "--views", &views.to_string()])?;
        call(run, run.seed, "preprocess", &[text(&photos), "-o", text(&scene), "--segmenter", "import"])?;
    }
    Ok(scene)
}

/// The scenes, or where there are none a generated and trained table.
pub fn or_generated(scenes: &[PathBuf], work: &Path, run: &Run) -> Result<Vec<PathBuf>> {
    if !scenes.is_empty() {
        return Ok(scenes.to_vec());
    }
    let (views, size) = QUICK;
    let scene = generated(run, work, "table", views, size)?;
    call(run, run.seed, "train", &[text(&scene), "--iterations", "1000"])?;
    Ok(vec![scene])
}

/// The last part of a path.
pub fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A copy of a scene that may be changed; it is gone with the trial.
pub struct Trial<'a> {
    folder: tempfile::TempDir,
    /// The original's model.
    start: PathBuf,
    labels: PathBuf,
    run: Run<'a>,
}

impl<'a> Trial<'a> {
    /// Copies `scene` into `work` (by hard links where it can: whatever is written replaces files as a whole). Labels are those beside
    /// the photos that it was made from.
    pub fn new(scene: &Path, work: &Path, run: &Run<'a>) -> Result<Self> {
        let manifest = SceneFolder::open(scene)?.manifest()?;
        let labels = Path::new(&manifest.photos).join("labels");
        if !labels.is_dir() {
            bail!("{}: no labels beside the photos of {}", labels.display(), scene.display());
        }
        let beside = scene.canonicalize()?;
        let folder = tempfile::tempdir_in(work).with_context(|| work.display().to_string())?;
        link_all(&beside, &folder.path().join("scene")).with_context(|| format!("{} cannot be copied", scene.display()))?;
        Ok(Self { folder, start: beside.join("scene.ply"), labels, run: *run })
    }

    /// The copy.
    pub fn scene(&self) -> SceneFolder {
        SceneFolder::new(self.folder.path().join("scene"))
    }

    /// Trains with `args`, in which `SCENE/scene.ply` means the original's.
    pub fn train(&self, args: &[&str], seed: u64) -> Result<Value> {
        let scene = self.scene();
        let place = |a: &&str| if *a == "SCENE/scene.ply" { text(&self.start).to_owned() } else { (*a).to_owned() };
        let args: Vec<String> = args.iter().map(place).collect();
        let all: Vec<&str> = std::iter::once(text(&scene.root)).chain(args.iter().map(String::as_str)).collect();
        call(&self.run, seed, "train", &all)
    }

    /// Evaluates against the labels.
    pub fn eval(&self, args: &[&str]) -> Result<Value> {
        let scene = self.scene();
        let first = [text(&scene.root), "--labels", text(&self.labels)];
        call(&self.run, self.run.seed, "eval", &[&first, args].concat())
    }

    /// Evaluates another folder of the same scene.
    pub fn eval_of(&self, scene: &Path) -> Result<Value> {
        call(&self.run, self.run.seed, "eval", &[text(scene), "--labels", text(&self.labels)])
    }

    /// Trains with `args` and evaluates; returns both reports.
    pub fn train_and_eval(&self, args: &[&str]) -> Result<[Value; 2]> {
        Ok([self.train(args, self.run.seed)?, self.eval(&[])?])
    }
}

fn link_all(from: &Path, to: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(to)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            link_all(&entry.path(), &target)?;
        } else if std::fs::hard_link(entry.path(), &target).is_err() {
            std::fs::copy(entry.path(), &target)?;
        }
    }
    Ok(())
}
