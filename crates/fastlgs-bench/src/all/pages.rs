//! Tables and charts of `fastlgs-bench all`, made from its rows alone.

use super::Rows;
use super::plan::{BASE, How, Page, UNCHANGED, WAYS, Way};
use crate::plot::{self, Axes, Cell, HeatMap, Panel, Panels, Point};
use anyhow::{Context, Result};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// A figure over the seeds of a way.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Mean {
    mean: f64,
    low: f64,
    high: f64,
}

impl Mean {
    fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.into_iter().collect();
        let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().reduce(pick);
        Some(Self {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            low: fold(f64::min)?,
            high: fold(f64::max)?,
        })
    }

    /// Formats mean and range; the mean alone if all values are the same.
    fn text(self, digits: usize) -> String {
        let Self { mean, low, high } = self;
        let [mean, low, high] = [mean, low, high].map(|v| format!("{v:.digits$}"));
        if low == high {
            mean
        } else {
            format!("{mean} ({low} to {high})")
        }
    }
}

/// The rows of a way on a scene, one for each seed.
struct Runs<'a>(Vec<&'a Value>);

impl<'a> Runs<'a> {
    fn of(rows: &'a Rows, scene: &str, way: &str) -> Option<Self> {
        let is_run = |row: &&Value| row["scene"] == scene && row["way"] == way;
        let runs: Vec<&Value> = rows.rows.iter().filter(is_run).collect();
        (!runs.is_empty()).then_some(Self(runs))
    }

    fn mean(&self, figure: &str) -> Option<Mean> {
        Mean::of(self.0.iter().filter_map(|row| row[figure].as_f64()))
    }

    /// Seconds from photos to answers, or of one stage.
    fn seconds(&self, stage: Option<&str>) -> Option<Mean> {
        let of = |row: &&Value| match stage {
            Some(stage) => row["seconds"][stage].as_f64(),
            None => Some(
                row["seconds"]
                    .as_object()?
                    .values()
                    .filter_map(Value::as_f64)
                    .sum(),
            ),
        };
        Mean::of(self.0.iter().filter_map(of))
    }

    fn text(&self, figure: &str, digits: usize) -> String {
        self.mean(figure)
            .map_or(String::new(), |mean| mean.text(digits))
    }

    /// Change of a figure against other runs with the same seed, in points.
    fn change(&self, figure: &str, reference: &Self) -> Option<Mean> {
        Mean::of(self.0.iter().filter_map(|row| {
            let same = reference
                .0
                .iter()
                .find(|other| other["seed"] == row["seed"])?;
            Some(100.0 * (row[figure].as_f64()? - same[figure].as_f64()?))
        }))
    }
}

/// Returns the distinct texts of a field, in order of their first row.
fn distinct<'a>(rows: &'a Rows, field: &str) -> Vec<&'a str> {
    let mut seen = BTreeSet::new();
    let texts = rows.rows.iter().filter_map(|row| row[field].as_str());
    texts.filter(|text| seen.insert(*text)).collect()
}

/// Returns the scenes that have the default way: the given ones.
fn given(rows: &Rows) -> Vec<&str> {
    let has_base = |scene: &&str| Runs::of(rows, scene, BASE).is_some();
    distinct(rows, "scene")
        .into_iter()
        .filter(has_base)
        .collect()
}

fn on(page: Page) -> impl Iterator<Item = &'static Way> {
    WAYS.iter()
        .filter(move |way| way.page == page || way.name == BASE)
}

/// Returns a Markdown table.
fn table(head: &[&str], lines: &[Vec<String>]) -> String {
    let line = |cells: Vec<&str>| format!("| {} |\n", cells.join(" | "));
    let mut text = line(head.to_vec()) + &line(vec!["---"; head.len()]);
    for cells in lines {
        text += &line(cells.iter().map(String::as_str).collect());
    }
    text
}

/// States what the figures of a page were measured with.
fn stamp(rows: &Rows) -> String {
    let seeds: BTreeSet<u64> = rows
        .rows
        .iter()
        .filter_map(|row| row["seed"].as_u64())
        .collect();
    format!(
        "FastLGS {}. {}. Device: {}. Seeds: {}.\n",
        rows.version,
        distinct(rows, "machine").join("; "),
        distinct(rows, "adapter").join("; "),
        seeds
            .iter()
            .map(u64::to_string)
            .collect::<Vec<_>>()
            .join(", "),
    )
}

const HOW_TO_READ: &str = "Means over the seeds, with their range in brackets. *Best object*: IoU of the best \
single object, mean over the labels of held-out views. *Text*: IoU of the answer to the label's name. *Right*: \
answers with an IoU of a half at least. *Seconds*: from photos to answers.\n";

/// Returns name and text of all files.
pub fn all(rows: &Rows) -> Result<Vec<(String, String)>> {
    let mut files = vec![
        ("README.md".to_owned(), index(rows)),
        ("speed.md".to_owned(), speed(rows)),
        ("stability.md".to_owned(), stability(rows)),
        ("size.md".to_owned(), size(rows)),
        ("paper.md".to_owned(), paper(rows)),
    ];
    let best = |runs: &Runs| runs.mean("oracle_miou");
    let charts = [
        (
            "speed.svg",
            panels(
                rows,
                &[Page::Speed, Page::Paper],
                |runs| runs.seconds(None),
                best,
            ),
            "Accuracy against time: from photos to answers",
            "seconds",
            "best object, mean IoU",
        ),
        (
            "query.svg",
            panels(
                rows,
                &[Page::Speed, Page::Paper],
                |runs| runs.mean("query_ms_first"),
                best,
            ),
            "Accuracy against time: first answer in a view",
            "milliseconds",
            "best object, mean IoU",
        ),
        (
            "size.svg",
            panels(rows, &[Page::Size], megabytes, best),
            "Accuracy against size",
            "megabytes",
            "best object, mean IoU",
        ),
        (
            "size-psnr.svg",
            panels(rows, &[Page::Size], megabytes, |runs| runs.mean("psnr")),
            "Colour against size",
            "megabytes",
            "PSNR of held-out views, dB",
        ),
    ];
    for (name, panels, title, x, y) in charts {
        let axes = Axes { title, x, y };
        files.push((name.to_owned(), plot::svg(&Panels { axes, panels })?));
    }
    let scenes = given(rows);
    let heat = HeatMap {
        title: "Change of the best objects' IoU in points: red is lost, worst first",
        columns: &scenes,
        rows: &disturbances(rows)
            .iter()
            .map(|(name, changes)| (name.clone(), changes.iter().map(|c| cell(*c)).collect()))
            .collect::<Vec<_>>(),
    };
    files.push(("stability.svg".to_owned(), plot::svg(&heat)?));
    Ok(files)
}

fn megabytes(runs: &Runs) -> Option<Mean> {
    let Mean { mean, low, high } = runs.mean("scene_bytes")?;
    Some(Mean {
        mean: mean / 1e6,
        low: low / 1e6,
        high: high / 1e6,
    })
}

/// Returns a panel for each given scene: the ways of these pages, with their Pareto front.
fn panels(
    rows: &Rows,
    pages: &[Page],
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
        let ways = WAYS
            .iter()
            .filter(|way| way.name == BASE || pages.contains(&way.page));
        let mut points: Vec<Point> = ways.filter_map(|way| point(scene, way)).collect();
        mark_front(&mut points);
        Panel {
            name: scene.to_owned(),
            points,
        }
    };
    given(rows).into_iter().map(panel).collect()
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
        "\nScenes: {scenes}; {} rows in [rows.json](rows.json). One command makes all rows that are missing, and \
         all pages; `--ways \"blur 2 px\"` makes one way alone:\n\n```sh\nfastlgs-bench all --scenes {} -o docs/results \
         --readme README.md --device cpu\n```\n",
        rows.rows.len(),
        given(rows).join(","),
    );
    text
}

fn speed(rows: &Rows) -> String {
    let mut lines = Vec::new();
    let chart = panels(
        rows,
        &[Page::Speed, Page::Paper],
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
         object is the best threshold for each label.\n\n![accuracy against seconds](speed.svg)\n\n\
         ![accuracy against milliseconds of a query](query.svg)\n\n{}",
        stamp(rows),
        table(&head, &lines)
    )
}

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
            runs.change(measure(way), &Runs::of(rows, scene, reference)?)
        };
        let changes: Vec<Option<Mean>> = scenes.iter().map(change).collect();
        if changes.iter().any(Option::is_some) {
            let unit = if measure(way) == "miou" {
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
fn measure(way: &Way) -> &'static str {
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

fn stability(rows: &Rows) -> String {
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
         size](size.svg)\n\n![colour against size](size-psnr.svg)\n\n{}",
        stamp(rows),
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
    let scenes = given(rows);
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

/// Markers of the generated part of the README.
const MARKERS: [&str; 2] = [
    "<!-- figures: fastlgs-bench all -->\n",
    "<!-- end of figures -->",
];

/// Returns the README with the table between its markers made from `rows`.
///
/// # Errors
/// A marker is missing.
pub fn with_table(readme: &str, rows: &Rows) -> Result<String> {
    let (before, rest) = readme
        .split_once(MARKERS[0])
        .context("no marker of figures")?;
    let (_, after) = rest
        .split_once(MARKERS[1])
        .context("no marker of the end of figures")?;
    let [begin, end] = MARKERS;
    Ok(format!("{before}{begin}{}{end}{after}", readme_table(rows)))
}

fn readme_table(rows: &Rows) -> String {
    let scenes: Vec<(&str, Runs)> = given(rows)
        .into_iter()
        .filter_map(|scene| Some((scene, Runs::of(rows, scene, BASE)?)))
        .collect();
    let line = |name: &str, of: &dyn Fn(&Runs) -> String| {
        std::iter::once(name.to_owned())
            .chain(scenes.iter().map(|(_, runs)| of(runs)))
            .collect::<Vec<String>>()
    };
    let first = |runs: &Runs, name: &str| match &runs.0[0][name] {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let rounded = |runs: &Runs, name: &str| {
        runs.mean(name)
            .map_or(String::new(), |m| format!("{:.0}", m.mean))
    };
    let lines = [
        line("seeds", &|runs| runs.0.len().to_string()),
        line("training photos; Gaussians", &|runs| {
            format!("{}; {}", first(runs, "photos"), rounded(runs, "gaussians"))
        }),
        line("colour of held-out views, dB", &|runs| runs.text("psnr", 1)),
        line("IoU of the best object, mean over labels", &|runs| {
            runs.text("oracle_miou", 2)
        }),
        line("IoU of the answer to a text, mean over labels", &|runs| {
            runs.text("miou", 2)
        }),
        line("texts that are answered correctly", &|runs| {
            let right = runs.text("right", 1).replace(".0", "");
            format!("{right} of {}", first(runs, "labels"))
        }),
        line("absent texts that are refused", &|runs| {
            format!(
                "{} of {}",
                runs.text("absent_rejected", 0),
                first(runs, "absent_texts")
            )
        }),
        line("seconds from photos to answers", &|runs| {
            runs.seconds(None).map_or(String::new(), |s| s.text(0))
        }),
    ];
    let titles: Vec<String> = scenes
        .iter()
        .map(|(scene, runs)| format!("{scene}, {}", first(runs, "size")))
        .collect();
    let head: Vec<&str> = std::iter::once("")
        .chain(titles.iter().map(String::as_str))
        .collect();
    format!(
        "{}\n{}\n![accuracy against seconds from photos to answers](docs/results/speed.svg)\n",
        stamp(rows),
        table(&head, &lines)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn row(scene: &str, way: &str, seed: u64, best: f64, train: f64) -> Value {
        json!({
            "scene": scene, "way": way, "seed": seed, "machine": "a processor", "adapter": "cpu", "size": "64x48",
            "oracle_miou": best, "miou": 0.5 * best, "psnr": 30.0, "gaussians": 1000, "objects": 9, "photos": 35,
            "scene_bytes": 2_000_000, "right": 2, "labels": 4, "absent_rejected": 40, "absent_texts": 40,
            "query_ms_first": 20.0, "seconds": { "preprocess": 1.0, "train": train, "objects": 2.0 },
        })
    }

    fn rows() -> Rows {
        Rows {
            version: "1.0.0, commit abc".to_owned(),
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
    fn the_readme_changes_between_its_markers_only() {
        let readme = format!("# Title\n{}old\n{}\nmore\n", MARKERS[0], MARKERS[1]);
        let new = with_table(&readme, &rows()).expect("markers");
        assert!(new.starts_with("# Title\n") && new.ends_with("\nmore\n") && !new.contains("old"));
        assert!(
            new.contains("0.85 (0.80 to 0.90)") && new.contains("2 of 4"),
            "{new}"
        );
        assert_eq!(with_table(&new, &rows()).expect("markers"), new);
        assert!(with_table("no marker", &rows()).is_err());
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
