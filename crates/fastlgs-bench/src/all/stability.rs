//! The page of disturbed inputs and difficult scenes.

use super::figures::{Mean, Runs, distinct, labelled, signed};
use super::markdown::{MEANS, TEXT, stamp, table};
use super::rows::Rows;
use super::ways::{BASE, How, Page, UNCHANGED, Way, on};
use crate::plot::{self, Cell, HeatMap};
use anyhow::Result;

/// Returns the disturbances, worst first, with the change of the measure on each given scene.
pub fn disturbances(rows: &Rows) -> Vec<(String, Vec<Option<Mean>>)> {
    let scenes = labelled(rows);
    let mut found = Vec::new();
    for way in on(Page::Stability).filter(|way| ![BASE, "as it is"].contains(&way.name)) {
        let change = |scene: &&str| {
            let runs = Runs::of(rows, scene, way.name)?;
            let change = runs.change(figure_of(way), &Runs::of(rows, scene, way.reference())?)?;
            Some(change.times(100.0))
        };
        let changes: Vec<Option<Mean>> = scenes.iter().map(change).collect();
        if changes.iter().any(Option::is_some) {
            let note = match way.name {
                UNCHANGED => " (against quick)",
                _ if figure_of(way) == "miou" => " (answers to texts)",
                _ => "",
            };
            found.push((format!("{}{note}", way.name), changes));
        }
    }
    let worst = |row: &(String, Vec<Option<Mean>>)| {
        let means = row.1.iter().flatten().map(|change| change.mean);
        means.fold(f64::INFINITY, f64::min)
    };
    found.sort_by(|a, b| worst(a).total_cmp(&worst(b)));
    found
}

/// Returns the undisturbed rows of a scene.
pub fn as_it_is<'a>(rows: &'a Rows, scene: &str) -> Option<Runs<'a>> {
    Runs::of(rows, scene, "as it is").or_else(|| Runs::of(rows, scene, BASE))
}

/// Returns all scenes with labels and the IoU of their best objects, worst first.
pub fn scenes(rows: &Rows) -> Vec<(&str, Mean)> {
    let best = |scene| Some((scene, as_it_is(rows, scene)?.mean("oracle_miou")?));
    let mut found: Vec<(&str, Mean)> = distinct(rows, "scene")
        .into_iter()
        .filter_map(best)
        .collect();
    found.sort_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
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
        text: change.map_or(String::new(), |c| signed(c.mean, 1)),
        shade: change.map(|c| c.mean / FULL_COLOUR),
    }
}

pub fn page(rows: &Rows) -> String {
    let scenes = labelled(rows);
    let found = disturbances(rows);
    let line = |(name, changes): &(String, Vec<Option<Mean>>)| {
        let cells = changes
            .iter()
            .map(|c| c.map_or(String::new(), |c| c.signed(1)));
        std::iter::once(name.clone()).chain(cells).collect()
    };
    let head: Vec<&str> = std::iter::once("disturbance").chain(scenes).collect();
    let lines: Vec<Vec<String>> = found.iter().map(line).collect();
    let line = |(scene, best): (&str, Mean)| {
        let runs = as_it_is(rows, scene)?;
        Some(vec![
            scene.to_owned(),
            runs.rows.len().to_string(),
            best.text(2),
            runs.text("miou", 2),
            runs.text("psnr", 1),
            runs.text("objects", 0),
        ])
    };
    let difficult: Vec<Vec<String>> = self::scenes(rows).into_iter().filter_map(line).collect();
    format!(
        "# Stability\n\n{}\n{MEANS}{TEXT}\n\n## Disturbed inputs, worst first\n\nChange of *best object* in points (hundredths of \
         IoU) against the same seed without the disturbance; *answers to texts*: of *text*. Changed photos are compared with *photos as they are*. Its own difference \
         from *quick* is that of two runs. Poses of changed photos are checked and refined as usual; labelled views stay as they are, with their poses. \
         Changed masks are mapped to Gaussians that were trained before, those of *table* with the exact masks. \
         [What each disturbance is](README.md#ways).\n\n![changes](stability.svg)\n\n{}\n## Scenes, worst \
         first\n\nWhere [labels join several objects](../research/evaluation.md#scenes), as many of the apartment do, no single object covers them.\n\n{}",
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
    let scenes = labelled(rows);
    let heat = HeatMap {
        title: "IoU that best objects (or answers to texts) lose (red) or gain, in hundredths. Grey: not measured",
        columns: &scenes,
        rows: &disturbances(rows)
            .iter()
            .map(|(name, changes)| (name.clone(), changes.iter().map(|c| cell(*c)).collect()))
            .collect::<Vec<_>>(),
    };
    plot::svg(&heat, stamp(rows).trim_end())
}
