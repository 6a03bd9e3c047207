//! The page of answers to texts.

use super::figures::{Mean, Runs, labelled};
use super::markdown::{stamp, table};
use super::rows::Rows;
use super::stability;
use super::ways::{BASE, WAYS, Way};
use fastlgs_synth::Kind;
use std::fmt::Write as _;

/// Fewest labels of a scene on which ways are compared, so that single names do not decide.
const MIN_LABELS: f64 = 50.0;

/// States how many labels are answered correctly, mean over the seeds. Generated scenes have exact
/// masks, so they do not count.
pub fn answered(rows: &Rows) -> Option<String> {
    let scenes = photographed(rows);
    let of = |figure: &str| -> f64 {
        let means = scenes.iter().filter_map(|(_, runs)| runs.mean(figure));
        means.map(|mean| mean.mean).sum()
    };
    let names: Vec<&str> = scenes.iter().map(|(name, _)| *name).collect();
    let best = scenes
        .iter()
        .filter_map(|(_, runs)| runs.mean("oracle_miou"));
    let best = Mean::of(best.map(|mean| mean.mean))?;
    Some(format!(
        "The built-in encoder answers {:.0} of {:.0} labels correctly ({}). The best objects have a mean IoU of {:.2} \
         to {:.2} with them.",
        of("right"),
        of("labels"),
        names.join(", "),
        best.low,
        best.high
    ))
}

/// Returns the given scenes of photos with labels.
fn photographed(rows: &Rows) -> Vec<(&str, Runs<'_>)> {
    let scenes = labelled(rows).into_iter();
    let scenes = scenes.filter(|scene| Kind::of(scene).is_none());
    scenes
        .filter_map(|scene| Some((scene, Runs::of(rows, scene, BASE)?)))
        .collect()
}

/// States what is answered with real CLIP embeddings. The thresholds are those of the other rooms.
pub fn with_clip(rows: &Rows) -> Option<String> {
    let clip = rows.clip.as_ref()?;
    let share = |group: &str| {
        let share = clip["left_out"][group].as_f64()?;
        Some(format!("{:.0} %", 100.0 * share))
    };
    Some(format!(
        "With OpenCLIP embeddings of the objects in {} scanned rooms, {} of the names of walls, floors and doors get an \
         answer, {} of furniture names, and {} of absent names. Whether these answers are right was not measured.",
        clip["rooms"].as_array()?.len(),
        share("present")?,
        share("furniture")?,
        share("absent")?
    ))
}

/// Returns the lines of the scenes, worst first.
fn by_scene(rows: &Rows) -> Vec<Vec<String>> {
    let mut lines: Vec<(f64, Vec<String>)> = Vec::new();
    for (scene, _) in stability::scenes(rows) {
        let Some(runs) = stability::as_it_is(rows, scene) else {
            continue;
        };
        let right = runs.mean("right").map_or(0.0, |mean| mean.mean);
        let labels = runs.mean("labels").map_or(1.0, |mean| mean.mean);
        let line = vec![
            scene.to_owned(),
            runs.rows.len().to_string(),
            format!("{labels:.0}"),
            runs.count("right"),
            runs.text("miou", 2),
            runs.text("oracle_miou", 2),
            runs.count("absent_rejected"),
        ];
        lines.push((right / labels, line));
    }
    lines.sort_by(|a, b| a.0.total_cmp(&b.0));
    lines.into_iter().map(|line| line.1).collect()
}

/// Returns the lines of all ways on the scenes with many labels.
fn by_way(rows: &Rows) -> Vec<Vec<String>> {
    let has_many = |scene: &&str| {
        let labels = Runs::of(rows, scene, BASE).and_then(|runs| runs.mean("labels"));
        labels.is_some_and(|labels| labels.mean >= MIN_LABELS)
    };
    let line = |scene: &str, way: &Way| {
        let runs = Runs::of(rows, scene, way.name)?;
        Some(vec![
            scene.to_owned(),
            way.name.to_owned(),
            runs.rows.len().to_string(),
            runs.count("right"),
            runs.text("miou", 3),
        ])
    };
    let scenes = labelled(rows).into_iter().filter(has_many);
    scenes
        .flat_map(|scene| WAYS.iter().filter_map(move |way| line(scene, way)))
        .collect()
}

pub fn page(rows: &Rows) -> String {
    let mut text = format!(
        "# Answers to texts\n\n{}\nThe built-in encoder has 80 everyday classes, 1,000 other classes and a sentence encoder. *Labels*: \
         names of objects in held-out views, once for each view; [evaluation](../research/evaluation.md#scenes) has the \
         numbers of distinct names. *Right*: labels whose answer has an IoU of a half \
         at least. *Text*: IoU of the answer, mean over the labels; no answer is 0. *Best object*: IoU of the best \
         single object. [Some labels](../research/evaluation.md#scenes) join several objects, which no single object covers. *Refused*: of 40 names of things that are not in the \
         scene, with which the encoder was calibrated too. Means over the seeds, with their range in brackets.\n\n## Scenes, worst first\n\n{}",
        stamp(rows),
        table(
            &[
                "scene",
                "seeds",
                "labels",
                "right",
                "text",
                "best object",
                "refused"
            ],
            &by_scene(rows)
        )
    );
    let by_way = by_way(rows);
    if !by_way.is_empty() {
        let _ = write!(
            text,
            "\n## Ways on scenes with fifty labels or more\n\n{}",
            table(&["scene", "way", "seeds", "right", "text"], &by_way)
        );
    }
    if let Some(found) = with_clip(rows) {
        let _ = write!(
            text,
            "\n## CLIP\n\n{found} Embeddings are of OpenCLIP ViT-B/16 and SAM's masks in ScanNet. The thresholds for each room are \
             from the other rooms. `fastlgs-bench clip FOLDER` measures this ([details](../research/clip.md)).\n"
        );
    }
    text
}
