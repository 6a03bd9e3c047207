//! What fails, and all ways against the default one.

use super::figures::{self, Mean, Runs, given, labelled, signed};
use super::markdown::table;
use super::rows::Rows;
use super::stability;
use super::texts;
use super::ways::{BASE, MEAN_EMBEDDINGS, Page, UNCHANGED, UNDETECTED, WAYS, Way};
use serde_json::Value;
use std::fmt::Write as _;

/// Best objects below this IoU are listed as failures.
const GOOD_IOU: f64 = 0.8;
/// Disturbances that cost more points than this on some scene are listed as failures.
const MANY_POINTS: f64 = 10.0;
/// Disturbances that cost fewer points than this on every measured scene are listed as harmless.
const FEW_POINTS: f64 = 2.0;

/// Returns a list of what fails, and of what does not.
pub fn failures(rows: &Rows) -> String {
    let mut text = String::new();
    let sentences = [texts::answered(rows), texts_without_grid(rows)];
    for sentence in sentences.into_iter().flatten() {
        let _ = writeln!(text, "- {sentence}");
    }
    let poor: Vec<String> = stability::scenes(rows)
        .iter()
        .filter(|(_, best)| best.mean < GOOD_IOU)
        .map(|(scene, best)| format!("{scene} {:.2}", best.mean))
        .collect();
    if !poor.is_empty() {
        let _ = writeln!(
            text,
            "- Scenes whose best objects have a mean IoU below {GOOD_IOU}: {}.",
            poor.join(", ")
        );
    }
    let losses = losses(rows);
    let mut list = |about: &str, is_listed: &dyn Fn(&Loss) -> bool| {
        let listed: Vec<&Loss> = losses.iter().filter(|loss| is_listed(loss)).collect();
        if !listed.is_empty() {
            let _ = writeln!(text, "- {about}:");
        }
        for loss in listed {
            let _ = writeln!(
                text,
                "  - {}: {} on {} (measured on {})",
                loss.name,
                signed(loss.points, 1),
                loss.scene,
                loss.measured.join(", ")
            );
        }
    };
    list(
        &format!("Disturbances that cost more than {MANY_POINTS:.0} points on some scene"),
        &|loss| loss.points < -MANY_POINTS,
    );
    list(
        &format!(
            "Disturbances that cost less than {FEW_POINTS:.0} points on every [measured scene](stability.md), with \
             the largest loss"
        ),
        &|loss| loss.points > -FEW_POINTS,
    );
    text
}

/// The largest loss by a disturbance.
struct Loss<'a> {
    name: String,
    points: f64,
    scene: &'a str,
    measured: Vec<&'a str>,
}

fn losses(rows: &Rows) -> Vec<Loss<'_>> {
    let scenes = labelled(rows);
    let loss = |(name, changes): (String, Vec<Option<Mean>>)| {
        let measured = scenes.iter().zip(changes);
        let measured: Vec<(&str, f64)> = measured
            .filter_map(|(scene, change)| Some((*scene, change?.mean)))
            .collect();
        let (scene, points) = *measured.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
        Some(Loss {
            name,
            points,
            scene,
            measured: measured.iter().map(|(scene, _)| *scene).collect(),
        })
    };
    let disturbances = stability::disturbances(rows).into_iter();
    disturbances
        .filter(|(name, _)| !name.starts_with(UNCHANGED))
        .filter_map(loss)
        .collect()
}

/// States on which scenes texts are answered better by mean embeddings of Gaussians than by the
/// grid, if both lack the detector.
pub fn texts_without_grid(rows: &Rows) -> Option<String> {
    let worse = labelled(rows).into_iter().filter_map(|scene| {
        let of = |way| Some(Runs::of(rows, scene, way)?.mean("miou")?.mean);
        let (grid, field) = (of(UNDETECTED)?, of(MEAN_EMBEDDINGS)?);
        (field > grid).then(|| format!("{scene} {field:.2} instead of {grid:.2}"))
    });
    let worse: Vec<String> = worse.collect();
    (!worse.is_empty()).then(|| {
        format!(
            "Without the detector, the built-in encoder answers texts better with mean embeddings of Gaussians than \
             with the grid. Mean IoU: {}. Mean embeddings refuse no text.",
            worse.join(", ")
        )
    })
}

/// Returns the table of all ways of speed, size and the paper, against their reference.
pub fn changes(rows: &Rows) -> String {
    let is_listed = |way: &&Way| way.name != BASE && way.pages != [Page::Stability];
    let lines: Vec<Vec<String>> = WAYS
        .iter()
        .filter(is_listed)
        .filter_map(|way| line(rows, way))
        .collect();
    let head = [
        "way",
        "scenes",
        "seeds",
        "time",
        "size",
        "PSNR, dB",
        "best object",
        "text",
    ];
    table(&head, &lines)
}

fn line(rows: &Rows, way: &Way) -> Option<Vec<String>> {
    let pairs: Vec<(&str, Runs, Runs)> = given(rows)
        .into_iter()
        .filter_map(|scene| {
            let reference = Runs::of(rows, scene, way.reference())?;
            Some((scene, Runs::of(rows, scene, way.name)?, reference))
        })
        .collect();
    if pairs.is_empty() {
        return None;
    }
    // Mean over the scenes, with their range.
    let over_scenes = |compare: &dyn Fn(&Runs, &Runs) -> Option<Mean>| {
        let means = pairs
            .iter()
            .filter_map(|(_, runs, reference)| compare(runs, reference));
        Mean::of(means.map(|mean| mean.mean))
    };
    let times = |mean: Option<Mean>| mean.map_or(String::new(), |m| format!("x {:.2}", m.mean));
    let bytes = |row: &Value| row["scene_bytes"].as_f64();
    let change = |figure: &str, factor: f64, digits: usize| {
        over_scenes(&|runs, reference| runs.change(figure, reference))
            .map_or(String::new(), |mean| mean.times(factor).signed(digits))
    };
    let psnr = if way.has_other_pixels() {
        String::new()
    } else {
        change("psnr", 1.0, 2)
    };
    let texts = pairs.iter().filter_map(|(scene, runs, _)| {
        let reference = Runs::of(rows, scene, way.text_reference())?;
        Some(runs.change("miou", &reference)?.mean)
    });
    let texts = Mean::of(texts).map_or(String::new(), |mean| mean.times(100.0).signed(1));
    let scenes: Vec<&str> = pairs.iter().map(|(scene, ..)| *scene).collect();
    Some(vec![
        way.name.to_owned(),
        scenes.join(", "),
        figures::seeds(pairs.iter().map(|(_, runs, _)| runs)),
        times(over_scenes(&|runs, reference| runs.time_ratio(reference))),
        times(over_scenes(&|runs, reference| runs.ratio(bytes, reference))),
        psnr,
        change("oracle_miou", 100.0, 1),
        texts,
    ])
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{row, rows};
    use super::super::ways::PAPER_MAPPING;
    use super::*;

    #[test]
    fn ways_are_compared_seed_by_seed() {
        let text = changes(&rows());
        // Seed 1 of quick has no counterpart.
        let standard = text.lines().find(|line| line.contains("standard"));
        assert_eq!(
            standard,
            Some("| standard | fox | 1 | x 3.31 | x 1.00 | 0.00 | -10.0 | -5.0 |"),
            "{text}"
        );
    }

    #[test]
    fn texts_are_compared_with_the_same_sources_of_names() {
        let mut rows = rows();
        rows.rows.push(row("fox", UNDETECTED, 0, 0.4, 10.0));
        rows.rows.push(row("fox", MEAN_EMBEDDINGS, 0, 0.6, 10.0));
        let text = changes(&rows);
        assert!(
            text.contains("| x 1.00 | x 1.00 | 0.00 | -20.0 | +10.0 |"),
            "{text}"
        );
        let text = failures(&rows);
        assert!(text.contains("fox 0.30 instead of 0.20"), "{text}");
    }

    #[test]
    fn changes_of_the_papers_mapping_are_compared_with_it() {
        let mut rows = rows();
        rows.rows.push(row("fox", PAPER_MAPPING, 0, 0.5, 10.0));
        rows.rows.push(row("fox", "paper: tau 30", 0, 0.6, 10.0));
        let text = changes(&rows);
        assert!(
            text.contains("| paper: tau 30 | fox | 1 | x 1.00 | x 1.00 | 0.00 | +10.0 | +5.0 |"),
            "{text}"
        );
    }

    #[test]
    fn failures_have_the_largest_loss() {
        let text = failures(&rows());
        assert!(
            text.contains(
                "more than 10 points on some scene:\n  - blur 2 px: -30.0 on fox (measured on fox)\n"
            ),
            "{text}"
        );
        assert!(
            text.contains("twins 0.30") && text.contains("JPEG quality 15: -1.0 on fox"),
            "{text}"
        );
    }
}
