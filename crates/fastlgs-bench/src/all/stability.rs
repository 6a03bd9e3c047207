//! The page of disturbed inputs and difficult scenes.

use super::figures::{Mean, Runs, distinct, given};
use super::markdown::{HOW_TO_READ, stamp, table};
use super::plan::{BASE, How, Page, UNCHANGED, Way, on};
use super::rows::Rows;
use crate::plot::{self, Cell, HeatMap};
use anyhow::Result;

/// Returns the disturbances, worst first, with the change of the measure on each given scene.
fn disturbances(rows: &Rows) -> Vec<(String, Vec<Option<Mean>>)> {
    let scenes = given(rows);
    let mut found = Vec::new();
    for way in on(Page::Stability).filter(|way| ![BASE, UNCHANGED, "as it is"].contains(&way.name))
    {
        let reference = match way.how {
            How::Photos(_) => UNCHANGED,
            How::Remap(_) => "paper's mapping",
            _ => BASE,
        };
        let change = |scene: &&str| {
            let runs = Runs::of(rows, scene, way.name)?;
            runs.change(figure_of(way), &Runs::of(rows, scene, reference)?)
        };
        let changes: Vec<Option<Mean>> = scenes.iter().map(change).collect();
        if changes.iter().any(Option::is_some) {
            let unit = if figure_of(way) == "miou" {
                " (text)"
            } else {
                ""
            };
            found.push((format!("{}{unit}", way.name), changes));
        }
    }
    let worst = |row: &(String, Vec<Option<Mean>>)| {
        let means = row.1.iter().flatten().map(|change| change.mean);
        means.fold(f64::INFINITY, f64::min)
    };
    found.sort_by(|a, b| worst(a).total_cmp(&worst(b)));
    found
}

/// Returns the figure that a disturbance changes: noise on embeddings changes texts alone.
fn figure_of(way: &Way) -> &'static str {
    match way.how {
        How::Embeddings(_) => "miou",
        _ => "oracle_miou",
    }
}

/// Points of a change with the full colour.
const FULL_COLOUR: f64 = 20.0;

fn cell(change: Option<Mean>) -> Cell {
    Cell {
        text: change.map_or(String::new(), |c| format!("{:+.1}", c.mean)),
        shade: change.map_or(0.0, |c| c.mean / FULL_COLOUR),
    }
}

pub fn page(rows: &Rows) -> String {
    let scenes = given(rows);
    let found = disturbances(rows);
    let line = |(name, changes): &(String, Vec<Option<Mean>>)| {
        let cells = changes
            .iter()
            .map(|c| c.map_or(String::new(), |c| c.text(1)));
        std::iter::once(name.clone()).chain(cells).collect()
    };
    let head: Vec<&str> = std::iter::once("disturbance").chain(scenes).collect();
    let lines: Vec<Vec<String>> = found.iter().map(line).collect();
    let mut difficult: Vec<(f64, Vec<String>)> = Vec::new();
    for scene in distinct(rows, "scene") {
        let way = if Runs::of(rows, scene, "as it is").is_some() {
            "as it is"
        } else {
            BASE
        };
        if let Some(runs) = Runs::of(rows, scene, way)
            && let Some(best) = runs.mean("oracle_miou")
        {
            difficult.push((
                best.mean,
                vec![
                    scene.to_owned(),
                    runs.0.len().to_string(),
                    best.text(2),
                    runs.text("miou", 2),
                    runs.text("psnr", 1),
                    runs.text("objects", 0),
                ],
            ));
        }
    }
    difficult.sort_by(|a, b| a.0.total_cmp(&b.0));
    let difficult: Vec<Vec<String>> = difficult.into_iter().map(|line| line.1).collect();
    format!(
        "# Stability\n\n{}\n{HOW_TO_READ}\n## Disturbed inputs, worst first\n\nChange of *best object* in points (hundredths of \
         IoU) against the same seed without the disturbance; *(text)*: of *text*. Disturbed photos are those of training; labelled views \
         stay as they are. Poses of disturbed photos are checked and refined as usual.\n\n![changes](stability.svg)\n\n{}\n## Scenes, worst \
         first\n\n{}",
        stamp(rows),
        table(&head, &lines),
        table(
            &[
                "scene",
                "seeds",
                "best object",
                "text",
                "PSNR, dB",
                "objects"
            ],
            &difficult
        )
    )
}

/// Returns a heat map of the disturbances as SVG.
pub fn chart(rows: &Rows) -> Result<String> {
    let scenes = given(rows);
    let heat = HeatMap {
        title: "Change of the best objects' IoU in points: red is lost, worst first",
        columns: &scenes,
        rows: &disturbances(rows)
            .iter()
            .map(|(name, changes)| (name.clone(), changes.iter().map(|c| cell(*c)).collect()))
            .collect::<Vec<_>>(),
    };
    plot::svg(&heat)
}
