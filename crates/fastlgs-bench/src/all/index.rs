//! The first page of the results: what fails, all ways, scenes, and how to make the rows again.

use super::figures::{Runs, distinct, given};
use super::markdown::{stamp, table};
use super::rows::Rows;
use super::summary;
use super::ways::{BASE, PAPER_MAPPING, UNCHANGED, UNDETECTED, WAYS, Way};
use fastlgs_synth::Kind;
use std::fmt::Write as _;

pub fn page(rows: &Rows) -> String {
    let mut text = format!(
        "# Results\n\n{}\nPhotos have at most 480 pixels a side; every eighth view is held out. Constants of the program were \
         chosen by these labels of fox, office, bonsai and apartment, so figures of these scenes are figures of development. The version is that of the measured program; \
         what measures it has changed since ([rules](../research/evaluation.md#the-benches)).\n\n",
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
    text += "- [peers](../research/peers.md): OpenSplat and Brush, measured once by hand\n";
    let _ = write!(
        text,
        "\n## What fails\n\n{}\n## All ways\n\nEach against *{BASE}*, with the same seed. Fewer photos are compared \
         with *{UNCHANGED}*, changes of Algorithm 1 with *{PAPER_MAPPING}*, and texts of other ways without the detector of everyday classes \
         with *{UNDETECTED}*. Mean over the scenes, with their range in brackets. *Time*: from posed photos to \
         answers. *Size*: all files that a query needs. *Best object*: IoU of the best single object, *text*: IoU of \
         the answer to a label's name, both in points (hundredths). [What each way is](#ways).\n\n{}",
        summary::failures(rows),
        summary::changes(rows)
    );
    let _ = write!(
        text,
        "\n## Scenes\n\nGenerated scenes have exact masks, all others those of the built-in segmenter. All have poses. \
         [Where the scenes and labels are from](../research/evaluation.md#scenes).\n\n{}",
        scenes(rows)
    );
    let _ = write!(text, "\n## Ways\n\n{}", ways(rows));
    let _ = write!(
        text,
        "\n## Make them again\n\n[rows.json](rows.json) has {} rows. One command makes all that are missing, and \
         all pages. The second makes one row again, and those that it is compared with, in another folder:\n\n```sh\n\
         fastlgs-bench all --scenes {} --clip DATA/clip -o docs/results --readme README.md --device cpu\n\
         fastlgs-bench all --scenes table --ways \"40 % of the masks split\" --seeds 2 -o again --device cpu\n```\n\n\
         A scene is a folder of photos with `labels/` beside them, or a kind of generated scene. \
         The photos are public ([where](../research/evaluation.md#scenes)); the labels that were drawn on them are not part of \
         this repository. So anyone can measure the generated scenes, as the second command does, or other photos with labels. \
         `DATA/clip` is a folder of CLIP embeddings for `fastlgs-bench clip`.\n",
        rows.rows.len(),
        given(rows)
            .iter()
            .map(|scene| source(scene))
            .collect::<Vec<_>>()
            .join(","),
    );
    text
}

/// Returns a scene as an argument of `--scenes`.
fn source(scene: &str) -> String {
    match Kind::of(scene) {
        Some(_) => scene.to_owned(),
        None => format!("DATA/{scene}"),
    }
}

fn scenes(rows: &Rows) -> String {
    let line = |scene: &str| {
        let runs = Runs::of(rows, scene, BASE).or_else(|| Runs::of(rows, scene, "as it is"))?;
        let kind = Kind::of(scene).map_or("", |_| "generated");
        let size = runs.rows[0]["size"].as_str().unwrap_or_default();
        Some(vec![
            scene.to_owned(),
            kind.to_owned(),
            size.to_owned(),
            runs.text("photos", 0),
            runs.text("labels", 0),
        ])
    };
    let lines: Vec<Vec<String>> = distinct(rows, "scene")
        .into_iter()
        .filter_map(line)
        .collect();
    table(
        &[
            "scene",
            "",
            "pixels",
            "training photos",
            "labels in held-out views",
        ],
        &lines,
    )
}

/// Returns what each measured way is.
fn ways(rows: &Rows) -> String {
    let is_measured = |way: &&Way| rows.rows.iter().any(|row| row["way"] == way.name);
    let line = |way: &Way| vec![way.name.to_owned(), way.about.to_owned()];
    let lines: Vec<Vec<String>> = WAYS.iter().filter(is_measured).map(line).collect();
    table(&["way", "what is done"], &lines)
}
