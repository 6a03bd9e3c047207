//! `fastlgs bench chart`: accuracy against time, for the ways from masks to a field that answers.

use super::plot::{self, Axes, Spot};
use super::trial::Trial;
use crate::{Outcome, report, ui};
use anyhow::Result;
use fastlgs_core::fs;
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench chart scenes/fox scenes/bonsai -o out")]
pub struct Args {
    /// Trained scenes whose photos have labels/ beside them.
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Only what takes seconds: no long descents, no training of geometry.
    #[arg(long)]
    quick: bool,
    /// Also the presets, which train geometry anew.
    #[arg(long, conflicts_with = "quick")]
    presets: bool,
    /// Folder for chart.svg, chart.md, chart.csv and chart.json.
    #[arg(short, long)]
    output: PathBuf,
}

/// A way from masks to a field, and what `train` is given for it.
struct Way {
    name: &'static str,
    args: &'static [&'static str],
    /// How long it takes: 0 seconds, 1 minutes, 2 geometry anew.
    cost: u8,
}

/// Geometry and colour stay as they are in the scene; objects and field are made anew.
const WAYS: [Way; 10] = [
    Way {
        name: "embeddings",
        args: &["--init-ply", "SCENE/scene.ply", "--iterations", "0", "--mapping", "paper", "--cues", "none"],
        cost: 0,
    },
    Way {
        name: "+ key points",
        args: &["--init-ply", "SCENE/scene.ply", "--iterations", "0", "--mapping", "paper", "--cues", "keypoints"],
        cost: 0,
    },
    Way { name: "+ colour (paper)", args: &["--init-ply", "SCENE/scene.ply", "--iterations", "0", "--mapping", "paper"], cost: 0 },
    Way { name: "global", args: &["--init-ply", "SCENE/scene.ply", "--iterations", "0"], cost: 0 },
    Way {
        name: "paper, 300 steps",
        args: &["--init-ply", "SCENE/scene.ply", "--freeze", "--feature-mode", "train", "--mapping", "paper", "--iterations", "300"],
        cost: 0,
    },
    Way {
        name: "paper, 1,000 steps",
        args: &["--init-ply", "SCENE/scene.ply", "--freeze", "--feature-mode", "train", "--mapping", "paper", "--iterations", "1000"],
        cost: 1,
    },
    Way {
        name: "paper, 3,000 steps",
        args: &["--init-ply", "SCENE/scene.ply", "--freeze", "--feature-mode", "train", "--mapping", "paper", "--iterations", "3000"],
        cost: 1,
    },
    Way { name: "quick", args: &["--preset", "quick"], cost: 2 },
    Way { name: "standard", args: &["--preset", "standard"], cost: 2 },
    Way { name: "paper preset", args: &["--preset", "paper", "--mapping", "paper", "--feature-mode", "train"], cost: 2 },
];

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let most = if args.presets { 2 } else { u8::from(!args.quick) };
    let ways: Vec<&Way> = WAYS.iter().filter(|w| w.cost <= most).collect();
    let bar = ui::bar(common, (args.scenes.len() * ways.len()) as u64, "ways");
    let mut rows = Vec::new();
    for scene in &args.scenes {
        for way in &ways {
            let trial = Trial::new(scene, common)?;
            let [trained, scored] = trial.train_and_eval(way.args)?;
            rows.push(row(scene.display().to_string(), way, &trained, &scored));
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    mark_front(&mut rows);
    for (file, content) in [("chart.md", table(&rows, " | ", true)), ("chart.csv", table(&rows, ",", false))] {
        fs::write_atomic(&args.output.join(file), |out| std::io::Write::write_all(out, content.as_bytes()))?;
    }
    let spots: Vec<Spot> = rows.iter().map(spot).collect();
    let axes = Axes { title: "Accuracy against time: from masks to a field", x: "seconds", y: "oracle mIoU of held-out labels" };
    plot::scatter(&args.output.join("chart.svg"), &axes, &spots)?;
    let value = json!({ "rows": rows, "chart": args.output.join("chart.svg") });
    fs::write_json(&args.output.join("chart.json"), &value)?;
    report::give(common, &value)?;
    Ok(Outcome::Done)
}

fn row(scene: String, way: &Way, trained: &Value, scored: &Value) -> Value {
    let seconds = trained["seconds"].as_f64().unwrap_or(0.0) + trained["mapping_seconds"].as_f64().unwrap_or(0.0);
    json!({
        "scene": scene,
        "way": way.name,
        "seconds": seconds,
        "oracle_miou": scored["oracle_miou"],
        "miou": scored["miou"],
        "text_top1": scored["text_top1"],
        "loc_acc": scored["loc_acc"],
        "psnr": scored["psnr"],
        "objects": scored["objects"],
        "gaussians": scored["gaussians"],
        "scene_bytes": scored["scene_bytes"],
        "size": scored["size"],
        "adapter": scored["adapter"],
        "command": format!("fastlgs train {scene} {}", way.args.join(" ").replace("SCENE/", &format!("{scene}/"))),
    })
}

fn number(row: &Value, name: &str) -> f64 {
    row[name].as_f64().unwrap_or(0.0)
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

const COLUMNS: [&str; 11] =
    ["scene", "way", "seconds", "oracle_miou", "miou", "text_top1", "loc_acc", "objects", "scene_bytes", "pareto", "command"];

/// The rows as Markdown (`framed`) or CSV.
fn table(rows: &[Value], between: &str, framed: bool) -> String {
    let line = |cells: Vec<String>| if framed { format!("| {} |\n", cells.join(between)) } else { format!("{}\n", cells.join(between)) };
    let cell = |row: &Value, name: &str| match &row[name] {
        Value::String(text) if framed => text.clone(),
        Value::String(text) => format!("\"{text}\""),
        Value::Number(n) if n.is_f64() => format!("{:.3}", n.as_f64().unwrap_or(f64::NAN)),
        other => other.to_string(),
    };
    let mut out = line(COLUMNS.iter().map(|c| (*c).to_owned()).collect());
    if framed {
        out += &line(COLUMNS.iter().map(|_| "---".to_owned()).collect());
    }
    rows.iter().for_each(|row| out += &line(COLUMNS.iter().map(|c| cell(row, c)).collect()));
    out
}

fn spot(row: &Value) -> Spot {
    let name = row["way"].as_str().unwrap_or_default().to_owned();
    Spot {
        series: row["scene"].as_str().unwrap_or_default().to_owned(),
        name,
        x: number(row, "seconds"),
        y: number(row, "oracle_miou"),
        front: row["pareto"] == true,
    }
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
