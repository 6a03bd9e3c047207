//! `fastlgs-bench chart`: accuracy against time, for several methods of making a language field
//! from masks.

use crate::plot::{self, Axes, Point, Scatter};
use crate::table::{self, number};
use crate::trial::{self, Trial};
use crate::ways::{How, Method, selected_ways};
use anyhow::Result;
use fastlgs::Run;
use fastlgs_core::SceneFolder;
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench chart scenes/fox scenes/bonsai -o out")]
pub struct Args {
    /// Trained scenes with a labels/ folder beside their photos. Default: a generated table.
    scenes: Vec<PathBuf>,
    /// Run only methods that take seconds: no long training of codes, no training of geometry.
    #[arg(long)]
    quick: bool,
    /// Run the slow methods as well: many training steps of the paper's codes, and presets that
    /// train the geometry again.
    #[arg(long, conflicts_with = "quick")]
    long: bool,
    /// Methods to run, by their names in the table, separated by commas. Default: all.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    ways: Vec<String>,
    /// Folder for chart.md, chart.csv, chart.json, and two charts as SVG and PNG.
    #[arg(short, long)]
    output: PathBuf,
}

/// Methods of the chart. Training iterations of the paper's codes are called steps.
const WAYS: [Method; 20] = [
    Method {
        name: "embeddings",
        how: How::Remap(&["--mapping", "paper", "--cues", "none"]),
        cost: 0,
    },
    Method {
        name: "+ key points",
        how: How::Remap(&["--mapping", "paper", "--cues", "keypoints"]),
        cost: 0,
    },
    Method {
        name: "+ colour (paper)",
        how: How::Remap(&["--mapping", "paper"]),
        cost: 0,
    },
    Method {
        name: "global",
        how: How::Remap(&[]),
        cost: 0,
    },
    Method {
        name: "code of 1 number",
        how: How::Baseline("code1"),
        cost: 0,
    },
    Method {
        name: "code of 2 numbers",
        how: How::Baseline("code2"),
        cost: 0,
    },
    Method {
        name: "code of 3 numbers",
        how: How::Baseline("code3"),
        cost: 0,
    },
    Method {
        name: "code of 4 numbers",
        how: How::Baseline("code4"),
        cost: 0,
    },
    Method {
        name: "no grid",
        how: How::Baseline("raw"),
        cost: 0,
    },
    Method {
        name: "like LangSplat",
        how: How::Baseline("langsplat"),
        cost: 1,
    },
    Method {
        name: "like LERF",
        how: How::Baseline("lerf"),
        cost: 1,
    },
    Method {
        name: "paper 300 steps",
        how: How::Descent("300"),
        cost: 0,
    },
    Method {
        name: "paper 1000 steps",
        how: How::Descent("1000"),
        cost: 1,
    },
    Method {
        name: "paper 3000 steps",
        how: How::Descent("3000"),
        cost: 1,
    },
    Method {
        name: "paper 7000 steps",
        how: How::Descent("7000"),
        cost: 2,
    },
    Method {
        name: "paper 30000 steps",
        how: How::Descent("30000"),
        cost: 2,
    },
    Method {
        name: "preset quick",
        how: How::Train(&["--preset", "quick"]),
        cost: 2,
    },
    Method {
        name: "preset standard",
        how: How::Train(&["--preset", "standard"]),
        cost: 2,
    },
    Method {
        name: "preset paper",
        how: How::Train(&["--preset", "paper"]),
        cost: 2,
    },
    Method {
        name: "preset like-paper",
        how: How::Train(&["--preset", "like-paper"]),
        cost: 2,
    },
];

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let most = if args.long { 2 } else { u8::from(!args.quick) };
    let ways: Vec<&Method> = selected_ways(&WAYS, &args.ways)?
        .into_iter()
        .filter(|w| w.cost <= most)
        .collect();
    let work = trial::trials_folder(&args.output)?;
    let scenes = trial::or_generated(&args.scenes, &work, run)?;
    let progress = run.work("ways", (scenes.len() * ways.len()) as u64);
    let mut rows = Vec::new();
    for scene in &scenes {
        let before: f64 = SceneFolder::open(scene)?
            .manifest()?
            .seconds
            .iter()
            .filter(|s| s.0.starts_with("preprocess."))
            .map(|s| s.1)
            .sum();
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
    let value = table::write(&args.output, "chart", &COLUMNS, &rows, "")?;
    for (file, x, title, label) in [
        (
            "chart",
            "seconds",
            "Accuracy against time: from masks to a language field",
            "seconds after preprocessing",
        ),
        (
            "chart-query",
            "query_ms",
            "Accuracy against time: first query in a view",
            "milliseconds",
        ),
    ] {
        let spots: Vec<Point> = rows.iter().map(|row| spot(row, x)).collect();
        let axes = Axes {
            title,
            x: label,
            y: "oracle mIoU of held-out labels",
        };
        plot::save(
            &args.output,
            file,
            &Scatter {
                axes,
                spots: &spots,
            },
        )?;
    }
    Ok(value)
}

/// Marks the Pareto-optimal rows of each scene: no other row is at least as fast and as accurate,
/// and better in one of the two.
fn mark_front(rows: &mut [Value]) {
    let is_dominated = |row: &Value, rows: &[Value]| {
        rows.iter().any(|other| {
            let [faster, better] = [
                number(other, "seconds") <= number(row, "seconds"),
                number(other, "oracle_miou") >= number(row, "oracle_miou"),
            ];
            let same = number(other, "seconds") == number(row, "seconds")
                && number(other, "oracle_miou") == number(row, "oracle_miou");
            other["scene"] == row["scene"] && faster && better && !same
        })
    };
    let front: Vec<bool> = rows.iter().map(|row| !is_dominated(row, rows)).collect();
    rows.iter_mut()
        .zip(front)
        .for_each(|(row, front)| row["pareto"] = json!(front));
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

fn spot(row: &Value, x: &str) -> Point {
    let name = row["way"].as_str().unwrap_or_default().to_owned();
    let series = row["scene"].as_str().unwrap_or_default().to_owned();
    // The Pareto front is computed for the column `seconds` only.
    Point {
        series,
        name,
        x: number(row, x),
        y: number(row, "oracle_miou"),
        front: row["pareto"] == true && x == "seconds",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pareto_front_has_all_rows_that_no_row_dominates() {
        let row = |scene: &str, seconds: f64, miou: f64| json!({ "scene": scene, "seconds": seconds, "oracle_miou": miou });
        let mut rows = [
            row("a", 1.0, 0.5),
            row("a", 2.0, 0.4),
            row("a", 3.0, 0.6),
            row("b", 9.0, 0.1),
            row("a", 1.0, 0.5),
        ];
        mark_front(&mut rows);
        assert_eq!(
            rows.iter().map(|r| r["pareto"] == true).collect::<Vec<_>>(),
            [true, false, true, true, true]
        );
    }
}
