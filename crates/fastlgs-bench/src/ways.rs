//! Methods of making a language field from masks: their commands, cost and accuracy.

use crate::command::run_command;
use crate::table::number;
use crate::trial::{self, Trial};
use anyhow::{Result, bail};
use fastlgs::Run;
use serde_json::{Value, json};
use std::path::Path;

/// A method of making a language field from masks.
pub struct Method {
    pub name: &'static str,
    pub how: How,
    /// Cost class: 0 takes seconds, 1 minutes, 2 much longer.
    pub cost: u8,
}

/// The command of a method.
pub enum How {
    /// `train` with these options. Geometry and colour of the scene's Gaussians stay.
    Remap(&'static [&'static str]),
    /// Gradient descent on the paper's codes alone, for this number of iterations.
    Descent(&'static str),
    /// `train` with these options, from the photos.
    Train(&'static [&'static str]),
    /// `fastlgs-bench baseline` with this method, on the unchanged scene.
    Baseline(&'static str),
}

impl How {
    /// Returns the command and its arguments. SCENE is replaced by the scene folder.
    pub fn command(&self) -> Vec<&'static str> {
        const START: [&str; 3] = ["SCENE", "--init", "SCENE/scene.ply"];
        match self {
            Self::Remap(args) => [&["train"], &START[..], &["--iterations", "0"], args].concat(),
            Self::Descent(steps) => {
                let descent = [
                    "--freeze",
                    "--feature-mode",
                    "train",
                    "--mapping",
                    "paper",
                    "--iterations",
                    steps,
                ];
                [&["train"], &START[..], &descent].concat()
            }
            Self::Train(args) => [&["train", "SCENE"], *args].concat(),
            Self::Baseline(method) => vec!["bench", "baseline", "SCENE", "--method", method],
        }
    }
}

/// Returns the methods with the given names, or all if there are none.
///
/// # Errors
/// A name is unknown.
pub fn selected_ways<'a>(ways: &'a [Method], names: &[String]) -> Result<Vec<&'a Method>> {
    if let Some(unknown) = names
        .iter()
        .find(|name| !ways.iter().any(|way| way.name == **name))
    {
        bail!(
            "--ways: '{unknown}' is unknown; choose from {}",
            ways.iter()
                .map(|way| way.name)
                .collect::<Vec<_>>()
                .join("; ")
        );
    }
    Ok(ways
        .iter()
        .filter(|way| names.is_empty() || names.iter().any(|name| name == way.name))
        .collect())
}

impl Method {
    pub const fn new(name: &'static str, how: How) -> Self {
        Self { name, how, cost: 0 }
    }

    /// Runs `command` on a copy of `scene`, and returns its row.
    pub fn row(&self, trial: &Trial, command: &[&str], scene: &Path, run: &Run) -> Result<Value> {
        let mut row = if let How::Baseline(_) = self.how {
            baseline(trial, command, run)?
        } else {
            trained(trial, command)?
        };
        row["scene"] = json!(trial::name(scene));
        row["way"] = json!(self.name);
        row["command"] = json!(format!(
            "fastlgs {}",
            command
                .join(" ")
                .replace("SCENE", &scene.display().to_string())
        ));
        Ok(row)
    }
}

/// Trains and evaluates. The seconds include the mapping.
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

/// Runs `fastlgs-bench baseline`. For fields without objects, the oracle is the best threshold of
/// each label. Fields with codes use the scene's objects, so their seconds include the scene's
/// mapping.
fn baseline(trial: &Trial, command: &[&str], run: &Run) -> Result<Value> {
    let scene = trial.scene();
    let args: Vec<&str> = command[1..]
        .iter()
        .map(|a| {
            if *a == "SCENE" {
                trial::text(&scene.root)
            } else {
                *a
            }
        })
        .collect();
    let mut found = run_command(run, run.seed, command[0], &args)?;
    (found["query_ms"], found["bytes"]) =
        (found["render_ms"].clone(), found["field_bytes"].clone());
    if !found["wrong_pixels"].is_null() {
        let mapping = scene
            .manifest()?
            .notes
            .get("train")
            .map_or(0.0, |train| number(train, "mapping_seconds"));
        found["seconds"] = json!(number(&found, "seconds") + mapping);
    }
    Ok(found)
}
