//! Tables and charts of `fastlgs-bench all`, made from its rows alone.

use super::figures::{Mean, Runs, distinct, given, labelled};
use super::markdown::{HOW_TO_READ, stamp, table};
use super::plan::{BASE, Page, UNLIMITED, Way, on};
use super::rows::Rows;
use super::stability;
use super::{summary, texts};
use crate::plot::{self, Axes, Panel, Panels, Point};
use anyhow::Result;
use std::fmt::Write as _;

/// Returns name and text of all files.
pub fn all(rows: &Rows) -> Result<Vec<(String, String)>> {
    let mut files = vec![
        ("README.md".to_owned(), index(rows)),
        ("texts.md".to_owned(), texts::page(rows)),
        ("speed.md".to_owned(), speed(rows)),
        ("stability.md".to_owned(), stability::page(rows)),
        ("size.md".to_owned(), size(rows)),
        ("paper.md".to_owned(), paper(rows)),
    ];
    let best = |runs: &Runs| runs.mean("oracle_miou");
    let charts = [
        (
            "speed.svg",
            panels(rows, Page::Speed, |runs| runs.seconds(None), best),
            "Accuracy against time: from photos to answers",
            "seconds",
            "best object, mean IoU",
        ),
        (
            "query.svg",
            panels(rows, Page::Speed, |runs| runs.mean("query_ms_first"), best),
            "Accuracy against time: first answer in a view",
            "milliseconds",
            "best object, mean IoU",
        ),
        (
            "size.svg",
            panels(rows, Page::Size, megabytes, best),
            "Accuracy against size",
            "megabytes",
            "best object, mean IoU",
        ),
        (
            "size-psnr.svg",
            panels(rows, Page::Size, megabytes, |runs| runs.mean("psnr")),
            "Colour against size",
            "megabytes",
            "PSNR of held-out views, dB",
        ),
    ];
    for (name, panels, title, x, y) in charts {
        let axes = Axes { title, x, y };
        files.push((
            name.to_owned(),
            plot::svg(&Panels { axes, panels }, stamp(rows).trim_end())?,
        ));
    }
    files.push(("stability.svg".to_owned(), stability::chart(rows)?));
    Ok(files)
}

fn megabytes(runs: &Runs) -> Option<Mean> {
    Some(runs.mean("scene_bytes")?.times(1e-6))
}

/// Returns a panel for each given scene: the ways of these pages, with their Pareto front.
fn panels(
    rows: &Rows,
    page: Page,
    x: impl Fn(&Runs) -> Option<Mean>,
    y: impl Fn(&Runs) -> Option<Mean>,
) -> Vec<Panel> {
    let point = |scene: &str, way: &Way| {
        let runs = Runs::of(rows, scene, way.name)?;
        let y = y(&runs)?;
        Some(Point {
            name: way.name.to_owned(),
            x: x(&runs)?.mean,
            y: y.mean,
            range: (y.low, y.high),
            front: false,
        })
    };
    let panel = |scene: &str| {
        let mut points: Vec<Point> = on(page).filter_map(|way| point(scene, way)).collect();
        mark_front(&mut points);
        Panel {
            name: scene.to_owned(),
            points,
        }
    };
    let panels = given(rows).into_iter().map(panel);
    panels.filter(|panel| panel.points.len() > 1).collect()
}

/// Marks the Pareto-optimal points: no other point has at most its x and at least its y.
fn mark_front(points: &mut [Point]) {
    let all: Vec<(f64, f64)> = points.iter().map(|p| (p.x, p.y)).collect();
    for point in points {
        let dominates = |other: &(f64, f64)| {
            other.0 <= point.x && other.1 >= point.y && *other != (point.x, point.y)
        };
        point.front = !all.iter().any(dominates);
    }
}

fn index(rows: &Rows) -> String {
    let scenes = distinct(rows, "scene").join(", ");
    let mut text = format!(
        "# Results\n\n{}\nPhotos have at most 480 pixels a side; every eighth view is held out. Generated scenes \
         have 480x360 pixels and exact masks.\n\n",
        stamp(rows)
    );
    for (page, about) in [
        ("speed", "accuracy against time"),
        ("texts", "answers to texts"),
        (
            "stability",
            "disturbed photos and masks, and difficult scenes",
        ),
        ("size", "accuracy against size"),
        ("paper", "the paper's ablations"),
    ] {
        let _ = writeln!(text, "- [{page}.md]({page}.md): {about}");
    }
    text += "- [peers](../research/peers.md): OpenSplat and Brush, measured by hand\n";
    let _ = write!(
        text,
        "\n## What fails\n\n{}\n## All ways\n\nEach against *{BASE}*, the default, with the same seed; fewer photos \
         against the photos as they are. Mean over the scenes, with their range in brackets. *Time*: from photos to \
         answers. *Size*: all files that a query needs. *Best object*: IoU of the best single object, *text*: IoU of \
         the answer to a label's name, both in points (hundredths).\n\n{}",
        summary::failures(rows),
        summary::changes(rows)
    );
    let _ = write!(
        text,
        "\n## Make them again\n\nScenes: {scenes}; {} rows in [rows.json](rows.json). One command makes all rows that are missing, and \
         all pages. The second makes one row again, in another folder:\n\n```sh\nfastlgs-bench all --scenes {} --clip clip -o docs/results \
         --readme README.md --device cpu\nfastlgs-bench all --scenes fox --ways \"blur 2 px\" --seeds 1 -o again --device cpu\n```\n\n\
         Names of scenes are folders of photos with `labels/` beside them, or kinds of generated scenes. \
         `clip` is a folder of CLIP embeddings for `fastlgs-bench clip`.\n",
        rows.rows.len(),
        given(rows).join(","),
    );
    text
}

fn speed(rows: &Rows) -> String {
    let mut lines = Vec::new();
    let chart = panels(
        rows,
        Page::Speed,
        |runs| runs.seconds(None),
        |runs| runs.mean("oracle_miou"),
    );
    for panel in chart {
        let mut points = panel.points;
        points.sort_by(|a, b| a.x.total_cmp(&b.x));
        for point in points {
            let Some(runs) = Runs::of(rows, &panel.name, &point.name) else {
                continue;
            };
            let stage = |stage: &str| {
                runs.seconds(Some(stage))
                    .map_or(String::new(), |s| format!("{:.0}", s.mean))
            };
            lines.push(vec![
                panel.name.clone(),
                point.name.clone(),
                runs.0.len().to_string(),
                format!("{:.0}", point.x),
                ["preprocess", "train", "objects"].map(stage).join(" + "),
                runs.mean("query_ms_first")
                    .map_or(String::new(), |ms| format!("{:.0}", ms.mean)),
                runs.text("oracle_miou", 2),
                runs.text("miou", 2),
                runs.text("psnr", 1),
                runs.text("gaussians", 0),
                if point.front { "front" } else { "" }.to_owned(),
            ]);
        }
    }
    let head = [
        "scene",
        "way",
        "seeds",
        "seconds",
        "preprocess + train + objects",
        "ms of a query",
        "best object",
        "text",
        "PSNR, dB",
        "Gaussians",
        "",
    ];
    format!(
        "# Speed against accuracy\n\n{}\n{HOW_TO_READ}*front*: no other way is as fast and as accurate. Fields \
         without objects (*mean embeddings*, *like LangSplat*, *like LERF*) are built after the papers' ideas; their best \
         object is the best threshold for each label. PSNR of *side 240* and *side 720* is that of photos of this side; with \
         photos missing, it is that of the labelled views alone.\n\n![accuracy against seconds](speed.svg)\n\n\
         ![accuracy against milliseconds of a query](query.svg)\n\n{}",
        stamp(rows),
        table(&head, &lines)
    )
}

fn size(rows: &Rows) -> String {
    let mut lines = Vec::new();
    for scene in given(rows) {
        for way in on(Page::Size) {
            if let Some(runs) = Runs::of(rows, scene, way.name) {
                let name = if way.name == BASE {
                    "automatic limit (quick)"
                } else {
                    way.name
                };
                lines.push(vec![
                    scene.to_owned(),
                    name.to_owned(),
                    runs.0.len().to_string(),
                    runs.text("gaussians", 0),
                    megabytes(&runs).map_or(String::new(), |m| m.text(1)),
                    runs.text("psnr", 2),
                    runs.text("oracle_miou", 3),
                ]);
            }
        }
    }
    let head = [
        "scene",
        "model",
        "seeds",
        "Gaussians",
        "MB",
        "PSNR, dB",
        "best object",
    ];
    format!(
        "# Size against accuracy\n\n{}\n{HOW_TO_READ}*MB*: all files that a query needs.\n\n![accuracy against \
         size](size.svg)\n\n![colour against size](size-psnr.svg)\n\n{}{}",
        stamp(rows),
        table(&head, &lines),
        limits(rows)
    )
}

/// Returns where the automatic limit of the number of Gaussians stops, and what it costs there.
fn limits(rows: &Rows) -> String {
    let line = |scene: &str| {
        let limited = Runs::of(rows, scene, BASE)?;
        let free = Runs::of(rows, scene, UNLIMITED)?;
        let more = free.ratio(|row| row["gaussians"].as_f64(), &limited);
        let colour = free.change("psnr", &limited);
        let objects = free.change("oracle_miou", &limited);
        let points = objects.map(|change| change.times(100.0));
        let text = |mean: Option<Mean>, digits| mean.map_or(String::new(), |m| m.text(digits));
        Some(vec![
            scene.to_owned(),
            limited.text("gaussians", 0),
            text(more, 2),
            text(colour, 2),
            text(points, 1),
        ])
    };
    let lines: Vec<Vec<String>> = given(rows).into_iter().filter_map(line).collect();
    if lines.is_empty() {
        return String::new();
    }
    let head = [
        "scene",
        "Gaussians",
        "without the limit: times as many",
        "dB gained",
        "points of best object gained",
    ];
    format!(
        "\n## Where the automatic limit stops\n\nThe limit removes the Gaussians that \
         together add a twentieth to the remaining squared error of the training views ([how it \
         works](../how-it-works.md)). What all of them gain in held-out views:\n\n{}",
        table(&head, &lines)
    )
}

/// The paper's own figures.
const PAPER_FIGURES: &str = "
## The paper's own figures

Of other scenes (SPIn-NeRF's and its own), with CLIP, SAM and a TITAN RTX:

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

fn paper(rows: &Rows) -> String {
    let scenes = labelled(rows);
    let mut lines = Vec::new();
    for way in on(Page::Paper) {
        let mut line = vec![way.name.to_owned()];
        for scene in &scenes {
            let text = Runs::of(rows, scene, way.name).map_or(String::new(), |runs| {
                format!("{}; {}", runs.text("oracle_miou", 2), runs.text("miou", 2))
            });
            line.push(text);
        }
        if line[1..].iter().any(|text| !text.is_empty()) {
            lines.push(line);
        }
    }
    let head: Vec<&str> = std::iter::once("way").chain(scenes).collect();
    format!(
        "# The paper's ablations\n\n{}\n{HOW_TO_READ}Each cell: *best object*; *text*. Generated scenes have exact masks, photos those \
         of the built-in segmenter. All but *quick* and *all as in the paper* keep the Gaussians of *quick*.\n\n{}{PAPER_FIGURES}",
        stamp(rows),
        table(&head, &lines)
    )
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::plan::UNCHANGED;
    use super::*;
    use serde_json::{Value, json};

    fn row(scene: &str, way: &str, seed: u64, best: f64, train: f64) -> Value {
        json!({
            "scene": scene, "way": way, "seed": seed, "machine": "a processor", "adapter": "cpu", "size": "64x48",
            "oracle_miou": best, "miou": 0.5 * best, "psnr": 30.0, "gaussians": 1000, "objects": 9, "photos": 35,
            "scene_bytes": 2_000_000, "right": 2, "labels": 4, "absent_rejected": 40, "absent_texts": 40,
            "query_ms_first": 20.0, "seconds": { "preprocess": 1.0, "train": train, "objects": 2.0 },
        })
    }

    pub fn rows() -> Rows {
        Rows {
            version: "1.0.0, commit abc".to_owned(),
            clip: None,
            rows: vec![
                row("fox", BASE, 0, 0.8, 10.0),
                row("fox", BASE, 1, 0.9, 12.0),
                row("fox", "standard", 0, 0.7, 40.0),
                row("fox", UNCHANGED, 0, 0.9, 10.0),
                row("fox", "blur 2 px", 0, 0.6, 10.0),
                row("fox", "JPEG quality 15", 0, 0.89, 10.0),
                row("twins", "as it is", 0, 0.3, 10.0),
            ],
        }
    }

    #[test]
    fn pages_have_means_ranges_and_their_version() {
        let rows = rows();
        let files = all(&rows).expect("pages");
        let of = |name: &str| &files.iter().find(|f| f.0 == name).expect(name).1;
        for page in [
            "README.md",
            "texts.md",
            "speed.md",
            "stability.md",
            "size.md",
            "paper.md",
        ] {
            assert!(
                of(page).contains("commit abc") && of(page).contains("Seeds: 0, 1"),
                "{page}"
            );
        }
        assert!(
            of("speed.md")
                .contains("| fox | quick | 2 | 14 | 1 + 11 + 2 | 20 | 0.85 (0.80 to 0.90) |"),
            "{}",
            of("speed.md")
        );
        assert!(of("speed.svg").contains("standard"));
        let stability = of("stability.md");
        let place = |text: &str| {
            stability
                .find(text)
                .unwrap_or_else(|| panic!("{text}: {stability}"))
        };
        assert!(
            place("| blur 2 px | -30.0 |") < place("| JPEG quality 15 | -1.0 |"),
            "worst first"
        );
        assert!(
            place("| twins | 1 | 0.30 |") < place("| fox | 2 | 0.85"),
            "worst first"
        );
    }

    #[test]
    fn the_front_has_all_points_that_no_point_dominates() {
        let point = |x: f64, y: f64| Point {
            name: String::new(),
            x,
            y,
            range: (y, y),
            front: false,
        };
        let mut points = [
            point(1.0, 0.5),
            point(2.0, 0.4),
            point(3.0, 0.6),
            point(1.0, 0.5),
        ];
        mark_front(&mut points);
        assert_eq!(points.map(|p| p.front), [true, false, true, true]);
    }
}
