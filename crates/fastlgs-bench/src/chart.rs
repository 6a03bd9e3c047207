//! `fastlgs bench chart`: accuracy against time, for the ways from masks to a field that answers.

use crate::command::call;
use crate::plot::{self, Axes, Scatter, Spot};
use crate::table::{self, number};
use crate::trial::{self, Trial};
use anyhow::{Result, bail};
use fastlgs::Run;
use fastlgs_core::SceneFolder;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench chart scenes/fox scenes/bonsai -o out")]
pub struct Args {
    /// Trained scenes whose photos have labels/ beside them; without any, a generated table.
    scenes: Vec<PathBuf>,
    /// Only what takes seconds: no long descents, no training of geometry.
    #[arg(long)]
    quick: bool,
    /// Also what takes long: the paper's number of steps, and the presets, which train geometry anew.
    #[arg(long, conflicts_with = "quick")]
    long: bool,
    /// Ways that are tried, as the table calls them, separated by commas; all by default.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    ways: Vec<String>,
    /// Folder for chart.md, .csv, .json, and two charts as SVG and PNG.
    #[arg(short, long)]
    output: PathBuf,
}

/// A way from masks to a field.
pub struct Way {
    pub name: &'static str,
    pub how: How,
    /// How long it takes: 0 seconds, 1 minutes, 2 much longer.
    cost: u8,
}

/// What a way runs.
pub enum How {
    /// `train` with options on the scene's Gaussians, whose geometry and colour stay.
    Remap(&'static [&'static str]),
    /// Descent on the paper's codes alone, for so many iterations.
    Descent(&'static str),
    /// `train` from the photos on.
    Train(&'static [&'static str]),
    /// `bench baseline` on the scene as it is.
    Baseline(&'static str),
}

const WAYS: [Way; 20] = [
    Way { name: "embeddings", how: How::Remap(&["--mapping", "paper", "--cues", "none"]), cost: 0 },
    Way { name: "+ key points", how: How::Remap(&["--mapping", "paper", "--cues", "keypoints"]), cost: 0 },
    Way { name: "+ colour (paper)", how: How::Remap(&["--mapping", "paper"]), cost: 0 },
    Way { name: "global", how: How::Remap(&[]), cost: 0 },
    Way { name: "code of 1 number", how: How::Baseline("code1"), cost: 0 },
    Way { name: "code of 2 numbers", how: How::Baseline("code2"), cost: 0 },
    Way { name: "code of 3 numbers", how: How::Baseline("code3"), cost: 0 },
    Way { name: "code of 4 numbers", how: How::Baseline("code4"), cost: 0 },
    Way { name: "no grid", how: How::Baseline("raw"), cost: 0 },
    Way { name: "like LangSplat", how: How::Baseline("langsplat"), cost: 1 },
    Way { name: "like LERF", how: How::Baseline("lerf"), cost: 1 },
    Way { name: "paper 300 steps", how: How::Descent("300"), cost: 0 },
    Way { name: "paper 1000 steps", how: How::Descent("1000"), cost: 1 },
    Way { name: "paper 3000 steps", how: How::Descent("3000"), cost: 1 },
    Way { name: "paper 7000 steps", how: How::Descent("7000"), cost: 2 },
    Way { name: "paper 30000 steps", how: How::Descent("30000"), cost: 2 },
    Way { name: "preset quick", how: How::Train(&["--preset", "quick"]), cost: 2 },
    Way { name: "preset standard", how: How::Train(&["--preset", "standard"]), cost: 2 },
    Way { name: "preset paper", how: How::Train(&["--preset", "paper"]), cost: 2 },
    Way { name: "preset like-paper", how: How::Train(&["--preset", "like-paper"]), cost: 2 },
];

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

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let most = if args.long { 2 } else { u8::from(!args.quick) };
    let ways: Vec<&Way> = wanted(&WAYS, &args.ways)?.into_iter().filter(|w| w.cost <= most).collect();
    let work = trial::workshop(&args.output)?;
    let scenes = trial::or_generated(&args.scenes, &work, run)?;
    let progress = run.work("ways", (scenes.len() * ways.len()) as u64);
    let mut rows = Vec::new();
    for scene in &scenes {
        let before: f64 =
            SceneFolder::open(scene)?.manifest()?.seconds.iter().filter(|s| s.0.starts_with("preprocess.")).map(|s| s.1).sum();
        for way in &ways {
            let trial = Trial::new(scene, &work, run)?;
            let mut row = way.row(&trial, &way.how.command(), scene, run)?;
            row["preprocess_seconds"] = json!(before);
            rows.push(row);
            progress.advance()?;
        }
    }
    std::fs::remove_dir_all(&work)?;
    mark_front(&mut rows);
    let value = table::write(&args.output, "chart", &COLUMNS, &rows)?;
    for (file, x, title, label) in [
        ("chart", "seconds", "Accuracy against time: from masks to a field", "seconds after preprocessing"),
        ("chart-query", "query_ms", "Accuracy against time: the first answer in a view", "milliseconds"),
    ] {
        let spots: Vec<Spot> = rows.iter().map(|row| spot(row, x)).collect();
        let axes = Axes { title, x: label, y: "oracle mIoU of held-out labels" };
        plot::save(&args.output, file, &Scatter { axes, spots: &spots })?;
    }
    Ok(value)
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

/// Marks the rows of each scene that no other one beats in time and accuracy both.
fn mark_front(rows: &mut [Value]) {
    let beaten = |row: &Value, rows: &[Value]| {
        rows.iter().any(|other| {
            let [faster, better] =
                [number(other, "seconds") <= number(row, "seconds"), number(other, "oracle_miou") >= number(row, "oracle_miou")];
            let same = number(other, "seconds") == number(row, "seconds") && number(other, "oracle_miou") == number(row, "oracle_miou");
            other["scene"] == row["scene"] && faster && better && !same
        })
    };
    let front: Vec<bool> = rows.iter().map(|row| !beaten(row, rows)).collect();
    rows.iter_mut().zip(front).for_each(|(row, front)| row["pareto"] = json!(front));
}

const COLUMNS: [&str; 14] = [
    "scene",
    "way",
    "preprocess_seconds",
    "seconds",
    "query_ms",
    "oracle_miou",
    "miou",
    "loc_acc",
    "psnr",
    "objects",
    "wrong_pixels",
    "bytes",
    "pareto",
    "command",
];

fn spot(row: &Value, x: &str) -> Spot {
    let name = row["way"].as_str().unwrap_or_default().to_owned();
    let series = row["scene"].as_str().unwrap_or_default().to_owned();
    // The front is one in seconds.
    Spot { series, name, x: number(row, x), y: number(row, "oracle_miou"), front: row["pareto"] == true && x == "seconds" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let row = |scene: &str, seconds: f64, miou: f64| json!({ "scene": scene, "seconds": seconds, "oracle_miou": miou });
        let mut rows = [row("a", 1.0, 0.5), row("a", 2.0, 0.4), row("a", 3.0, 0.6), row("b", 9.0, 0.1), row("a", 1.0, 0.5)];
        mark_front(&mut rows);
        assert_eq!(rows.iter().map(|r| r["pareto"] == true).collect::<Vec<_>>(), [true, false, true, true, true]);
    }
}
