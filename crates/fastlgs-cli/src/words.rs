//! Summaries of stage reports as short tables with units. `--json` has all fields.

use fastlgs::eval::Outcome;
use fastlgs_serve::share;

/// Formats rows of (name, text) as an aligned table. Rows with empty text are left out.
pub fn table(lines: &[(&str, String)]) -> String {
    let rows = || lines.iter().filter(|(_, words)| !words.is_empty());
    let width = rows().map(|(name, _)| name.len()).max().unwrap_or(0);
    rows()
        .map(|(name, words)| format!("{name:width$}  {words}"))
        .collect::<Vec<_>>()
        .join("\n")
}

/// Formats a number with thousands separators: 19580 becomes "19,580".
pub fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> = digits
        .as_bytes()
        .rchunks(3)
        .rev()
        .map(|g| std::str::from_utf8(g).unwrap_or_default())
        .collect();
    groups.join(",")
}

/// Formats a number of bytes in megabytes (10^6 bytes).
pub fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

/// Formats the objects of a scene as a table.
pub fn objects(r: &fastlgs::ListReport) -> String {
    let row = |object: &fastlgs::listing::ListedObject| {
        let names = object.names.iter();
        let names: Vec<String> = names
            .map(|name| format!("{} {:.2}", name.name, name.score))
            .collect();
        let part = match object.parent {
            0 => String::new(),
            parent => format!("#{parent}"),
        };
        let size = object.bbox3d.map_or(String::new(), |[low, high]| {
            let [x, y, z] = [0, 1, 2].map(|k| high[k] - low[k]);
            format!("{x:.2} x {y:.2} x {z:.2}")
        });
        [
            format!("#{}", object.id),
            part,
            object.views.to_string(),
            size,
            object.best_view.clone().unwrap_or_default(),
            names.join(", "),
        ]
    };
    let head = [
        "object",
        "part of",
        "views",
        "size",
        "best view",
        "likeliest names",
    ];
    let rows: Vec<[String; 6]> = std::iter::once(head.map(str::to_owned))
        .chain(r.objects.iter().map(row))
        .collect();
    let width = |column: usize| {
        let widths = rows.iter().map(|row| row[column].chars().count());
        widths.max().unwrap_or(0)
    };
    let widths: [usize; 6] = std::array::from_fn(width);
    let line = |row: &[String; 6]| {
        let cells = row.iter().zip(widths);
        let cells: Vec<String> = cells
            .map(|(cell, width)| format!("{cell:width$}"))
            .collect();
        cells.join("  ").trim_end().to_owned()
    };
    let mut lines: Vec<String> = rows.iter().map(line).collect();
    if let Some(sheet) = &r.sheet {
        lines.push(format!("sheet: {}", sheet.display()));
    }
    lines.join("\n")
}

fn decibels(psnr: Option<f64>) -> String {
    psnr.map(|psnr| format!("{psnr:.2} dB")).unwrap_or_default()
}

pub fn preprocess(r: &fastlgs::preprocess::PreprocessReport) -> String {
    let adjusted = r.adjusted.as_ref().map(|a| {
        let verdict = if a.used {
            "bundle adjustment moved all cameras"
        } else {
            "bundle adjustment was rejected"
        };
        format!(
            "; {verdict} (reprojection error {:.2} px before, {:.2} px after)",
            a.error_before, a.error_after
        )
    });
    let reused_results: usize = r.cached.values().map(|c| c[0]).sum();
    let reused = if reused_results > 0 {
        format!(", {} cached results were reused", thousands(reused_results))
    } else {
        String::new()
    };
    let brightness = format!(
        "varies by {:.2} stops between photos",
        r.brightness_spread_stops
    );
    table(&[
        ("scene", r.scene.display().to_string()),
        (
            "photos",
            format!(
                "{} for training, {} pixels, {} held out",
                r.training_photos, r.size, r.held_out
            ),
        ),
        ("masks", thousands(r.masks)),
        (
            "poses",
            format!(
                "{} cameras were moved{}",
                r.moved_cameras,
                adjusted.unwrap_or_default()
            ),
        ),
        (
            "points",
            format!(
                "{} initial points, {} matches of key points",
                thousands(r.points),
                thousands(r.key_point_matches)
            ),
        ),
        (
            "brightness",
            if r.brightness_spread_stops >= 0.15 {
                brightness
            } else {
                String::new()
            },
        ),
        ("time", format!("{:.0} s{reused}", r.seconds_total)),
    ])
}

pub fn remove(r: &fastlgs::remove::RemoveReport) -> String {
    table(&[
        (
            "scene",
            format!(
                "{}, with {} objects and parts",
                r.output.display(),
                thousands(r.left)
            ),
        ),
        ("removed", format!("{} Gaussians", thousands(r.removed))),
        (
            "background",
            format!(
                "{:.0} % is visible in other photos; {} Gaussians fill the rest",
                100.0 * r.seen,
                thousands(r.filled)
            ),
        ),
    ])
}

pub fn train(r: &fastlgs::train::TrainReport) -> String {
    let held_out = decibels(r.psnr_held_out);
    let colour = if held_out.is_empty() {
        "not measured: no photos are held out".to_owned()
    } else {
        format!("{held_out} on held-out photos")
    };
    let rejected = r.mapping_summary.as_ref().map(|s| {
        let left_out = s.few_views + s.unsupported + s.same;
        format!(
            " from {} masks; {left_out} proposals were rejected",
            thousands(s.masks)
        )
    });
    let clear = if r.clear > 0 {
        format!(", {} of them transparent", thousands(r.clear))
    } else {
        String::new()
    };
    table(&[
        ("scene", r.scene.display().to_string()),
        (
            "Gaussians",
            format!(
                "{}, SH degree {}{clear}",
                thousands(r.gaussians),
                r.sh_degree
            ),
        ),
        ("colour", colour),
        (
            "objects",
            format!(
                "{} objects and parts{}",
                thousands(r.objects),
                rejected.unwrap_or_default()
            ),
        ),
        (
            "time",
            format!(
                "{:.0} s for {} iterations at {}, {:.0} s for objects{}",
                r.seconds,
                thousands(r.iterations as usize),
                r.size,
                r.mapping_seconds,
                r.mapping_summary
                    .as_ref()
                    .map_or_else(String::new, |s| format!(
                        " ({} MB of memory)",
                        s.megabytes + 1
                    ))
            ),
        ),
        ("device", format!("{} ({})", r.adapter, r.device.why)),
    ])
}

pub fn render(r: &fastlgs::render::RenderReport) -> String {
    let mean = r.render_ms.iter().sum::<f64>() / r.render_ms.len().max(1) as f64;
    let mut lines: Vec<String> = r
        .files
        .iter()
        .map(|file| file.display().to_string())
        .collect();
    let views = r.render_ms.len();
    lines.push(format!(
        "{views} view{} of {}, {mean:.0} ms each ({})",
        if views == 1 { "" } else { "s" },
        r.size,
        r.adapter
    ));
    lines.join("\n")
}

pub fn export(r: &fastlgs::export::ExportReport) -> String {
    let r = match r {
        fastlgs::export::ExportReport::Path { output, frames, .. } => {
            return format!("{}: a camera path of {frames} views", output.display());
        }
        fastlgs::export::ExportReport::Scene(scene) => scene,
    };
    let quality = match (r.psnr_held_out.before, r.psnr_held_out.after) {
        (Some(before), Some(after)) => {
            format!("{after:.2} dB on held-out photos, {before:.2} dB before")
        }
        _ => format!(
            "{:.1} dB against renderings of the original scene",
            r.psnr_against_original
        ),
    };
    table(&[
        (
            "written",
            format!("{}, {}", r.output.display(), megabytes(r.bytes)),
        ),
        (
            "scene",
            format!(
                "{}, queries need {}",
                r.scene.display(),
                megabytes(r.bytes_before)
            ),
        ),
        (
            "Gaussians",
            format!("{}, SH degree {}", thousands(r.gaussians), r.sh_degree),
        ),
        ("colour", quality),
    ])
}

pub fn share(r: &share::ShareReport) -> String {
    let folder = r.output.display();
    let said = table(&[
        (
            "written",
            format!("{folder}, {}, for any web server", megabytes(r.bytes)),
        ),
        ("Gaussians", thousands(r.gaussians)),
        (
            "words",
            format!(
                "{} can be queried; {} of them name an object of the scene",
                thousands(r.words),
                thousands(r.found)
            ),
        ),
    ]);
    format!("{said}\n\ntry it:  python3 -m http.server -d {folder}")
}

pub fn synth(r: &fastlgs::synth::SynthReport) -> String {
    let photos = r.photos.display();
    format!(
        "{photos}: {} photos at {} of '{}', with exact poses, depths, masks and labels\nobjects: {}",
        r.views,
        r.size,
        r.kind,
        r.objects.join(", ")
    )
}

pub fn teach(r: &fastlgs::teach::TeachReport) -> String {
    let shown = r
        .object
        .map_or_else(|| "the picture".to_owned(), |id| format!("object {id}"));
    format!(
        "\"{}\" now means {shown}, by {} embeddings; {} examples of the name are stored in {}",
        r.name,
        r.views,
        r.examples,
        r.kept.display()
    )
}

pub fn eval(r: &fastlgs::eval::EvalReport) -> String {
    let mut rows = vec![
        (
            "scene",
            format!(
                "{}: {} Gaussians, {} objects and parts, {:.1} MB",
                r.scene.display(),
                thousands(r.gaussians),
                thousands(r.objects),
                r.scene_bytes as f64 / 1e6
            ),
        ),
        ("colour", eval_color(r)),
    ];
    if let Some(depth) = &r.depth {
        rows.push(("depth", eval_depth(depth)));
    }
    if r.labels_scored > 0 {
        rows.extend(eval_labels(r));
    }
    if let Some(first) = r.query_ms_first {
        let next = r.query_ms_next.unwrap_or_default();
        let text = format!(
            "{first:.0} ms for the first text in a view, {next:.0} ms for the next ({})",
            r.adapter
        );
        rows.push(("query", text));
    }
    let names = r.oracle_by_label.keys();
    let width = names.map(|name| name.chars().count()).max().unwrap_or(0);
    let mut text = table(&rows);
    for (name, oracle) in &r.oracle_by_label {
        let asked = two_decimals(r.miou_by_label.get(name).copied().flatten());
        let rank = r
            .oracle_rank_by_label
            .get(name)
            .map(|rank| format!(" (rank {rank} for the text)"))
            .unwrap_or_default();
        text += &format!(
            "\n  {name:width$}  text IoU {asked}, oracle IoU {}{rank}",
            two_decimals(*oracle)
        );
    }
    text
}

fn two_decimals(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |v| format!("{v:.2}"))
}

/// Colour of the held-out photos; empty if none was measured.
fn eval_color(r: &fastlgs::eval::EvalReport) -> String {
    let Some(_) = r.psnr else {
        return String::new();
    };
    let aligned = r
        .psnr_aligned
        .map(|p| format!(", {p:.2} dB with aligned poses"))
        .unwrap_or_default();
    format!(
        "{}{aligned}, SSIM {:.3}, on held-out photos",
        decibels(r.psnr),
        r.ssim.unwrap_or_default()
    )
}

/// Accuracy of the rendered depth.
fn eval_depth(depth: &fastlgs::eval::DepthQuality) -> String {
    let median = depth.median_error.map_or_else(
        || "most pixels are empty".to_owned(),
        |error| format!("median error {:.1} %", 100.0 * error),
    );
    let shares = [
        depth.above_5_percent,
        depth.above_10_percent,
        depth.above_25_percent,
    ];
    let [five, ten, quarter] = shares.map(|share| format!("{:.0} %", 100.0 * share));
    format!(
        "{median}; {five} of the pixels are off by more than 5 %, {ten} by more than 10 %, {quarter} by more than 25 % ({} held-out photos)",
        depth.views
    )
}

/// Rows of the labels and of absent names.
fn eval_labels(r: &fastlgs::eval::EvalReport) -> [(&'static str, String); 3] {
    let outcomes = r.outcomes.iter().map(|(outcome, count)| {
        let words = match outcome {
            Outcome::Right => "correct",
            Outcome::Refused => "not found",
            Outcome::WrongLevel => "with the wrong level",
            Outcome::WrongObject => "with the wrong object",
            Outcome::WrongMask => "with a wrong mask",
        };
        format!("{count} {words}")
    });
    let colored = r
        .absent_colored_rejected
        .map(|share| format!(", {:.0} % with a colour added", 100.0 * share))
        .unwrap_or_default();
    [
        (
            "objects",
            format!(
                "oracle mIoU {} over {} labels in {} views",
                two_decimals(r.oracle_miou),
                r.labels_scored,
                r.views_scored
            ),
        ),
        (
            "texts",
            format!(
                "mIoU {}: {}",
                two_decimals(r.miou),
                outcomes.collect::<Vec<_>>().join(", ")
            ),
        ),
        (
            "absent",
            format!(
                "{} of {} absent names are rejected{colored}; AUROC {}",
                r.absent_rejected,
                r.absent_texts,
                two_decimals(r.absent_auroc)
            ),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_are_short_tables() {
        let made = fastlgs::train::TrainReport {
            gaussians: 28782,
            objects: 596,
            seconds: 87.2,
            iterations: 2000,
            size: "270x480".into(),
            ..Default::default()
        };
        let said = train(&fastlgs::train::TrainReport {
            psnr_held_out: Some(31.932),
            ..made.clone()
        });
        assert!(
            said.contains("Gaussians  28,782")
                && said.contains("31.93 dB on held-out photos")
                && said.contains("87 s for 2,000 iterations"),
            "{said}"
        );
        assert!(train(&made).contains("no photos are held out"));
        let some = |v: f64| Some(v);
        let plain = fastlgs::eval::EvalReport {
            gaussians: 12,
            objects: 3,
            ..Default::default()
        };
        assert_eq!(
            eval(&plain).lines().count(),
            1,
            "values that were not measured are left out: {}",
            eval(&plain)
        );
        let labelled = fastlgs::eval::EvalReport {
            labels_scored: 2,
            views_scored: 1,
            miou: some(0.4),
            oracle_miou: some(0.875),
            outcomes: [(Outcome::Right, 1), (Outcome::Refused, 1)].into(),
            oracle_by_label: [("fox".to_owned(), some(0.83))].into(),
            miou_by_label: [("fox".to_owned(), some(0.7))].into(),
            oracle_rank_by_label: [("fox".to_owned(), 4)].into(),
            ..plain
        };
        let said = eval(&labelled);
        for words in [
            "oracle mIoU 0.88 over 2 labels",
            "1 correct, 1 not found",
            "fox  text IoU 0.70, oracle IoU 0.83 (rank 4 for the text)",
        ] {
            assert!(said.contains(words), "'{words}' is missing: {said}");
        }
        assert_eq!(
            [7, 1234, 1234567].map(thousands),
            ["7", "1,234", "1,234,567"]
        );
    }
}
