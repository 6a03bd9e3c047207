//! `fastlgs-bench paper`: repeats the paper's ablations and lists the paper's figures.

use crate::table;
use crate::trial::{self, Trial};
use crate::ways::{How, Method, selected_ways};
use anyhow::Result;
use fastlgs::{Run, Scene};
use fastlgs_grid::query::Hit;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench paper scenes/table scenes/fox -o out --device cpu")]
pub struct Args {
    /// Trained scenes with a labels/ folder beside their photos. Default: a generated table.
    scenes: Vec<PathBuf>,
    /// Iterations of the rows that train the whole scene.
    #[arg(long, default_value_t = 2000)]
    iterations: u32,
    /// Rows to run, by their names in the table, separated by commas. Default: all.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    ways: Vec<String>,
    /// Folder for paper.md, paper.csv and paper.json.
    #[arg(short, long)]
    output: PathBuf,
}

/// Image size of the last row of the paper's speed table, in pixels.
const LARGE_VIEW: (u32, u32) = (1440, 1080);

/// The rows of the paper's ablation tables. Rows for matching, field and codes keep the Gaussians
/// of the scene.
const WAYS: [Method; 11] = [
    Method::new(
        "matching: embeddings",
        How::Remap(&["--mapping", "paper", "--cues", "none"]),
    ),
    Method::new(
        "matching: + key points",
        How::Remap(&["--mapping", "paper", "--cues", "keypoints"]),
    ),
    Method::new("matching: + colour", How::Remap(&["--mapping", "paper"])),
    Method::new("field: embeddings", How::Baseline("raw")),
    Method::new("field: codes of embeddings", How::Baseline("langsplat")),
    Method::new("codes: 1 number", How::Baseline("code1")),
    Method::new("codes: 2 numbers", How::Baseline("code2")),
    Method::new("codes: 3 numbers", How::Baseline("code3")),
    Method::new("codes: 4 numbers", How::Baseline("code4")),
    Method::new("all: as the paper", How::Train(&["--preset", "like-paper"])),
    Method::new("all: by default", How::Train(&[])),
];

/// The paper's own figures, measured on a TITAN RTX.
const PAPER_FIGURES: &str = "
Figures of the paper, on other scenes (SPIn-NeRF's and its own), with CLIP, SAM and a TITAN RTX:

| | mIoU | mAcc | seconds a query | MB |
| --- | --- | --- | --- | --- |
| matching: embeddings | 0.752 | 0.832 | | |
| matching: + key points | 0.875 | 0.918 | | |
| matching: + colour | 0.921 | 0.975 | | |
| field: embeddings (NeRF) | 0.833 | | 20.1 | |
| field: embeddings (Gaussians) | out of memory | | | |
| field: grid | 0.951 | | 0.98 | |
| 1440x1080 | | | 0.52 | 200 |
";

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let ways = selected_ways(&WAYS, &args.ways)?;
    let work = trial::trials_folder(&args.output)?;
    let scenes = trial::or_generated(&args.scenes, &work, run)?;
    let progress = run.work("ways", (scenes.len() * ways.len()) as u64);
    let iterations = args.iterations.to_string();
    let mut rows = Vec::new();
    for scene in &scenes {
        for way in &ways {
            let trial = Trial::new(scene, &work, run)?;
            let mut command = way.how.command();
            if let How::Train(_) = way.how {
                command.extend(["--iterations", &iterations]);
            }
            let mut row = way.row(&trial, &command, scene, run)?;
            if !matches!(way.how, How::Baseline(_)) {
                row["large_ms"] = json!(large_query_ms(&trial.scene().root, run)?);
            }
            rows.push(row);
            progress.advance()?;
        }
    }
    std::fs::remove_dir_all(&work)?;
    table::write(&args.output, "paper", &COLUMNS, &rows, PAPER_FIGURES)
}

/// Returns the milliseconds for the mask of one object in a new view of 1440x1080. The object is
/// the one that most views show.
fn large_query_ms(scene: &Path, run: &Run) -> Result<f64> {
    let mut session = Scene::open(scene, run.device)?;
    session.warm_up()?;
    let grid = session.grid()?;
    let target: Vec<Hit> = grid
        .objects
        .iter()
        .max_by_key(|o| o.views)
        .map(|o| Hit {
            id: o.id,
            score: 1.0,
        })
        .into_iter()
        .collect();
    let camera = session.cameras()[0].resized(LARGE_VIEW.0, LARGE_VIEW.1);
    let started = Instant::now();
    session.field(&camera, None)?.mask(&grid, &target);
    Ok(started.elapsed().as_secs_f64() * 1e3)
}

const COLUMNS: [&str; 14] = [
    "scene",
    "way",
    "seconds",
    "query_ms",
    "large_ms",
    "oracle_miou",
    "miou",
    "macc",
    "loc_acc",
    "psnr",
    "objects",
    "gaussians",
    "bytes",
    "command",
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_names_are_unique() {
        let mut names: Vec<&str> = WAYS.iter().map(|w| w.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), WAYS.len());
        assert!(WAYS.iter().all(|w| w.how.command().contains(&"SCENE")));
    }
}
