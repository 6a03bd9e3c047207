//! `fastlgs batch`: several folders of photos to trained scenes, in one call.

use crate::{Outcome, again, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::SceneFolder;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs batch photos/* -o scenes --preprocess \"--max-side 480\" --train \"--preset quick\"\n\n\
Scenes that were made with the same options are kept; a run that was broken off goes on where it was. A scene that fails does not \
stop the others. To spread scenes over machines, let a workflow engine call preprocess and train: see workflows/Snakefile.")]
pub struct Args {
    /// Folders of photos.
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Folder of the scenes; each is named like its folder of photos.
    #[arg(short, long)]
    output: PathBuf,
    /// Options of `fastlgs preprocess`, separated by spaces.
    #[arg(long, value_name = "OPTIONS", default_value = "", allow_hyphen_values = true)]
    preprocess: String,
    /// Options of `fastlgs train`, separated by spaces.
    #[arg(long, value_name = "OPTIONS", default_value = "", allow_hyphen_values = true)]
    train: String,
}

/// Note of the manifest: what a scene was made with.
const NOTE: &str = "batch";

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let mut names: BTreeMap<String, &Path> = BTreeMap::new();
    for photos in &args.photos {
        let own = photos.canonicalize().with_context(|| format!("{}: this folder of photos cannot be opened", photos.display()))?;
        let name = own.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = names.insert(name.clone(), photos) {
            bail!("{} and {} would both become the scene '{name}'; call one of them otherwise", other.display(), photos.display());
        }
    }
    let bar = ui::bar(common, names.len() as u64, "scenes");
    let mut rows = Vec::new();
    for (name, photos) in &names {
        bar.set_message(name.clone());
        let scene = args.output.join(name);
        let mut row = json!({ "photos": photos, "scene": scene });
        match make(args, photos, &scene, common) {
            Ok((state, train)) => {
                row["state"] = json!(state);
                for key in ["objects", "gaussians", "psnr_held_out", "seconds"] {
                    row[key] = train[key].clone();
                }
            }
            Err(error) => {
                row["state"] = json!("failed");
                row["error"] = json!(crate::one_sentence(&error));
            }
        }
        if common.json.is_none() && !common.quiet {
            bar.suspend(|| println!("{}", line(&row)));
        }
        rows.push(row);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let failed = rows.iter().filter(|r| r["state"] == "failed").count();
    if common.json.is_some() {
        report::give(common, &json!({ "scenes": rows, "failed": failed }))?;
    }
    if failed > 0 {
        bail!("{failed} of {} scenes could not be made; what is said of them above tells why", names.len());
    }
    Ok(Outcome::Done)
}

fn line(row: &Value) -> String {
    let scene = row["scene"].as_str().unwrap_or_default();
    match row["error"].as_str() {
        Some(error) => format!("{scene}: {error}"),
        None => {
            format!("{scene}: {}, {} objects, {} Gaussians", row["state"].as_str().unwrap_or_default(), row["objects"], row["gaussians"])
        }
    }
}

/// Makes a scene unless it is there; whether it was made or kept, and the report of its training.
fn make(args: &Args, photos: &Path, scene: &Path, common: &ui::Common) -> Result<(&'static str, Value)> {
    let photos = photos.canonicalize()?;
    let with = json!([env!("CARGO_PKG_VERSION"), photos, args.preprocess, args.train, common.seed]);
    let folder = SceneFolder::new(scene);
    let known = folder.manifest().ok().filter(|manifest| manifest.notes.get(NOTE) == Some(&with));
    if let Some(train) = known.as_ref().and_then(|manifest| manifest.notes.get("train")) {
        return Ok(("kept", train.clone()));
    }
    let text = |path: &Path| path.to_str().map(str::to_owned).with_context(|| format!("{}: its name is not UTF-8", path.display()));
    let (photos, place) = (text(&photos)?, text(scene)?);
    let call = |command: &str, first: &[&str], own: &str| {
        let all: Vec<&str> = first.iter().copied().chain(own.split_whitespace()).collect();
        again::call(common, common.seed, command, &all)
    };
    // What preprocessing left is found again in the scene's cache; steps of training in its checkpoint.
    let begun = known.is_some() && folder.root.join("checkpoints/train").exists();
    if !begun {
        call("preprocess", &[&photos, "-o", &place], &args.preprocess)?;
        let mut manifest = folder.manifest()?;
        manifest.notes.insert(NOTE.to_owned(), with);
        folder.save_manifest(&manifest)?;
    }
    let first: &[&str] = if begun { &[&place, "--resume"] } else { &[&place] };
    let train = call("train", first, &args.train)?;
    Ok(("made", train))
}
