//! `fastlgs bench report`: the other benches' results and sample pictures in one HTML file that needs nothing else.

use crate::trial::{self, text};
use anyhow::{Context, Result, bail};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use fastlgs::session::answer::Question;
use fastlgs::session::ask::Ask;
use fastlgs::session::pictures::overlay;
use fastlgs::{Run, Session};
use fastlgs_core::{SceneFolder, fs, image_io, labels, turbo};
use fastlgs_grid::query::QueryConfig;
use image::{Rgb, RgbImage};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench report out --scenes scenes/fox -o report.html")]
pub struct Args {
    /// Folders that other benches wrote to.
    #[arg(required = true)]
    results: Vec<PathBuf>,
    /// Trained scenes with labels, to show pictures of.
    #[arg(long, num_args = 1..)]
    scenes: Vec<PathBuf>,
    /// File to write.
    #[arg(short, long, default_value = "report.html")]
    output: PathBuf,
}

/// Benches in the order of the report: file name, title, and what a reader should know.
const SECTIONS: [(&str, &str, &str); 7] = [
    (
        "chart",
        "Accuracy against time",
        "Each row can be had again by its command. Joined spots are beaten by no other in time and accuracy both.",
    ),
    ("stability", "Stability", "Change of each figure against the undisturbed input; a row holds if the mean loss stays within its bound."),
    (
        "size",
        "No more model than a scene needs",
        "Models pruned, cut in colour degree and in precision; filled spots are what --budget auto chooses.",
    ),
    ("paper", "The paper's way", "Its ablations of matching, field and codes; rows called all train anew."),
    ("names", "Texts", "Each scene by what was chosen on the others, and by what was chosen with it."),
    ("speed", "Speed", "Training and rendering by Gaussians and resolution."),
    ("vision", "Masks and embeddings alone", "Best masks of the segmenter for each label, and the name that the encoder finds nearest."),
];

/// Labels that a scene is asked for.
const ASKED: usize = 3;

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let mut body = String::new();
    let mut found = Vec::new();
    for (name, title, about) in SECTIONS {
        for folder in &args.results {
            let path = folder.join(format!("{name}.json"));
            if path.is_file() {
                let value: Value = fs::read_json(&path)?;
                write!(body, "<h2>{title}</h2><p>{about}</p>")?;
                for chart in charts(folder, name)? {
                    write!(body, "<figure>{chart}</figure>")?;
                }
                body += &table_of(&value);
                found.push(path);
            }
        }
    }
    if found.is_empty() {
        bail!(
            "no results of a bench (chart.json, stability.json, ...) in {}",
            args.results.iter().map(|r| text(r)).collect::<Vec<_>>().join(", ")
        );
    }
    for scene in &args.scenes {
        body += &pictures(scene, run)?;
    }
    let page = format!("{}{}{}{body}</main></body></html>\n", HEAD, "<h1>FastLGS: measured</h1>", machine());
    fs::write_atomic(&args.output, |file| std::io::Write::write_all(file, page.as_bytes()))?;
    Ok(json!({ "report": args.output, "results": found, "bytes": page.len() }))
}

const HEAD: &str = "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><title>FastLGS: measured</title><style>
body{font:15px/1.5 system-ui,sans-serif;margin:0;color:#1c1f24;background:#fff}
main{max-width:72rem;margin:auto;padding:2rem 1rem}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}
th,td{border-bottom:1px solid #d8dce2;padding:.2rem .6rem;text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
td.fails{color:#b3261e;font-weight:600} td.holds{color:#1a7f37}
figure{margin:1rem 0} figure svg{max-width:100%;height:auto}
.row{display:flex;flex-wrap:wrap;gap:.8rem} .row figure{margin:0;font-size:13px} .row img{max-height:15rem;display:block}
</style></head><body><main>";

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The SVG files of a bench, in order of their names.
fn charts(folder: &Path, name: &str) -> Result<Vec<String>> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).with_context(|| folder.display().to_string())?.flatten().map(|e| e.path()).collect();
    let own = |stem: &str| stem == name || stem.strip_prefix(name).is_some_and(|rest| rest.starts_with('-'));
    files.retain(|p| p.extension().is_some_and(|e| e == "svg") && p.file_stem().is_some_and(|s| own(&s.to_string_lossy())));
    files.sort();
    files.iter().map(|p| String::from_utf8(fs::read(p)?).with_context(|| format!("{}: not UTF-8 text", p.display()))).collect()
}

/// The rows of a result as a table; of `speed`, those of each device.
fn table_of(value: &Value) -> String {
    let rows: Vec<&Value> = match (value["rows"].as_array(), value["devices"].as_array()) {
        (Some(rows), _) => rows.iter().collect(),
        (None, Some(devices)) => devices.iter().flat_map(|d| d["settings"].as_array().into_iter().flatten()).collect(),
        _ => Vec::new(),
    };
    let Some(Value::Object(first)) = rows.first() else { return String::new() };
    let columns: Vec<&String> = first.iter().filter(|(_, v)| !v.is_object() && !v.is_array()).map(|(k, _)| k).collect();
    // Words first: what a row is about.
    let (words, numbers): (Vec<&String>, Vec<&String>) = columns.into_iter().partition(|c| first[*c].is_string());
    let columns = [words, numbers].concat();
    let cell = |value: &Value| match value {
        Value::String(text) => escaped(text),
        Value::Number(n) if n.is_f64() => format!("{:.3}", n.as_f64().unwrap_or(f64::NAN)),
        Value::Null => String::new(),
        other => other.to_string(),
    };
    let class =
        |value: &Value| value.as_str().filter(|v| ["holds", "fails"].contains(v)).map_or(String::new(), |v| format!(" class=\"{v}\""));
    let head: String = columns.iter().map(|c| format!("<th>{}</th>", c.replace('_', " "))).collect();
    let row = |row: &Value| columns.iter().map(|c| format!("<td{}>{}</td>", class(&row[*c]), cell(&row[*c]))).collect::<String>();
    let body: String = rows.iter().map(|r| format!("<tr>{}</tr>", row(r))).collect();
    format!("<table><tr>{head}</tr>{body}</table>")
}

/// What it was measured on.
fn machine() -> String {
    let model = std::fs::read_to_string("/proc/cpuinfo").ok();
    let model = model
        .as_deref()
        .and_then(|t| t.lines().find_map(|l| l.strip_prefix("model name")?.split_once(':')))
        .map_or("unknown processor", |m| m.1.trim());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let (version, adapters) = (env!("CARGO_PKG_VERSION"), fastlgs_raster::adapters().join(", "));
    format!("<p>fastlgs {version}; {cores} cores of {}; devices: {}</p>", escaped(model), escaped(&adapters))
}

/// A held-out view of a scene: photo, rendered colour, objects, and what some labels' texts find.
fn pictures(scene: &Path, run: &Run) -> Result<String> {
    let folder = SceneFolder::open(scene)?;
    let (manifest, cameras) = (folder.manifest()?, folder.cameras()?);
    let labelled = labels::load(&Path::new(&manifest.photos).join("labels"), None)?;
    let view = labelled.first().context("a labelled view")?;
    let name = &cameras[folder.view_index(&cameras, &view.name)?].name;
    let camera = cameras[folder.view_index(&cameras, &view.name)?].clone();
    let mut session = Session::open(scene, run.device)?;
    let (grid, frame, field) = (session.grid()?, session.render(&camera)?, session.field(&camera, None)?);
    let color = image_io::from_planar(frame.channels(0, 3), frame.width, frame.height);
    let ids = field.owners(&grid);
    let objects = RgbImage::from_fn(ids.width, ids.height, |x, y| Rgb(turbo::id_color(ids.at(x, y))));
    let photo = folder.photo(name)?;
    let mut shown = vec![("photo".to_owned(), photo), ("rendered".to_owned(), color.clone()), ("objects".to_owned(), objects)];
    for label in view.labels.iter().take(ASKED) {
        let ask = Ask::Text(label.category.clone());
        let question = Question { ask: &ask, negatives: &[], config: QueryConfig::default(), dilate: None, candidates: 0 };
        let (answer, report) = question.put(&session, &grid, &field, &camera, 0.0)?;
        // Nothing found is an answer as well, but no picture.
        if report.found {
            shown.push((format!("“{}”", label.category), overlay(&color, &answer.mask)));
        }
    }
    let mut html = format!("<h2>{}: {}</h2><div class=\"row\">", escaped(&trial::name(scene)), escaped(name));
    for (what, picture) in shown {
        let data = BASE64_STANDARD.encode(image_io::encode_png(picture)?);
        write!(html, "<figure><img alt=\"{0}\" src=\"data:image/png;base64,{data}\">{0}</figure>", escaped(&what))?;
    }
    Ok(html + "</div>")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_become_a_table_with_words_first() {
        let html = table_of(&json!({ "rows": [{ "a": 1.5, "b": "x<y", "verdict": "fails", "nested": {} }] }));
        assert!(html.starts_with("<table><tr><th>b</th><th>verdict</th><th>a</th></tr>"), "{html}");
        assert!(html.contains("x&lt;y") && html.contains("<td class=\"fails\">fails</td>") && html.contains("1.500"), "{html}");
    }
}
