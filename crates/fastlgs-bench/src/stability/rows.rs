//! Rows of the table, and cells of the heat map.

use super::cases::{Case, Change};
use crate::plot::Cell;
use crate::table::number;
use serde_json::{Value, json};

fn mean(runs: &[Value], name: &str) -> f64 {
    runs.iter().map(|r| number(r, name)).sum::<f64>() / runs.len() as f64
}

/// Returns the row of a case: mean and worst change of the runs against the reference. For seeds,
/// the change is the worst run minus the best run.
pub fn row(scene: &str, case: &Case, reference: &Value, runs: &[Value]) -> Value {
    let points =
        |run: &Value| 100.0 * (number(run, case.measure) - number(reference, case.measure));
    let worst = runs.iter().map(points).fold(f64::INFINITY, f64::min);
    let best = runs.iter().map(points).fold(f64::NEG_INFINITY, f64::max);
    let (change, worst) = match case.change {
        Change::Seed => (worst - best, worst - best),
        _ => (
            100.0 * (mean(runs, case.measure) - number(reference, case.measure)),
            worst,
        ),
    };
    let relative = |name: &str| mean(runs, name) - number(reference, name);
    json!({
        "scene": scene, "disturbance": case.disturbance, "strength": case.strength, "runs": runs.len(), "measure": case.measure,
        "change": change, "worst": worst, "bound": -case.bound, "verdict": if change >= -case.bound { "holds" } else { "fails" },
        "oracle_miou": mean(runs, "oracle_miou"), "miou": mean(runs, "miou"), "psnr": mean(runs, "psnr"),
        "objects": mean(runs, "objects").round() as u64, "gaussians": mean(runs, "gaussians").round() as u64, "seconds": mean(runs, "seconds"),
        "changes": {
            "oracle_miou": 100.0 * relative("oracle_miou"), "miou": 100.0 * relative("miou"), "psnr": relative("psnr"),
            "objects": relative("objects"), "gaussians": relative("gaussians"),
            "seconds": if runs.iter().all(|r| r["seconds"].is_number()) { json!(relative("seconds")) } else { Value::Null },
        },
        "size": reference["size"], "adapter": reference["adapter"],
    })
}

/// Columns of the heat map.
pub const HEAT: [&str; 7] = [
    "oracle, points",
    "mIoU, points",
    "PSNR, dB",
    "objects",
    "Gaussians",
    "seconds",
    "verdict",
];

/// Returns name and cells of each row of the heat map.
pub fn heat(rows: &[Value]) -> Vec<(String, Vec<Cell>)> {
    let cells = |row: &Value| {
        let changes = &row["changes"];
        // Changes with the full colour.
        let full = [("oracle_miou", 20.0), ("miou", 20.0), ("psnr", 4.0)];
        let mut cells: Vec<Cell> = full
            .iter()
            .map(|(name, full)| Cell {
                text: format!("{:+.1}", number(changes, name)),
                shade: number(changes, name) / full,
            })
            .collect();
        for name in ["objects", "gaussians", "seconds"] {
            let text = if changes[name].is_null() {
                String::new()
            } else {
                format!("{:+.0}", number(changes, name))
            };
            cells.push(Cell { text, shade: 0.0 });
        }
        let holds = row["verdict"] == "holds";
        cells.push(Cell {
            text: format!(
                "{} {:+.0}",
                if holds { "holds" } else { "fails" },
                number(row, "bound")
            ),
            shade: if holds { 0.6 } else { -0.8 },
        });
        cells
    };
    let name = |row: &Value| {
        format!(
            "{} {}",
            row["disturbance"].as_str().unwrap_or_default(),
            row["strength"].as_str().unwrap_or_default()
        )
    };
    rows.iter().map(|row| (name(row), cells(row))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::disturb::PhotoChange;

    #[test]
    fn verdicts_follow_the_mean_and_seeds_their_spread() {
        let case = |change, bound| Case {
            disturbance: "d",
            strength: "s",
            change,
            measure: "oracle_miou",
            bound,
            quick: true,
        };
        let run = |iou: f64| json!({ "oracle_miou": iou, "miou": 0.5, "psnr": 30.0, "objects": 3, "gaussians": 10 });
        let reference = run(0.9);
        let of = |change, bound, runs: &[f64]| {
            row(
                "x",
                &case(change, bound),
                &reference,
                &runs.iter().map(|r| run(*r)).collect::<Vec<_>>(),
            )
        };
        let blurred = of(Change::Photos(PhotoChange::Blur(1.0)), 5.0, &[0.88, 0.84]);
        assert!(
            (number(&blurred, "change") + 4.0).abs() < 1e-9
                && (number(&blurred, "worst") + 6.0).abs() < 1e-9
        );
        assert_eq!(
            (
                blurred["verdict"].as_str(),
                of(Change::Seed, 1.0, &[0.9, 0.92])["verdict"].as_str()
            ),
            (Some("holds"), Some("fails"))
        );
        assert_eq!(heat(&[blurred])[0].1.len(), HEAT.len());
    }
}
