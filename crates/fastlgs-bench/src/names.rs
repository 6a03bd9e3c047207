//! `fastlgs-bench names`: accuracy of text queries on scenes that the calibration has not seen.
//!
//! For each scene, the text calibration is measured on all other scenes (left out) and on all
//! scenes (seen). The gap in mIoU shows how much the calibration depends on the tested scene.

use crate::labelled::Labelled;
use crate::table;
use crate::trial::name;
use anyhow::{Context, Result, bail};
use fastlgs::calibrations::Calibrations;
use fastlgs::{Run, Scene, calibrate, eval};
use fastlgs_core::{labels, metrics};
use fastlgs_grid::calibration::{Calibration, Samples};
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs-bench names scenes/fox scenes/office --labels photos/fox/labels,photos/office/labels -o out"
)]
pub struct Args {
    #[command(flatten)]
    labelled: Labelled,
    /// Folder for names.md, names.csv and names.json.
    #[arg(short, long)]
    output: Option<PathBuf>,
}

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let scenes = args.labelled.pairs()?;
    if scenes.len() < 2 {
        bail!("one scene leaves no other scene for the calibration; name at least two");
    }
    let work = run.work("names", 3 * scenes.len() as u64);
    let mut samples = Vec::new();
    for (root, folder) in &scenes {
        samples.push(calibrate::samples_of(
            &mut Scene::open(root, run.device)?,
            &labels::load(folder, None)?,
        )?);
        work.advance()?;
    }
    let mut rows = Vec::new();
    let (mut present, mut absent) = (Vec::new(), Vec::new());
    for (place, (root, folder)) in scenes.iter().copied().enumerate() {
        let samples_without = |left_out: Option<usize>| {
            samples
                .iter()
                .enumerate()
                .filter(move |(k, _)| Some(*k) != left_out)
                .map(|s| s.1)
        };
        let evaluated = |left_out: Option<usize>| -> Result<(Calibration, eval::EvalReport)> {
            let mut scene = Scene::open(root, run.device)?;
            let own = Calibrations::of(scene.manifest());
            let measured = calibration_of(samples_without(left_out), own.texts.anything);
            let texts = measured.with_context(|| format!("{}: the labels of the other scenes are too few or do not separate objects; add scenes", root.display()))?;
            scene.set_calibrations(Calibrations { texts, ..own });
            let config = eval::EvalConfig {
                scene: root.into(),
                labels: Some(folder.into()),
                ..eval::EvalConfig::default()
            };
            let report = eval::eval_scene(scene, &config)?;
            work.advance()?;
            Ok((texts, report))
        };
        let (texts, left_out) = evaluated(Some(place))?;
        let (of_all, seen) = evaluated(None)?;
        present.extend(left_out.present_scores.values());
        absent.extend(left_out.absent_scores.values());
        rows.push(json!({
            "scene": name(root),
            "labels": left_out.labels_scored,
            "objects": left_out.objects,
            "oracle_miou": left_out.oracle_miou,
            "miou_left_out": left_out.miou,
            "miou_seen": seen.miou,
            "first_left_out": left_out.oracle_ranked[0],
            "first_seen": seen.oracle_ranked[0],
            "absent_rejected_left_out": rejected(&left_out),
            "absent_rejected_seen": rejected(&seen),
            "auroc": left_out.absent_auroc,
            "outcomes_left_out": left_out.outcomes,
            "calibration_left_out": texts,
            "calibration_seen": of_all,
        }));
    }
    let mean = |column: &str| {
        rows.iter()
            .map(|row| table::number(row, column))
            .sum::<f64>()
            / rows.len() as f64
    };
    let (left_out, seen) = (mean("miou_left_out"), mean("miou_seen"));
    if let Some(folder) = &args.output {
        table::write(folder, "names", &COLUMNS, &rows)?;
    }
    Ok(json!({
        "rows": rows,
        "miou_left_out": left_out,
        "miou_seen": seen,
        "gap": seen - left_out,
        "auroc_pooled": metrics::auroc(&present, &absent),
        "found_at_5_percent": found_at(0.05, &present, absent),
    }))
}

/// Returns the fraction of present names that score above the threshold. The threshold lets the
/// fraction `false_alarms` of the absent names pass.
fn found_at(false_alarms: f64, present: &[f64], mut absent: Vec<f64>) -> f64 {
    absent.sort_by(f64::total_cmp);
    let allowed = (false_alarms * absent.len() as f64) as usize;
    let threshold = absent.iter().rev().nth(allowed).copied().unwrap_or(0.0);
    present.iter().filter(|score| **score > threshold).count() as f64 / present.len().max(1) as f64
}

const COLUMNS: [&str; 9] = [
    "scene",
    "labels",
    "objects",
    "oracle_miou",
    "miou_left_out",
    "miou_seen",
    "absent_rejected_left_out",
    "absent_rejected_seen",
    "auroc",
];

fn rejected(report: &eval::EvalReport) -> f64 {
    report.absent_rejected as f64 / report.absent_texts.max(1) as f64
}

/// Measures a calibration on the samples of all given scenes. `None` if they are too few.
fn calibration_of<'a>(
    scenes: impl Iterator<Item = &'a Samples>,
    anything: f32,
) -> Option<Calibration> {
    let mut all = Samples::default();
    scenes.for_each(|scene| all.extend(scene));
    Calibration::measured(&all, anything)
}
