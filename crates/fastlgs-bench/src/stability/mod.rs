//! `fastlgs-bench stability`: how accuracy changes when the input is disturbed, and on difficult
//! generated scenes.

mod cases;
mod rows;

use crate::command::run_command;
use crate::disturb::{self, Album, PhotoChange};
use crate::plot::{self, HeatMap};
use crate::table::{self, number};
use crate::trial::{self, Trial, text};
use anyhow::{Context, Result, bail};
use cases::{Case, Change, TWINS_APART, cases, kind_bound};
use fastlgs::Run;
use fastlgs::progress::Work;
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_synth::{KINDS, Kind};
use rows::{HEAT, heat, row};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench stability scenes/fox -o out --device cpu")]
pub struct Args {
    /// Preprocessed scenes to disturb, with a labels/ folder beside their photos. Default: a
    /// generated table.
    scenes: Vec<PathBuf>,
    /// Kinds of generated scenes to test undisturbed, separated by commas; `none` for none.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "table,twins,nested,containers,thin,mirror,glass,dark,bare,sparse,long,big"
    )]
    kinds: Vec<String>,
    /// Disturbances to test, by their names in the table, separated by commas. Default: all.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    cases: Vec<String>,
    /// Runs of each random disturbance. The row "seed" has at least five.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// Iterations of each training. Default: 3,000, or 1,000 with --quick.
    #[arg(long)]
    iterations: Option<u32>,
    /// Test one strength of each disturbance on a small table, and the twins: minutes instead of an
    /// hour.
    #[arg(long)]
    quick: bool,
    /// Folder for stability.md, stability.csv, stability.json, and a heat map of each scene as SVG
    /// and PNG.
    #[arg(short, long)]
    output: PathBuf,
}

const COLUMNS: [&str; 15] = [
    "scene",
    "disturbance",
    "strength",
    "runs",
    "measure",
    "change",
    "worst",
    "bound",
    "verdict",
    "oracle_miou",
    "miou",
    "psnr",
    "depth_error",
    "objects",
    "gaussians",
];

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let kinds: Vec<Kind> = args
        .kinds
        .iter()
        .filter(|k| *k != "none")
        .map(|k| {
            Kind::of(k).with_context(|| format!("--kinds: '{k}' is not a kind of generated scene"))
        })
        .collect::<Result<_>>()?;
    let kinds: Vec<Kind> = if args.quick { vec![Kind::Twins] } else { kinds };
    let work = trial::trials_folder(&args.output)?;
    let bench = Suite {
        args,
        run,
        work: &work,
        iterations: args
            .iterations
            .unwrap_or(if args.quick { 1000 } else { 3000 }),
    };
    if let Some(unknown) = args
        .cases
        .iter()
        .find(|name| !cases().iter().any(|c| c.disturbance == **name))
    {
        let known: BTreeSet<&str> = cases().iter().map(|c| c.disturbance).collect();
        bail!(
            "--cases: '{unknown}' is not a disturbance; choose from {}",
            known.into_iter().collect::<Vec<_>>().join(", ")
        );
    }
    let wanted = |case: &Case| {
        args.cases.is_empty() || args.cases.iter().any(|name| name == case.disturbance)
    };
    let cases: Vec<Case> = cases()
        .into_iter()
        .filter(|c| (c.quick || !args.quick) && wanted(c))
        .collect();
    let count = cases.len() * args.scenes.len().max(1) + kinds.len();
    let progress = run.work("trials", count as u64);
    let mut rows = Vec::new();
    let mut scenes = args.scenes.clone();
    if scenes.is_empty() {
        scenes.push(bench.generated(Kind::Table, "table")?);
    }
    for scene in &scenes {
        let name = trial::name(scene);
        let scene_rows = bench.disturb(scene, &name, &cases, &progress)?;
        plot::save(
            &args.output,
            &format!("stability-{name}"),
            &HeatMap {
                title: &format!("Stability: {name}"),
                columns: &HEAT,
                rows: &heat(&scene_rows),
            },
        )?;
        rows.extend(scene_rows);
    }
    for kind in kinds {
        rows.push(bench.kind(kind)?);
        progress.advance()?;
    }
    std::fs::remove_dir_all(&work)?;
    let verdicts = |what: &str| rows.iter().filter(|r| r["verdict"] == what).count();
    let (holds, fails) = (verdicts("holds"), verdicts("fails"));
    let mut value = table::write(&args.output, "stability", &COLUMNS, &rows, "")?;
    (value["holds"], value["fails"]) = (json!(holds), json!(fails));
    Ok(value)
}

/// Settings that all trials share.
struct Suite<'a> {
    args: &'a Args,
    run: &'a Run<'a>,
    work: &'a Path,
    iterations: u32,
}

impl Suite<'_> {
    /// Generates and preprocesses a scene. Returns its folder.
    fn generated(&self, kind: Kind, name: &str) -> Result<PathBuf> {
        let (views, size) = if self.args.quick {
            trial::QUICK
        } else {
            (kind.views(), "480x360")
        };
        trial::generated(self.run, self.work, name, views, size)
    }

    /// Trains and evaluates a generated scene without a disturbance. Returns its row.
    fn kind(&self, kind: Kind) -> Result<Value> {
        let name = KINDS.iter().find(|k| k.1 == kind).map_or("", |k| k.0);
        let scene = self.generated(kind, name)?;
        let trial = Trial::new(&scene, self.work, self.run)?;
        let trained = trial.train(
            &["--iterations", &self.iterations.to_string()],
            self.run.seed,
        )?;
        let scored = trial.eval(&[
            "--depth",
            text(&scene.with_file_name("photos").join("depth")),
        ])?;
        let (measure, bound) = if kind == Kind::Twins {
            ("apart", TWINS_APART)
        } else {
            ("oracle_miou", kind_bound(kind))
        };
        let reached = number(&scored, measure);
        Ok(json!({
            "scene": name, "disturbance": "none", "strength": "", "runs": 1, "measure": measure, "change": reached, "worst": reached, "bound": bound,
            "verdict": if reached >= bound { "holds" } else { "fails" },
            "oracle_miou": scored["oracle_miou"], "miou": scored["miou"], "psnr": scored["psnr"], "depth_error": scored["depth"]["median_error"], "apart": scored["apart"],
            "objects": scored["objects"], "gaussians": scored["gaussians"], "seconds": number(&trained, "seconds") + number(&trained, "mapping_seconds"),
            "size": scored["size"], "adapter": scored["adapter"],
        }))
    }

    /// Runs all stages, from changed photos to the evaluation. Returns the report of `eval`, with
    /// the seconds of all stages.
    fn run_all_stages(
        &self,
        album: &Album,
        scene_manifest: &Manifest,
        change: PhotoChange,
        seed: u64,
        photos: &Path,
        scene: &Path,
    ) -> Result<Value> {
        album.write(photos, change, seed)?;
        let (labels, iterations) = (photos.join("labels"), self.iterations.to_string());
        let mut args = vec![
            text(photos),
            "-o",
            text(scene),
            "--holdout-labels",
            text(&labels),
        ];
        args.extend([
            "--segmenter",
            &scene_manifest.segmenter,
            "--encoder",
            &scene_manifest.encoder,
        ]);
        scene_manifest
            .models
            .iter()
            .for_each(|(role, file)| args.extend([option_of(role), text(&file.path)]));
        let before = run_command(self.run, seed, "preprocess", &args)?;
        let trained = run_command(
            self.run,
            seed,
            "train",
            &[text(scene), "--iterations", &iterations],
        )?;
        let mut scored = run_command(
            self.run,
            seed,
            "eval",
            &[text(scene), "--labels", text(&labels)],
        )?;
        scored["seconds"] = json!(
            number(&before, "seconds_total")
                + number(&trained, "seconds")
                + number(&trained, "mapping_seconds")
        );
        Ok(scored)
    }

    /// Runs all cases on a scene and returns their rows.
    fn disturb(
        &self,
        scene: &Path,
        name: &str,
        cases: &[Case],
        progress: &Work,
    ) -> Result<Vec<Value>> {
        let folder = SceneFolder::open(scene)?;
        let manifest = folder.manifest()?;
        if manifest.encoder == "import" {
            bail!(
                "{}: this scene has imported embeddings, which do not exist for disturbed photos; preprocess it with another encoder",
                scene.display()
            );
        }
        let album = Album::of(&folder, &Path::new(&manifest.photos).join("labels"))?;
        let seed = self.run.seed;
        // The reference runs through the same stages as the disturbed photos.
        let [base, photos] = ["base", "undisturbed"].map(|n| self.work.join(name).join(n));
        let undisturbed = self.run_all_stages(
            &album,
            &manifest,
            PhotoChange::Unchanged,
            seed,
            &photos,
            &base,
        )?;
        const REMAP: [&str; 4] = ["--init", "SCENE/scene.ply", "--iterations", "0"];
        let paper = Trial::new(&base, self.work, self.run)?;
        let [_, paper_scored] =
            paper.train_and_eval(&[&REMAP[..], &["--mapping", "paper"]].concat())?;
        // tau_ac applies only to trained codes. Lifted codes are classified by id weights.
        let codes = Trial::new(&base, self.work, self.run)?;
        let mut codes_scored = Value::Null;
        if cases
            .iter()
            .any(|case| matches!(case.change, Change::Eval(_)))
        {
            let way = [
                "--mapping",
                "paper",
                "--feature-mode",
                "train",
                "--iterations",
                &self.iterations.to_string(),
            ];
            codes_scored = codes.train_and_eval(&way)?[1].clone();
        }
        let mut rows = Vec::new();
        for case in cases {
            let mut reference = &undisturbed;
            let mut runs = Vec::new();
            let count = if matches!(case.change, Change::Seed) {
                self.args.seeds.max(5)
            } else {
                self.args.seeds
            };
            for run in 0..count {
                let seed = seed + 1 + run;
                let same_gaussians = || Trial::new(&base, self.work, self.run);
                let scored = match &case.change {
                    Change::Photos(change) => {
                        // Starts from a copy of the base scene, so that unchanged results come from
                        // its cache.
                        let (trial, photos) = (same_gaussians()?, tempfile::tempdir_in(self.work)?);
                        self.run_all_stages(
                            &album,
                            &manifest,
                            *change,
                            seed,
                            photos.path(),
                            &trial.scene().root,
                        )?
                    }
                    Change::Seed => {
                        let trial = same_gaussians()?;
                        trial.train(&["--iterations", &self.iterations.to_string()], seed)?;
                        trial.eval(&[])?
                    }
                    Change::Masks(change) => {
                        let trial = same_gaussians()?;
                        disturb::masks(&trial.scene(), *change, seed)?;
                        trial.train_and_eval(&REMAP)?[1].clone()
                    }
                    Change::Embeddings(noise) => {
                        let trial = same_gaussians()?;
                        disturb::embeddings(&trial.scene(), *noise, seed)?;
                        trial.eval(&[])?
                    }
                    Change::Map(args) => {
                        if args.contains(&"paper") {
                            reference = &paper_scored;
                        }
                        same_gaussians()?.train_and_eval(&[&REMAP[..], args].concat())?[1].clone()
                    }
                    Change::Eval(args) => {
                        reference = &codes_scored;
                        codes.eval(args)?
                    }
                };
                runs.push(scored);
                // Options are not random: one run is enough.
                if matches!(case.change, Change::Map(_) | Change::Eval(_)) {
                    break;
                }
            }
            let row = row(name, case, reference, &runs);
            tracing::info!(%row, "trial");
            rows.push(row);
            progress.advance()?;
        }
        Ok(rows)
    }
}

/// Returns the option of `preprocess` for a model role of the manifest.
fn option_of(role: &str) -> &'static str {
    match role {
        "clip_image" => "--clip-image",
        "clip_text" => "--clip-text",
        "sam_encoder" => "--sam-encoder",
        _ => "--sam-decoder",
    }
}
