//! Trials: the program's own commands on a copy of a scene, so that every figure can be had again by hand.

use crate::ui;
use anyhow::{Context, Result, bail};
use fastlgs_core::SceneFolder;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A copy of a scene that trials may change.
pub struct Trial {
    folder: tempfile::TempDir,
    /// The original.
    pub scene: PathBuf,
    /// Its labels.
    labels: PathBuf,
    common: ui::Common,
}

impl Trial {
    /// Copies `scene` beside itself (by hard links: whatever is written replaces files as a whole). Labels are those beside the photos
    /// that it was made from.
    pub fn new(scene: &Path, common: &ui::Common) -> Result<Self> {
        let manifest = SceneFolder::open(scene)?.manifest()?;
        let labels = Path::new(&manifest.photos).join("labels");
        if !labels.is_dir() {
            bail!("{}: no labels beside the photos of {}", labels.display(), scene.display());
        }
        let beside = scene.canonicalize()?;
        let folder = tempfile::Builder::new().prefix(".trial-").tempdir_in(beside.parent().unwrap_or(Path::new(".")))?;
        link_all(&beside, &folder.path().join("scene")).with_context(|| format!("{} cannot be copied", scene.display()))?;
        Ok(Self { folder, scene: scene.to_owned(), labels, common: common.clone() })
    }

    fn copy(&self) -> PathBuf {
        self.folder.path().join("scene")
    }

    /// Runs `fastlgs COMMAND SCENE ARGS` on the copy; returns its report.
    fn run(&self, command: &str, args: &[String]) -> Result<Value> {
        let program = std::env::current_exe().context("this program's own file")?;
        let mut call = Command::new(program);
        call.arg(command).arg(self.copy()).args(args).args(["--json", "-", "-q", "--device", &self.common.device]);
        call.args(["--seed", &self.common.seed.to_string()]);
        let output = call.output().context("the program cannot be started again")?;
        if !output.status.success() {
            bail!("fastlgs {command}: {}", String::from_utf8_lossy(&output.stderr).trim());
        }
        serde_json::from_slice(&output.stdout).with_context(|| format!("fastlgs {command} gave no report"))
    }

    /// Trains with `args` and evaluates; returns both reports.
    pub fn train_and_eval(&self, args: &[&str]) -> Result<[Value; 2]> {
        let start = self.scene.canonicalize()?.join("scene.ply");
        let place = |a: &&str| if *a == "SCENE/scene.ply" { start.display().to_string() } else { (*a).to_owned() };
        let trained = self.run("train", &args.iter().map(place).collect::<Vec<_>>())?;
        let scored = self.run("eval", &["--labels".to_owned(), self.labels.display().to_string()])?;
        Ok([trained, scored])
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
