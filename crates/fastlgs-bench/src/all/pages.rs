//! The pages of `fastlgs-bench all`, made from its rows alone.

use super::figures::{self, Mean, Runs, given, labelled};
use super::markdown::{MEANS, TEXT, stamp, table};
use super::rows::Rows;
use super::stability;
use super::ways::{BASE, Page, UNDETECTED, UNLIMITED, on};
use super::{charts, index, summary, texts};
use crate::plot::Panel;
use anyhow::Result;

/// Returns name and text of all files.
pub fn all(rows: &Rows) -> Result<Vec<(String, String)>> {
    let mut files = vec![
        ("README.md".to_owned(), index::page(rows)),
        ("texts.md".to_owned(), texts::page(rows)),
        ("speed.md".to_owned(), speed(rows)),
        ("stability.md".to_owned(), stability::page(rows)),
        ("size.md".to_owned(), size(rows)),
        ("paper.md".to_owned(), paper(rows)),
    ];
    files.extend(charts::all(rows)?);
    files.push(("stability.svg".to_owned(), stability::chart(rows)?));
    Ok(files)
}

/// Returns the lines of a scene in the table of speed, fastest first.
fn speed_lines(rows: &Rows, scene: &str, fronts: [&[Panel]; 2]) -> Vec<Vec<String>> {
    let is_on = |panels: &[Panel], name: &str| {
        let points = panels
            .iter()
            .filter(|p| p.name == scene)
            .flat_map(|p| &p.points);
        points
            .into_iter()
            .any(|point| point.front && point.name == name)
    };
    let mut timed: Vec<(Mean, &str, Runs)> = on(Page::Speed)
        .filter_map(|way| {
            let runs = Runs::of(rows, scene, way.name)?;
            Some((runs.total_seconds()?, way.name, runs))
        })
        .collect();
    timed.sort_by(|a, b| a.0.mean.total_cmp(&b.0.mean));
    let line = |(seconds, name, runs): &(Mean, &str, Runs)| {
        let stage = |stage: &str| {
            runs.seconds(stage)
                .map_or(String::new(), |s| format!("{:.0}", s.mean))
        };
        let mark = |panels: &[Panel]| if is_on(panels, name) { " *" } else { "" };
        vec![
            scene.to_owned(),
            (*name).to_owned(),
            runs.rows.len().to_string(),
            runs.timed().to_string(),
            seconds.text(0),
            ["preprocess", "train", "objects"].map(stage).join(" + "),
            runs.query_milliseconds()
                .map_or(String::new(), |ms| ms.text(0)),
            runs.text("oracle_miou", 2) + mark(fronts[0]),
            runs.text("miou", 2) + mark(fronts[1]),
            runs.text("psnr", 1),
            runs.text("gaussians", 0),
        ]
    };
    timed.iter().map(line).collect()
}

fn speed(rows: &Rows) -> String {
    let of_best = charts::objects_by_time(rows);
    let of_answers = charts::answers_by_time(rows);
    let scenes = labelled(rows).into_iter();
    let lines: Vec<Vec<String>> = scenes
        .flat_map(|scene| speed_lines(rows, scene, [&of_best, &of_answers]))
        .collect();
    let head = [
        "scene",
        "way",
        "seeds",
        "timed",
        "seconds",
        "preprocess + train + objects",
        "ms of a query",
        "best object",
        "text",
        "PSNR, dB",
        "Gaussians",
    ];
    format!(
        "# Speed against accuracy\n\n{}\n{MEANS}{TEXT} *Seconds*: from posed photos to answers, repair of wrong poses \
         included ([scenes](../research/evaluation.md#scenes)); *timed*: the number of their seeds. [What each way is](README.md#ways).\n\n\
         An asterisk marks the front: no other way is as fast and as accurate. Each panel of the charts has its own axes.\n\n\
         - Ways with photos missing start from prepared photos, so their seconds lack any repair of poses, and they are not on the front.\n\
         - Fields without objects (*mean embeddings*, *like LangSplat*, *like LERF*) are not the authors' programs and use the built-in \
         encoder instead of CLIP. They have no best object. The time of their queries is that of rendering alone.\n\
         - Neither they nor the paper's mapping have the detector of everyday classes: compare their texts with those of *{UNDETECTED}*. \
         The fields and *preset like-paper* refuse no text.\n\
         - The seconds of *preset like-paper* lack those of Algorithm 1, which are among the objects' in *paper's mapping*.\n\
         - PSNR of *side 240* and *side 720* is that of photos of this side; with photos missing, it is that of the labelled views alone.\n\n\
         ![accuracy against seconds](speed.svg)\n\n\
         ![accuracy of answers against seconds](speed-texts.svg)\n\n\
         ![accuracy of answers against milliseconds of a query](query.svg)\n\n{}",
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
                    runs.rows.len().to_string(),
                    runs.text("gaussians", 0),
                    runs.megabytes().map_or(String::new(), |m| m.text(1)),
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
        "# Size against accuracy\n\n{}\n{MEANS} *MB*: all files of the scene that a query needs; SPZ and SOG with 2 bytes a Gaussian for the objects.\n\n![accuracy against \
         size](size.svg)\n\n![colour against size](size-psnr.svg)\n\n{}{}",
        stamp(rows),
        table(&head, &lines),
        limits(rows)
    )
}

/// Returns where the automatic limit of the number of Gaussians stops, and what it costs there.
fn limits(rows: &Rows) -> String {
    let line = |scene: &str| {
        let free = Runs::of(rows, scene, UNLIMITED)?;
        let limited = Runs::of(rows, scene, BASE)?.with_seeds_of(&free);
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
        "\n## Where the automatic limit stops\n\nWhile training, the limit removes twice the Gaussians that \
         together add a twentieth to the remaining squared error of the training views. It also allows at most one for 20 pixels of \
         these views, and at most 200,000 with preset quick ([how it works](../how-it-works.md)). What all of them gain in held-out views:\n\n{}",
        table(&head, &lines)
    )
}

/// The paper's own figures.
const PAPER_FIGURES: &str = "
## The paper's own figures

They are of other scenes (SPIn-NeRF's and its own), other labels and a TITAN RTX, so they cannot be compared with those
above: only the order of the ways can.

| table of the paper | way | mIoU, % | mAcc, % | seconds a query | MB |
| --- | --- | --- | --- | --- | --- |
| ablation on the semantic feature grid | embeddings | 75.2 | 83.2 | | |
| ablation on the semantic feature grid | and key points | 87.5 | 91.8 | | |
| ablation on the semantic feature grid | and colours | 92.1 | 97.5 | | |
| ablation on querying feature | embeddings in a NeRF | 83.3 | | 20.1 | |
| ablation on querying feature | embeddings in Gaussians | out of memory | | | |
| ablation on querying feature | grid | 95.1 | | 0.98 | |
| performance, scene *sofa*, 1440x1080 | grid | | | 0.52 | 200 |
";

fn paper(rows: &Rows) -> String {
    let scenes = labelled(rows);
    let table_of = |figure: &str| {
        let mut lines = Vec::new();
        for way in on(Page::Paper) {
            let of = |scene: &&str| {
                let runs = Runs::of(rows, scene, way.name);
                runs.map_or(String::new(), |runs| runs.text(figure, 2))
            };
            let cells: Vec<String> = scenes.iter().map(of).collect();
            if cells.iter().any(|text| !text.is_empty()) {
                let runs: Vec<Runs> = scenes
                    .iter()
                    .filter_map(|scene| Runs::of(rows, scene, way.name))
                    .collect();
                lines.push([vec![way.name.to_owned(), figures::seeds(&runs)], cells].concat());
            }
        }
        let head = [&["way", "seeds"], scenes.as_slice()].concat();
        table(&head, &lines)
    };
    format!(
        "# The paper's ablations\n\n{}\n{MEANS}{TEXT} [What each way is](README.md#ways).\n\n\
         Generated scenes have exact masks, photos those of the built-in segmenter. The paper has SAM's masks and CLIP's \
         embeddings. With the built-in encoder, masks of one object are less similar, so theta is 0.7 instead of the paper's \
         0.95. Only *quick* and *code of 3 numbers* have the detector of everyday classes. All but *quick* and *preset like-paper* keep \
         the Gaussians of *quick*. *Preset like-paper* refuses no text. The threshold tau_ac of rendered codes was \
         measured with [an earlier version](../research/paper.md).\n\n## Best object\n\n{}\n## Answer to a text\n\n{}{PAPER_FIGURES}{}",
        stamp(rows),
        table_of("oracle_miou"),
        table_of("miou"),
        summary::texts_without_grid(rows).map_or(String::new(), |text| format!(
            "\nThe paper's grid is better than a field of embeddings. {text}\n"
        )),
    )
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::rows;
    use super::*;

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
            of("speed.md").contains(
                "| fox | quick | 2 | 2 | 14 (13 to 15) | 1 + 11 + 2 | 20 | 0.85 (0.80 to 0.90) * |"
            ),
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
}
