//! The page of answers to texts.

use super::figures::{Mean, Runs, labelled};
use super::markdown::{stamp, table};
use super::plan::{BASE, WAYS};
use super::rows::Rows;
use fastlgs_synth::Kind;
use serde_json::Value;
use std::fmt::Write as _;

/// Fewest labels of a scene on which ways are compared, so that single names do not decide.
const MIN_LABELS: f64 = 50.0;

/// States how many labels of the scenes of photos are answered correctly, mean over the seeds.
/// Generated scenes have exact masks, so they do not count.
pub fn answered(rows: &Rows) -> Option<String> {
    let scenes = photographed(rows);
    let of = |figure: &str| -> f64 {
        let means = scenes.iter().filter_map(|(_, runs)| runs.mean(figure));
        means.map(|mean| mean.mean).sum()
    };
    let best = scenes
        .iter()
        .filter_map(|(_, runs)| runs.mean("oracle_miou"));
    let best = Mean::of(best.map(|mean| mean.mean))?;
    Some(format!(
        "the built-in encoder answers {:.0} of {:.0} labelled names in {} scenes of photos correctly, although the \
         best object has a mean IoU of {:.2} to {:.2} with the labels",
        of("right"),
        of("labels"),
        scenes.len(),
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

fn share(clip: &Value, group: &str) -> Option<String> {
    Some(format!("{:.0} %", 100.0 * clip["default"][group].as_f64()?))
}

/// States what is found with real CLIP embeddings.
pub fn with_clip(rows: &Rows) -> Option<String> {
    let clip = rows.clip.as_ref()?;
    Some(format!(
        "With real CLIP embeddings of {} scanned rooms, it finds {} of walls, floors and doors and {} of furniture \
         names, and answers {} of absent names",
        clip["rooms"].as_array()?.len(),
        share(clip, "present")?,
        share(clip, "furniture")?,
        share(clip, "absent")?
    ))
}

pub fn page(rows: &Rows) -> String {
    let mut by_scene: Vec<(f64, Vec<String>)> = Vec::new();
    for scene in labelled(rows) {
        let Some(runs) = Runs::of(rows, scene, BASE) else {
            continue;
        };
        let right = runs.mean("right").map_or(0.0, |mean| mean.mean);
        let labels = runs.mean("labels").map_or(1.0, |mean| mean.mean);
        by_scene.push((
            right / labels,
            vec![
                scene.to_owned(),
                runs.0.len().to_string(),
                format!("{labels:.0}"),
                runs.text("right", 1).replace(".0", ""),
                runs.text("miou", 2),
                runs.text("oracle_miou", 2),
                runs.text("absent_rejected", 1).replace(".0", ""),
            ],
        ));
    }
    by_scene.sort_by(|a, b| a.0.total_cmp(&b.0));
    let by_scene: Vec<Vec<String>> = by_scene.into_iter().map(|line| line.1).collect();
    let mut by_way = Vec::new();
    for scene in labelled(rows) {
        let is_large = |runs: &Runs| runs.mean("labels").is_some_and(|n| n.mean >= MIN_LABELS);
        if !Runs::of(rows, scene, BASE).is_some_and(|runs| is_large(&runs)) {
            continue;
        }
        for way in WAYS {
            let Some(runs) = Runs::of(rows, scene, way.name) else {
                continue;
            };
            by_way.push(vec![
                scene.to_owned(),
                way.name.to_owned(),
                runs.0.len().to_string(),
                runs.text("right", 1).replace(".0", ""),
                runs.text("miou", 3),
            ]);
        }
    }
    let mut text = format!(
        "# Answers to texts\n\n{}\nThe built-in encoder has 80 everyday classes, 1,000 other classes and a sentence encoder. *Labels*: \
         names of objects in held-out views, once for each view. *Right*: labels whose answer has an IoU of a half \
         at least. *Text*: IoU of the answer, mean over the labels; no answer is 0. *Best object*: IoU of the best \
         single object; a perfect encoder would reach it. *Refused*: of 40 names of things that are not in the \
         scene. Means over the seeds, with their range in brackets.\n\n## Scenes, worst first\n\n{}",
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
            &by_scene
        )
    );
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
            "\n## CLIP\n\n{found}. Embeddings are of OpenCLIP ViT-B/16 and SAM's masks in ScanNet; \
             `fastlgs-bench clip FOLDER` measures them ([details](../research/clip.md)).\n"
        );
    }
    text
}
