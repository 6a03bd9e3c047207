//! Figures in the README.

use super::figures::{Runs, labelled};
use super::markdown::{stamp, table};
use super::rows::Rows;
use super::texts;
use super::ways::BASE;
use anyhow::{Context, Result};
use fastlgs_synth::Kind;
use serde_json::Value;

/// Markers of the generated table and picture.
const FIGURES: [&str; 2] = [
    "<!-- figures: fastlgs-bench all -->\n",
    "<!-- end of figures -->",
];
/// Markers of the generated sentence about texts.
const TEXTS: [&str; 2] = [
    "<!-- texts: fastlgs-bench all -->\n",
    "<!-- end of texts -->",
];

/// Returns the README with the parts between its markers made from `rows`.
///
/// # Errors
/// A marker is missing.
pub fn with_figures(readme: &str, rows: &Rows) -> Result<String> {
    let sentences = [texts::answered(rows), texts::with_clip(rows)];
    let about_texts: String = sentences
        .into_iter()
        .flatten()
        .map(|text| text + "\n")
        .collect();
    let readme = replaced(readme, TEXTS, &about_texts)?;
    replaced(&readme, FIGURES, &readme_table(rows))
}

fn replaced(readme: &str, [begin, end]: [&str; 2], new: &str) -> Result<String> {
    let missing = |marker: &str| format!("the line '{}' is missing", marker.trim_end());
    let (before, rest) = readme.split_once(begin).with_context(|| missing(begin))?;
    let (_, after) = rest.split_once(end).with_context(|| missing(end))?;
    Ok(format!("{before}{begin}{new}{end}{after}"))
}

/// Marks generated scenes, which have exact masks.
fn titled(scene: &str) -> String {
    let note = Kind::of(scene).map_or("", |_| " (generated, exact masks)");
    format!("{scene}{note}")
}

fn readme_table(rows: &Rows) -> String {
    let scenes: Vec<(&str, Runs)> = labelled(rows)
        .into_iter()
        .filter_map(|scene| Some((scene, Runs::of(rows, scene, BASE)?)))
        .collect();
    let line = |name: &str, of: &dyn Fn(&Runs) -> String| {
        std::iter::once(name.to_owned())
            .chain(scenes.iter().map(|(_, runs)| of(runs)))
            .collect::<Vec<String>>()
    };
    let first = |runs: &Runs, name: &str| match &runs.rows[0][name] {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let rounded = |runs: &Runs, name: &str| {
        runs.mean(name)
            .map_or(String::new(), |m| format!("{:.0}", m.mean))
    };
    let lines = [
        line("seeds", &|runs| runs.rows.len().to_string()),
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
            format!("{} of {}", runs.count("right"), first(runs, "labels"))
        }),
        line("absent texts that are refused", &|runs| {
            format!(
                "{} of {}",
                runs.count("absent_rejected"),
                first(runs, "absent_texts")
            )
        }),
        line("seconds from posed photos to answers", &|runs| {
            runs.total_seconds().map_or(String::new(), |s| s.text(0))
        }),
    ];
    let titles: Vec<String> = scenes
        .iter()
        .map(|(scene, runs)| format!("{}, {}", titled(scene), first(runs, "size")))
        .collect();
    let head: Vec<&str> = std::iter::once("")
        .chain(titles.iter().map(String::as_str))
        .collect();
    format!(
        "{}\n{}\n![accuracy of objects against seconds](docs/results/speed.svg)\n\n\
         ![accuracy of answers to texts against seconds](docs/results/speed-texts.svg)\n",
        stamp(rows),
        table(&head, &lines)
    )
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::rows;
    use super::*;

    #[test]
    fn the_readme_changes_between_its_markers_only() {
        let between = |[begin, end]: [&str; 2]| format!("{begin}old\n{end}\n");
        let readme = format!("# Title\n{}and\n{}more\n", between(TEXTS), between(FIGURES));
        let new = with_figures(&readme, &rows()).expect("markers");
        assert!(
            new.contains("The built-in encoder answers 2 of 4 labels correctly (fox)"),
            "{new}"
        );
        assert!(new.starts_with("# Title\n") && new.ends_with("\nmore\n") && !new.contains("old"));
        assert!(
            new.contains("0.85 (0.80 to 0.90)") && new.contains("2 of 4"),
            "{new}"
        );
        assert_eq!(with_figures(&new, &rows()).expect("markers"), new);
        assert!(with_figures("no marker", &rows()).is_err());
    }
}
