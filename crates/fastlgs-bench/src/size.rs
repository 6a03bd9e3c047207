//! `fastlgs-bench size`: accuracy and PSNR against model size, and a check of `--budget auto`.

use crate::command::run_command;
use crate::plot::{self, Axes, Point, Scatter};
use crate::table::{self, number};
use crate::trial::{self, Trial, text};
use anyhow::Result;
use fastlgs::Run;
use fastlgs_core::{Gaussians, SceneFolder, ply};
use fastlgs_raster::density::State;
use fastlgs_raster::{CpuEngine, Engine};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench size scenes/fox scenes/bonsai -o out --device cpu")]
pub struct Args {
    /// Preprocessed scenes with a labels/ folder beside their photos. Default: a generated table.
    scenes: Vec<PathBuf>,
    /// Preset of both training runs (automatic and unlimited budget).
    #[arg(long, default_value = "quick")]
    preset: String,
    /// Iterations of both training runs. Default: those of the preset.
    #[arg(long)]
    iterations: Option<u32>,
    /// Test fewer sizes with a short training.
    #[arg(long)]
    quick: bool,
    /// Folder for size.md, size.csv, size.json, and two charts as SVG and PNG.
    #[arg(short, long)]
    output: PathBuf,
}

/// Fractions of the Gaussians to keep. Those that change the photos most are kept.
const KEPT: [f64; 7] = [0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05];

/// Accepted loss of `--budget auto` against the full model: dB of PSNR, and points of oracle mIoU.
const LOSS: (f64, f64) = (0.1, 0.5);

/// A budget that no training here reaches.
const UNLIMITED: &str = "1000000";

const COLUMNS: [&str; 8] = [
    "scene",
    "model",
    "gaussians",
    "scene_bytes",
    "psnr",
    "oracle_miou",
    "miou",
    "seconds",
];

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let work = trial::trials_folder(&args.output)?;
    let mut scenes = args.scenes.clone();
    if scenes.is_empty() {
        let (views, size) = trial::QUICK;
        scenes.push(trial::generated(run, &work, "table", views, size)?);
    }
    let mut training = vec!["--preset".to_owned(), args.preset.clone()];
    if let Some(iterations) = args.iterations.or(args.quick.then_some(1000)) {
        training.extend(["--iterations".to_owned(), iterations.to_string()]);
    }
    let training: Vec<&str> = training.iter().map(String::as_str).collect();
    let kept: Vec<f64> = KEPT
        .into_iter()
        .enumerate()
        .filter(|(k, _)| !args.quick || k % 3 == 1)
        .map(|(_, share)| share)
        .collect();
    let progress = run.work("models", (scenes.len() * (kept.len() + 6)) as u64);
    let (mut rows, mut verdicts) = (Vec::new(), Vec::new());
    for scene in &scenes {
        let name = trial::name(scene);
        let trial = Trial::new(scene, &work, run)?;
        let mut add = |model: String, scored: &Value, seconds: f64| -> Result<()> {
            rows.push(json!({
                "scene": name, "model": model, "gaussians": scored["gaussians"], "scene_bytes": scored["scene_bytes"], "psnr": scored["psnr"],
                "oracle_miou": scored["oracle_miou"], "miou": scored["miou"], "seconds": seconds,
                "size": scored["size"], "adapter": scored["adapter"],
            }));
            Ok(progress.advance()?)
        };
        let made = |args: &[&str]| -> Result<(Value, f64)> {
            let [trained, scored] = trial.train_and_eval(&[&training, args].concat())?;
            Ok((
                scored,
                number(&trained, "seconds") + number(&trained, "mapping_seconds"),
            ))
        };
        let (auto, seconds) = made(&[])?;
        add("auto".to_owned(), &auto, seconds)?;
        add(
            "auto, compact".to_owned(),
            &compact(run, &work, &trial)?,
            0.0,
        )?;
        let (full, seconds) = made(&["--budget", UNLIMITED])?;
        add("full".to_owned(), &full, seconds)?;
        add(
            "full, compact".to_owned(),
            &compact(run, &work, &trial)?,
            0.0,
        )?;
        let folder = trial.scene();
        let full_model = folder.gaussians()?;
        for degree in (0..full_model.sh_degree).rev() {
            ply::write(
                &folder.ply_path(),
                &full_model.clone().with_sh_degree(degree),
            )?;
            add(format!("degree {degree}"), &trial.eval(&[])?, 0.0)?;
        }
        let order = importance_order(&folder, &full_model)?;
        for share in &kept {
            let most = (share * full_model.len() as f64).round() as usize;
            let mut keep = order[..most].to_vec();
            keep.sort_unstable();
            ply::write(&folder.ply_path(), &full_model.select(&keep))?;
            add(
                format!("{:.0} % kept", 100.0 * share),
                &trial.eval(&[])?,
                0.0,
            )?;
        }
        let lost = [
            number(&full, "psnr") - number(&auto, "psnr"),
            100.0 * (number(&full, "oracle_miou") - number(&auto, "oracle_miou")),
        ];
        let ratio = |what: &str| number(&auto, what) / number(&full, what);
        verdicts.push(json!({
            "scene": name, "lost_db": lost[0], "lost_points": lost[1], "bound": LOSS, "gaussians": ratio("gaussians"), "bytes": ratio("scene_bytes"),
            "verdict": if lost[0] <= LOSS.0 && lost[1] <= LOSS.1 { "holds" } else { "fails" },
        }));
    }
    std::fs::remove_dir_all(&work)?;
    for (what, label, title) in [
        (
            "psnr",
            "PSNR of held-out views, dB",
            "PSNR against size: filled points are --budget auto",
        ),
        (
            "oracle_miou",
            "oracle mIoU of held-out labels",
            "Accuracy against size: filled points are --budget auto",
        ),
    ] {
        let spots: Vec<Point> = rows.iter().map(|row| spot(row, what)).collect();
        let axes = Axes {
            title,
            x: "megabytes of all files that a query needs",
            y: label,
        };
        plot::save(
            &args.output,
            &format!("size-{}", what.replace('_', "-")),
            &Scatter {
                axes,
                spots: &spots,
            },
        )?;
    }
    let mut value = table::write(&args.output, "size", &COLUMNS, &rows, "")?;
    value["auto"] = json!(verdicts);
    fastlgs_core::fs::write_json(&args.output.join("size.json"), &value)?;
    Ok(value)
}

/// Returns the indices of all Gaussians, sorted in descending order by the change of the training
/// views without them.
fn importance_order(folder: &SceneFolder, scene: &Gaussians) -> Result<Vec<usize>> {
    let manifest = folder.manifest()?;
    let trained = fastlgs::SceneNotes::read(&manifest, &folder.root)?
        .train
        .unwrap_or_default();
    let mut engine = CpuEngine::new();
    engine.set_state(&State::of(scene))?;
    let mut scores = vec![0.0; scene.len()];
    for camera in manifest.training(&folder.cameras()?) {
        engine.saliency(trained.view(&camera, scene), None, &mut scores)?;
    }
    let mut order: Vec<usize> = (0..scene.len()).collect();
    order.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b)));
    Ok(order)
}

/// Exports the trial's scene as a compact scene folder and evaluates that.
fn compact(run: &Run, work: &Path, trial: &Trial) -> Result<Value> {
    let folder = tempfile::tempdir_in(work)?;
    let (scene, small) = (trial.scene(), folder.path().join("small"));
    run_command(run, run.seed, "export", &[text(&scene.root), text(&small)])?;
    // The export has no photos. PSNR needs the held-out ones.
    for camera in scene.manifest()?.held_out(&scene.cameras()?) {
        let photo = SceneFolder::new(&small).photo_path(&camera.name);
        std::fs::create_dir_all(photo.parent().unwrap_or(&small))?;
        std::fs::copy(scene.photo_path(&camera.name), photo)?;
    }
    trial.eval_of(&small)
}

fn spot(row: &Value, what: &str) -> Point {
    let model = row["model"].as_str().unwrap_or_default().to_owned();
    let front = model.starts_with("auto");
    Point {
        series: row["scene"].as_str().unwrap_or_default().to_owned(),
        name: model,
        x: number(row, "scene_bytes") / 1e6,
        y: number(row, what),
        front,
    }
}
