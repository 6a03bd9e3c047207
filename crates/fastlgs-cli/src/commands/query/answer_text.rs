//! Formats answers for the terminal and for captions.

use crate::words::thousands;
use fastlgs::query::answer::{AnswerReport, NearObject, ObjectReport};
use std::path::Path;

/// Formats the nearest objects of a text that is not found, and how to accept one.
fn nearest_text(report: &AnswerReport, scene: &Path) -> Vec<String> {
    let AnswerReport { text, nearest, .. } = report;
    let scene = scene.display();
    if !report.known {
        return vec![
            format!("  to point at it: fastlgs query {scene} --point X,Y"),
            format!("  to teach it:    fastlgs teach \"{text}\" {scene} --point X,Y"),
            "  to know more names, make the scene with --encoder clip".to_owned(),
        ];
    }
    let Some(first) = nearest.first() else {
        return Vec::new();
    };
    let near = |object: &NearObject| {
        let view = object.best_view.as_ref();
        let view = view.map_or(String::new(), |view| format!(", best view {view}"));
        format!("#{} (confidence {:.2}{view})", object.id, object.score)
    };
    let id = first.id;
    let near: Vec<String> = nearest.iter().map(near).collect();
    let mut lines = vec![
        format!("  nearest objects: {}", near.join(", ")),
        format!("  to see one:    fastlgs query {scene} --object {id} -o DIR"),
        format!("  to name it:    fastlgs teach \"{text}\" {scene} --object {id}"),
    ];
    // The rate at which the nearest object is found, rounded up.
    let rate = (100.0 * (1.0 - first.score)).floor() / 100.0 + 0.01;
    if rate < 1.0 {
        lines.push(format!(
            "  to accept it:  --false-alarms {rate:.2} (the share of absent names that are then answered)"
        ));
    }
    lines
}

/// Formats an answer for the terminal.
pub(super) fn answer_text(report: &AnswerReport, scene: &Path) -> String {
    let AnswerReport {
        text, view, score, ..
    } = report;
    let of = |object: &ObjectReport| {
        let place = object.bbox2d.map_or_else(
            || "not in this view".to_owned(),
            |[x0, y0, x1, y1]| format!("at {x0},{y0} to {x1},{y1}"),
        );
        format!(
            "  #{}: {} pixels {place}, confidence {:.2}",
            object.id,
            thousands(object.pixels),
            object.score
        )
    };
    let calibration_note = if report.calibrated {
        ""
    } else {
        " (not calibrated; run fastlgs models calibrate)"
    };
    let taught = if report.taught { ", taught" } else { "" };
    if !report.found {
        let verdict = if report.known {
            format!(
                "{text}: not found; the best object has confidence {score:.2}{calibration_note}{taught}"
            )
        } else {
            format!("{text}: the built-in encoder does not know this name")
        };
        let mut lines = vec![verdict];
        lines.extend(nearest_text(report, scene));
        return lines.join("\n");
    }
    let count = if report.objects.len() == 1 {
        "1 object".to_owned()
    } else {
        format!("{} objects", report.objects.len())
    };
    let shown = match &report.seen_best {
        Some(best) => format!("hardly visible in {view}; best view: {best}"),
        None => format!("{} pixels in {view}", thousands(report.pixels)),
    };
    let mut lines = vec![format!(
        "{text}: found, confidence {score:.2}{calibration_note}{taught}, {count}, {shown} ({:.0} ms)",
        report.ms.total
    )];
    if report.objects.len() > 1 {
        lines.extend(report.objects.iter().map(of));
    }
    let files = [("mask", &report.mask), ("heat map", &report.heatmap)];
    lines.extend(
        files
            .into_iter()
            .filter_map(|(what, path)| Some(format!("  {what}: {}", path.as_ref()?.display()))),
    );
    lines.join("\n")
}

/// Formats an answer as the caption of its picture.
pub(super) fn caption(report: &AnswerReport) -> String {
    let verdict = if report.found { "found" } else { "not found" };
    format!(
        "{verdict}, {:.2}, {} pixels",
        report.score,
        thousands(report.pixels)
    )
}
