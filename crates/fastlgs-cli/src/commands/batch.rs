//! `fastlgs batch`: several folders of photos to trained scenes, in one call.

use crate::outcome::Outcome;
use crate::ui::say;
use crate::{report, ui};
use anyhow::{Context, Result, anyhow, bail};
use clap::Parser;
use fastlgs::make::{self, State};
use fastlgs::{Run, preprocess, train};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ffi::OsString;
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

pub fn run(args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    let mut names: BTreeMap<String, &Path> = BTreeMap::new();
    for photos in &args.photos {
        let own = photos.canonicalize().with_context(|| format!("{}: this folder of photos cannot be opened", photos.display()))?;
        let name = own.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = names.insert(name.clone(), photos) {
            bail!("{} and {} would both become the scene '{name}'; call one of them otherwise", other.display(), photos.display());
        }
    }
    let work = run.work("scenes", names.len() as u64);
    let mut rows = Vec::new();
    for (name, photos) in &names {
        work.note(name);
        let scene = args.output.join(name);
        let mut row = json!({ "photos": photos, "scene": scene });
        match make(args, photos, &scene, run) {
            Ok((state, train)) => {
                row["state"] = json!(state);
                row["objects"] = json!(train.objects);
                row["gaussians"] = json!(train.gaussians);
                row["psnr_held_out"] = json!(train.psnr_held_out);
                row["seconds"] = json!(train.seconds);
            }
            Err(error) => {
                row["state"] = json!("failed");
                row["error"] = json!(fastlgs::one_sentence(error.as_ref()));
            }
        }
        if common.json.is_none() && !common.quiet {
            say!("{}", line(&row));
        }
        rows.push(row);
        work.advance()?;
    }
    drop(work);
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

/// Options of one step, as they are typed for the whole batch.
#[derive(Parser)]
#[command(no_binary_name = true)]
struct Options<C: clap::Args> {
    #[command(flatten)]
    config: C,
    #[command(flatten)]
    common: ui::Common,
}

impl<C: clap::Args> Options<C> {
    /// Parses `first`, which the batch gives, and the user's own options.
    fn parse(command: &str, first: &[&Path], own: &str, run: &Run) -> Result<Self> {
        let (seed, device) = (run.seed.to_string(), run.device);
        let shared = ["--seed", &seed, "--device", device].map(OsString::from);
        let words = shared.into_iter().chain(first.iter().map(|p| p.into())).chain(own.split_whitespace().map(OsString::from));
        Self::try_parse_from(words).map_err(|error| {
            let said = error.to_string();
            let line = said.lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned();
            anyhow!("--{command} \"{own}\": {line}")
        })
    }

    fn run<'a>(&'a self, run: &Run<'a>) -> Run<'a> {
        Run { device: &self.common.device, seed: self.common.seed, progress: run.progress }
    }
}

/// Makes a scene unless it is there; whether it was made or kept, and the report of its training.
fn make(args: &Args, photos: &Path, scene: &Path, run: &Run) -> Result<(State, train::Report)> {
    let photos = photos.canonicalize()?;
    let training: Options<train::Config> = Options::parse("train", &[scene], &args.train, run)?;
    let options: Options<preprocess::Config> = Options::parse("preprocess", &[&photos, Path::new("-o"), scene], &args.preprocess, run)?;
    Ok(make::scene(&options.config, &training.config, [&options.run(run), &training.run(run)])?)
}
