//! Trials: commands of `fastlgs` on copies of scenes. Each figure can thus be reproduced by hand.

use crate::command::run_command;
use anyhow::{Context, Result};
use fastlgs::Run;
use fastlgs_core::SceneFolder;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Returns a path as a command-line argument. Empty if it is not UTF-8.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap_or_default()
}

/// Returns the last component of a path.
pub fn name(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// A copy of a scene for changes. It is deleted with this value.
pub struct Trial<'a> {
    folder: tempfile::TempDir,
    /// `scene.ply` of the original scene.
    start: PathBuf,
    labels: Option<PathBuf>,
    run: Run<'a>,
}

impl<'a> Trial<'a> {
    /// Copies `scene` into `work`. Uses hard links where possible, because the program replaces
    /// whole files and never writes into one. The labels are those beside the scene's photos, if any.
    ///
    /// # Errors
    /// The scene is damaged or cannot be copied.
    pub fn new(scene: &Path, work: &Path, run: &Run<'a>) -> Result<Self> {
        let manifest = SceneFolder::open(scene)?.manifest()?;
        let labels = Path::new(&manifest.photos).join("labels");
        let source = scene.canonicalize()?;
        let folder = tempfile::tempdir_in(work).with_context(|| work.display().to_string())?;
        link_all(&source, &folder.path().join("scene"))
            .with_context(|| format!("copying {} failed", scene.display()))?;
        Ok(Self {
            folder,
            start: source.join("scene.ply"),
            labels: labels.is_dir().then_some(labels),
            run: *run,
        })
    }

    /// Returns the folder of the copy.
    pub fn scene(&self) -> SceneFolder {
        SceneFolder::new(self.folder.path().join("scene"))
    }

    /// Trains the copy with `args`, and returns the report. `SCENE/scene.ply` in `args` stands for
    /// the original's model.
    pub fn train(&self, args: &[&str], seed: u64) -> Result<Value> {
        let scene = self.scene();
        let place = |a: &&str| {
            if *a == "SCENE/scene.ply" {
                text(&self.start).to_owned()
            } else {
                (*a).to_owned()
            }
        };
        let args: Vec<String> = args.iter().map(place).collect();
        let all: Vec<&str> = std::iter::once(text(&scene.root))
            .chain(args.iter().map(String::as_str))
            .collect();
        run_command(&self.run, seed, "train", &all)
    }

    /// Evaluates the copy, and returns the report.
    pub fn eval(&self) -> Result<Value> {
        self.eval_of(&self.scene().root)
    }

    /// Evaluates another folder of the same scene, and returns the report.
    pub fn eval_of(&self, scene: &Path) -> Result<Value> {
        evaluate(&self.run, self.run.seed, scene, self.labels.as_deref())
    }
}

/// Evaluates a scene, against labels if there are any, and returns the report.
pub fn evaluate(run: &Run, seed: u64, scene: &Path, labels: Option<&Path>) -> Result<Value> {
    let against = labels.map(|folder| ["--labels", text(folder)]);
    let args = [&[text(scene)], against.as_slice().as_flattened()].concat();
    run_command(run, seed, "eval", &args)
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
