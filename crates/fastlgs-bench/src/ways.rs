//! Ways from masks to a field that answers, and what each costs and gives.

use crate::command::call;
use crate::table::number;
use crate::trial::{self, Trial};
use anyhow::{Result, bail};
use fastlgs::Run;
use serde_json::{Value, json};
use std::path::Path;

/// A way from masks to a field.
pub struct Way {
    pub name: &'static str,
    pub how: How,
    /// How long it takes: 0 seconds, 1 minutes, 2 much longer.
    pub cost: u8,
}

/// What a way runs.
pub enum How {
    /// `train` with options on the scene's Gaussians, whose geometry and colour stay.
    Remap(&'static [&'static str]),
    /// Descent on the paper's codes alone, for so many iterations.
    Descent(&'static str),
    /// `train` from the photos on.
    Train(&'static [&'static str]),
    /// `fastlgs-bench baseline` on the scene as it is.
    Baseline(&'static str),
}

impl How {
    /// The command and its arguments; SCENE stands for the scene.
    pub fn command(&self) -> Vec<&'static str> {
        const START: [&str; 3] = ["SCENE", "--init-ply", "SCENE/scene.ply"];
        match self {
            Self::Remap(args) => [&["train"], &START[..], &["--iterations", "0"], args].concat(),
            Self::Descent(steps) => {
                let descent = ["--freeze", "--feature-mode", "train", "--mapping", "paper", "--iterations", steps];
                [&["train"], &START[..], &descent].concat()
            }
            Self::Train(args) => [&["train", "SCENE"], *args].concat(),
            Self::Baseline(method) => vec!["bench", "baseline", "SCENE", "--method", method],
        }
    }
}

/// The ways of these names; without any, all.
pub fn wanted<'a>(ways: &'a [Way], names: &[String]) -> Result<Vec<&'a Way>> {
    if let Some(unknown) = names.iter().find(|name| !ways.iter().any(|way| way.name == **name)) {
        bail!("--ways: '{unknown}' is none of {}", ways.iter().map(|way| way.name).collect::<Vec<_>>().join("; "));
    }
    Ok(ways.iter().filter(|way| names.is_empty() || names.iter().any(|name| name == way.name)).collect())
}

impl Way {
    pub const fn new(name: &'static str, how: How) -> Self {
        Self { name, how, cost: 0 }
    }

    /// Runs `command` on a copy of `scene`; its figures.
    pub fn row(&self, trial: &Trial, command: &[&str], scene: &Path, run: &Run) -> Result<Value> {
        let mut row = if let How::Baseline(_) = self.how { baseline(trial, command, run)? } else { trained(trial, command)? };
        row["scene"] = json!(trial::name(scene));
        row["way"] = json!(self.name);
        row["command"] = json!(format!("fastlgs {}", command.join(" ").replace("SCENE", &scene.display().to_string())));
        Ok(row)
    }
}

/// Trains and evaluates.
fn trained(trial: &Trial, command: &[&str]) -> Result<Value> {
    let [trained, scored] = trial.train_and_eval(&command[2..])?;
    Ok(json!({
        "seconds": number(&trained, "seconds") + number(&trained, "mapping_seconds"),
        "query_ms": scored["query_ms_first"],
        "oracle_miou": scored["oracle_miou"],
        "miou": scored["miou"],
        "macc": scored["macc"],
        "text_top1": scored["text_top1"],
        "loc_acc": scored["loc_acc"],
        "psnr": scored["psnr"],
        "objects": scored["objects"],
        "gaussians": scored["gaussians"],
        "bytes": scored["scene_bytes"],
        "size": scored["size"],
        "adapter": scored["adapter"],
    }))
}

/// Makes another field. Its oracle is the best threshold of each label, where it knows no objects; where it does, they are those of the
/// scene, whose mapping took its time.
fn baseline(trial: &Trial, command: &[&str], run: &Run) -> Result<Value> {
    let scene = trial.scene();
    let args: Vec<&str> = command[1..].iter().map(|a| if *a == "SCENE" { trial::text(&scene.root) } else { *a }).collect();
    let mut found = call(run, run.seed, command[0], &args)?;
    (found["query_ms"], found["bytes"]) = (found["render_ms"].clone(), found["field_bytes"].clone());
    if !found["wrong_pixels"].is_null() {
        let mapping = scene.manifest()?.notes.get("train").map_or(0.0, |train| number(train, "mapping_seconds"));
        found["seconds"] = json!(number(&found, "seconds") + mapping);
    }
    Ok(found)
}
