//! `fastlgs-bench all`: makes all tables and figures of the results from one version.
//!
//! Measured rows are kept in `rows.json`, so that an interrupted run continues with the next row.
//! All pages are made from these rows alone.

mod charts;
mod figures;
mod index;
mod markdown;
mod measure;
mod pages;
mod plan;
mod readme;
mod rows;
mod stability;
mod summary;
mod texts;
mod ways;

use crate::clip;
use anyhow::{Context, Result, bail};
use fastlgs::Run;
use fastlgs_core::fs;
use fastlgs_synth::Kind;
use measure::Measure;
use plan::{Planned, SceneSource};
use rows::Rows;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use ways::{BASE, WAYS};

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs-bench all --scenes ../data/fox,../data/office,table -o docs/results --device cpu"
)]
pub struct Args {
    /// Folders of photos with labels/ beside them, and kinds of generated scenes, separated by
    /// commas.
    #[arg(long, value_delimiter = ',', default_value = "table")]
    scenes: Vec<String>,
    /// Ways to measure, by their names in the tables, separated by commas. Default: all. Missing
    /// rows that they are compared with are measured as well. `none` only writes the pages again.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    ways: Vec<String>,
    /// Folder of real CLIP embeddings, for `fastlgs-bench clip`.
    #[arg(long, value_name = "FOLDER")]
    clip: Option<PathBuf>,
    /// Seeds, separated by commas.
    #[arg(long, value_delimiter = ',', default_values_t = [0, 1, 2], value_name = "NUMBERS")]
    seeds: Vec<u64>,
    /// Begin no further row after this time. The next run continues.
    #[arg(long)]
    minutes: Option<u64>,
    /// Iterations of all trainings, and small generated photos: for tests.
    #[arg(long, hide = true)]
    iterations: Option<u32>,
    /// Folder of base scenes, which later rows and runs reuse. Default: OUTPUT/.scenes.
    #[arg(long)]
    work: Option<PathBuf>,
    /// README whose table of figures is replaced, between its markers.
    #[arg(long)]
    readme: Option<PathBuf>,
    /// Folder of rows.json and of all pages and charts.
    #[arg(short, long)]
    output: PathBuf,
}

/// Returns the given scenes and the difficult ones.
fn scenes(names: &[String]) -> Result<Vec<SceneSource>> {
    let mut scenes: Vec<SceneSource> = names.iter().map(|name| SceneSource::of(name)).collect();
    for scene in &scenes {
        if scene.photos.is_none() && Kind::of(&scene.name).is_none() {
            bail!(
                "--scenes: '{}' is neither a folder of photos nor a kind of generated scene",
                scene.name
            );
        }
        let twice = scenes
            .iter()
            .filter(|other| other.name == scene.name)
            .count()
            > 1;
        if twice {
            bail!(
                "--scenes: two scenes are called '{}'; rename a folder",
                scene.name
            );
        }
    }
    scenes.extend(plan::difficult(&scenes));
    Ok(scenes)
}

/// Refuses unknown names of ways.
fn check_ways(names: &[String]) -> Result<()> {
    let is_known = |name: &str| name == "none" || WAYS.iter().any(|way| way.name == name);
    if let Some(unknown) = names.iter().find(|name| !is_known(name)) {
        let known: Vec<&str> = WAYS.iter().map(|way| way.name).collect();
        bail!(
            "--ways: '{unknown}' is unknown; choose from {}",
            known.join(", ")
        );
    }
    Ok(())
}

/// Measures the missing rows, and writes all pages.
pub fn run(args: &Args, run: &Run) -> Result<Value> {
    check_ways(&args.ways)?;
    let started = Instant::now();
    let scenes = scenes(&args.scenes)?;
    std::fs::create_dir_all(&args.output).with_context(|| args.output.display().to_string())?;
    let file = args.output.join("rows.json");
    let mut rows = Rows::load(&file, !args.ways.iter().any(|name| name == "none"))?;
    let work = args
        .work
        .clone()
        .unwrap_or_else(|| args.output.join(".scenes"));
    std::fs::create_dir_all(&work).with_context(|| work.display().to_string())?;
    let measure = Measure {
        run,
        work: &work.canonicalize()?,
        iterations: args.iterations.map(|n| n.to_string()),
    };
    let mut missing = chosen(plan::rows(&scenes, &args.seeds), &args.ways);
    missing.retain(|row| !rows.has(row));
    let mut measured = Vec::new();
    let progress = run.work("rows", missing.len() as u64);
    for planned in &missing {
        let late = |minutes| started.elapsed() >= Duration::from_secs(60 * minutes);
        if args.minutes.is_some_and(late) {
            break;
        }
        let name = format!(
            "{}, '{}', seed {}",
            planned.scene.name, planned.way.name, planned.seed
        );
        let mut row = measure.row(planned).with_context(|| name.clone())?;
        tracing::info!(%row, "{name}");
        row["scene"] = json!(planned.scene.name);
        row["way"] = json!(planned.way.name);
        row["seed"] = json!(planned.seed);
        measured.push(row.clone());
        rows.rows.push(row);
        fs::write_json(&file, &rows)?;
        progress.advance()?;
    }
    if let Some(folder) = args.clip.clone().filter(|_| rows.clip.is_none()) {
        rows.clip = Some(serde_json::to_value(clip::run(&clip::Args { folder })?)?);
        fs::write_json(&file, &rows)?;
    }
    write_pages(args, &rows)?;
    Ok(json!({
        "version": rows.version,
        "rows": rows.rows.len(),
        "missing": missing.len() - measured.len(),
        "measured": measured,
    }))
}

/// Returns the rows of the named ways, and the rows that they are compared with. All rows if no way
/// is named.
fn chosen<'a>(rows: Vec<Planned<'a>>, names: &[String]) -> Vec<Planned<'a>> {
    if names.is_empty() {
        return rows;
    }
    let is_named = |row: &Planned| names.iter().any(|name| name == row.way.name);
    let needs = |row: &Planned, other: &Planned| {
        let is_compared =
            [BASE, row.way.reference(), row.way.text_reference()].contains(&other.way.name);
        is_compared && (&row.scene.name, row.seed) == (&other.scene.name, other.seed)
    };
    let is_kept =
        |row: &Planned| is_named(row) || rows.iter().any(|r| is_named(r) && needs(r, row));
    let kept: Vec<bool> = rows.iter().map(is_kept).collect();
    let pairs = rows.into_iter().zip(kept);
    pairs.filter(|pair| pair.1).map(|pair| pair.0).collect()
}

fn write_pages(args: &Args, rows: &Rows) -> Result<()> {
    for (name, text) in pages::all(rows)? {
        write(&args.output.join(name), &text)?;
    }
    if let Some(readme) = &args.readme {
        let text = String::from_utf8_lossy(&fs::read(readme)?).into_owned();
        let name = || readme.display().to_string();
        let new = readme::with_figures(&text, rows).with_context(name)?;
        write(readme, &new)?;
    }
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    Ok(fs::write_atomic(path, |file| {
        std::io::Write::write_all(file, text.as_bytes())
    })?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_and_equal_scenes_are_refused() {
        let names =
            |names: &[&str]| scenes(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>());
        assert!(names(&["no-such-scene"]).is_err());
        assert!(names(&["table", "table"]).is_err());
        assert!(names(&["table", "twins"]).is_ok());
    }

    #[test]
    fn a_way_is_measured_with_its_references() {
        let folder = tempfile::tempdir().expect("a folder");
        let photos = folder.path().join("fox");
        std::fs::create_dir_all(photos.join("labels")).expect("photos");
        let scenes = [
            SceneSource::of(photos.to_str().expect("UTF-8")),
            SceneSource::of("table"),
        ];
        let names = |ways: &[&str]| -> Vec<(String, &str, u64)> {
            let ways: Vec<String> = ways.iter().map(|way| (*way).to_owned()).collect();
            let rows = chosen(plan::rows(&scenes, &[1]), &ways);
            let name = |row: Planned| (row.scene.name.clone(), row.way.name, row.seed);
            rows.into_iter().map(name).collect()
        };
        let of_fox = |way| ("fox".to_owned(), way, 1);
        let expected = [BASE, ways::UNCHANGED, "blur 2 px"].map(of_fox);
        assert_eq!(names(&["blur 2 px"]), expected);
        assert_eq!(names(&["none"]), []);
        assert!(names(&[]).len() > 50);
    }

    /// The committed pages are those of the committed rows, and so is the table in the README.
    #[test]
    fn published_pages_are_made_from_their_rows() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let folder = root.join("docs/results");
        let rows: Rows = fs::read_json(&folder.join("rows.json")).expect("the published rows");
        for (name, text) in pages::all(&rows).expect("pages") {
            let published = std::fs::read_to_string(folder.join(&name)).unwrap_or_default();
            assert!(
                published == text,
                "docs/results/{name} differs from its rows; run fastlgs-bench all --ways none --readme README.md -o docs/results"
            );
        }
        let readme = std::fs::read_to_string(root.join("README.md")).expect("the README");
        let expected = readme::with_figures(&readme, &rows).expect("markers");
        assert!(
            readme == expected,
            "README.md differs from docs/results/rows.json"
        );
    }
}
