//! `fastlgs eval`: accuracy on held-out views. The rules are in `docs/evaluation.md`.

use crate::scene::Scene;
use crate::{Outcome, report, ui};
use anyhow::{Context, Result, bail};
use fastlgs_core::labels::{Label, LabelledView};
use fastlgs_core::{Camera, image_io, labels, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{self, Field, Hit, QueryConfig};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs eval scenes/fox --labels photos/fox/labels --json -")]
pub struct Args {
    /// Trained scene folder.
    scene: PathBuf,
    /// Folder of labels in the layout of LERF-OVS, 3D-OVS or SPIn-NeRF; without it only colour is measured.
    #[arg(long)]
    labels: Option<PathBuf>,
    /// What names the thing in SPIn-NeRF's masks, instead of their folder's name.
    #[arg(long, value_name = "TEXT")]
    label_text: Option<String>,
    /// Decide pixels as in the paper: by the distance of the rendered code to the object's, on the 0..255 scale.
    #[arg(long, value_name = "DISTANCE")]
    tau_ac: Option<f32>,
    /// Relevancy from which an object counts as found, instead of the program's constant.
    #[arg(long, value_name = "SCORE")]
    min_score: Option<f32>,
    /// Texts that must not be found, one a line; a list of everyday things is built in.
    #[arg(long, value_name = "FILE")]
    absent: Option<PathBuf>,
}

/// Things that are in neither of the project's scenes; those that a label names are left out.
const ABSENT: [&str; 40] = [
    "elephant",
    "airplane",
    "pizza",
    "submarine",
    "toothbrush",
    "volcano",
    "guitar",
    "penguin",
    "traffic light",
    "banana",
    "helicopter",
    "snowman",
    "tractor",
    "sushi",
    "lighthouse",
    "giraffe",
    "microwave oven",
    "jellyfish",
    "castle",
    "sailboat",
    "hamburger",
    "parachute",
    "cactus",
    "ice cream",
    "fire engine",
    "octopus",
    "washing machine",
    "canoe",
    "trombone",
    "strawberry",
    "tank",
    "rocket",
    "goldfish",
    "bulldozer",
    "sunglasses",
    "stethoscope",
    "ambulance",
    "zebra",
    "broccoli",
    "umbrella",
];

/// Each of these goes before each absent thing as well: a colour that is there makes nothing else be there.
const COLORS: [&str; 8] = ["red", "blue", "green", "purple", "white", "black", "brown", "wooden"];

#[derive(Default)]
struct Sums {
    iou: Vec<f64>,
    oracle: Vec<f64>,
    apart: Vec<f64>,
    recall: Vec<f64>,
    boundary: Vec<f64>,
    localised: Vec<f64>,
    top1: Vec<f64>,
    present: Vec<f64>,
    labels: Vec<String>,
    by_label: BTreeMap<String, Vec<f64>>,
    first_ms: Vec<f64>,
    next_ms: Vec<f64>,
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let mut scene = Scene::open(&args.scene, &common.device)?;
    let grid = scene.grid()?;
    let (psnr, ssim) = color_quality(&mut scene)?;
    let label_text = args.label_text.as_deref();
    let views = args.labels.as_deref().map(|folder| labels::load(folder, label_text)).transpose()?.unwrap_or_default();
    let config = QueryConfig { min_score: args.min_score.unwrap_or(scene.min_score()), ..QueryConfig::default() };
    let total: usize = views.iter().map(|v| v.labels.len()).sum();
    let mut sums = Sums::default();
    for view in &views {
        let index = scene.folder.view_index(&scene.cameras, &view.name).context("labels")?;
        let camera = scene.cameras[index].clone();
        if !scene.manifest.is_held_out(index, &camera.name) {
            bail!("'{}' is labelled but was trained on; preprocess with --holdout or --holdout-labels so that it is held out", camera.name);
        }
        scene.field(&camera, args.tau_ac)?; // compiles the kernels
        let started = Instant::now();
        let field = scene.field(&camera, args.tau_ac)?;
        let render_ms = started.elapsed().as_secs_f64() * 1e3;
        let mut best = Vec::new();
        for (k, label) in view.labels.iter().enumerate() {
            let (ms, masks) = score_label(&scene, &grid, &config, view, label, &camera, &field, &mut sums)?;
            if k == 0 {
                sums.first_ms.push(render_ms + ms)
            } else {
                sums.next_ms.push(ms)
            }
            best.push(masks);
        }
        sums.apart.extend(apart(&best));
    }
    let absent = absent_scores(args, &scene, &grid, &views)?;
    let rejected = |absent: &[(String, f64)]| absent.iter().filter(|a| a.1 < f64::from(config.min_score)).count();
    let colored = colored_absent_scores(&absent, &scene, &grid)?;
    let loudest = absent.iter().max_by(|a, b| a.1.total_cmp(&b.1));
    let absent_scores: Vec<f64> = absent.iter().map(|a| a.1).collect();
    let present_by_label: BTreeMap<&String, f64> = sums.labels.iter().zip(sums.present.iter().copied()).collect();
    let by_label: BTreeMap<&String, Option<f64>> = sums.by_label.iter().map(|(k, v)| (k, mean(v))).collect();
    let auroc = metrics::auroc(&sums.present, &absent_scores);
    let camera = &scene.cameras[0];
    let value = json!({
        "scene": args.scene,
        "views_scored": views.len(),
        "labels_scored": sums.iou.len(),
        "labels_total": total,
        "miou": mean(&sums.iou),
        "miou_by_label": by_label,
        "macc": mean(&sums.recall),
        "boundary_iou": mean(&sums.boundary),
        "loc_acc": mean(&sums.localised),
        "oracle_miou": mean(&sums.oracle),
        "apart": mean(&sums.apart),
        "text_top1": mean(&sums.top1),
        "absent_auroc": if auroc.is_nan() { Value::Null } else { json!(auroc) },
        "absent_texts": absent.len(),
        "absent_rejected": rejected(&absent),
        "absent_colored_rejected": (!colored.is_empty()).then(|| rejected(&colored) as f64 / colored.len() as f64),
        "absent_best": loudest.map(|(text, score)| json!({ "text": text, "score": score })),
        "present_scores": present_by_label,
        "psnr": psnr,
        "ssim": ssim,
        "gaussians": scene.gaussians.len(),
        "objects": grid.objects.len(),
        "scene_bytes": crate::scene::bytes(&args.scene),
        "query_ms_first": mean(&sums.first_ms),
        "query_ms_next": mean(&sums.next_ms),
        "size": format!("{}x{}", camera.width, camera.height),
        "adapter": scene.engine.name(),
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}

/// Mean PSNR and SSIM over the held-out views.
fn color_quality(scene: &mut Scene) -> Result<(Option<f64>, Option<f64>)> {
    let (mut psnr, mut ssim) = (Vec::new(), Vec::new());
    for camera in scene.manifest.held_out(&scene.cameras) {
        let frame = scene.render(&camera)?;
        let photo = image_io::to_planar(&scene.folder.photo(&camera.name)?);
        psnr.push(metrics::psnr(frame.channels(0, 3), &photo));
        ssim.push(metrics::ssim(frame.channels(0, 3), &photo, camera.width as usize, camera.height as usize));
    }
    Ok((mean(&psnr), mean(&ssim)))
}

/// A label's true pixels, and those of the object that fits it best.
struct Best {
    truth: Vec<bool>,
    found: Vec<bool>,
}

/// For each label, the share of its pixels that no best object of a label elsewhere claims: 1 where things are told apart, even where
/// they are not found. Objects that two labels share tell neither apart.
fn apart(best: &[Best]) -> Vec<f64> {
    let pixels = best.first().map_or(0, |b| b.truth.len());
    let at = |p: usize, mask: fn(&Best) -> &Vec<bool>| (0..best.len()).filter(|&k| mask(&best[k])[p]).collect::<Vec<_>>();
    let there: Vec<[Vec<usize>; 2]> = (0..pixels).into_par_iter().map(|p| [at(p, |b| &b.truth), at(p, |b| &b.found)]).collect();
    let overlapping: BTreeSet<(usize, usize)> =
        there.iter().flat_map(|[truth, _]| truth.iter().flat_map(move |a| truth.iter().map(move |b| (*a, *b)))).collect();
    let mut counts = vec![[0usize; 2]; best.len()];
    for [truth, found] in &there {
        for &own in truth {
            let mixed = found.iter().any(|other| !overlapping.contains(&(own, *other)));
            counts[own][0] += usize::from(mixed);
            counts[own][1] += 1;
        }
    }
    counts.iter().map(|[mixed, all]| 1.0 - *mixed as f64 / (*all).max(1) as f64).collect()
}

/// Scores one label; returns the milliseconds of the query beyond rendering, and the masks.
fn score_label(
    scene: &Scene,
    grid: &Grid,
    config: &QueryConfig,
    view: &LabelledView,
    label: &Label,
    camera: &Camera,
    field: &Field,
    sums: &mut Sums,
) -> Result<(f64, Best)> {
    let (w, h) = (camera.width, camera.height);
    let truth = view.mask(label, w, h);
    if !truth.contains(&true) {
        bail!("the label '{}' of '{}' covers no pixel at {w}x{h}", label.category, view.name);
    }
    // The text encoder is loaded once, before the first query is timed.
    scene.text_query("warm up")?;
    let started = Instant::now();
    let text_query = scene.text_query(&label.category)?;
    let ranked = query::rank(grid, &text_query);
    let targets = query::select(grid, &ranked, config);
    let mask = field.mask(grid, &targets);
    let ms = started.elapsed().as_secs_f64() * 1e3;
    let iou = metrics::iou(&mask, &truth);
    sums.iou.push(iou);
    sums.by_label.entry(label.category.clone()).or_default().push(iou);
    sums.recall.push(metrics::recall(&mask, &truth));
    // 2 % of the diagonal, as Cheng et al. propose.
    let band = (0.02 * f64::from(w).hypot(f64::from(h))).round().max(1.0) as u32;
    sums.boundary.push(metrics::boundary_iou(&mask, &truth, w, h, band));
    let relevancy = field.relevancy(grid, &ranked);
    sums.localised.push(f64::from(u8::from(metrics::localised(&relevancy, w, h, &view.boxes(label, w, h)))));
    sums.labels.push(label.category.clone());
    sums.present.push(best_score(&ranked));
    // Oracle: the best single object. Text top-1: does the first-ranked object mostly lie in the label?
    let object_mask = |id: u16| field.mask(grid, &[Hit { id, score: 0.0 }]);
    let (oracle, found) = best_object(grid, field, &truth);
    sums.oracle.push(oracle);
    let inside = |mask: Vec<bool>| {
        let (hit, all) = mask.iter().zip(&truth).filter(|(m, _)| **m).fold((0, 0), |(h, a), (_, t)| (h + usize::from(*t), a + 1));
        all > 0 && 2 * hit > all
    };
    sums.top1.push(f64::from(u8::from(ranked.first().is_some_and(|r| inside(object_mask(r.id))))));
    Ok((ms, Best { truth, found }))
}

/// IoU and mask of the object that fits a mask best.
pub fn best_object(grid: &Grid, field: &Field, truth: &[bool]) -> (f64, Vec<bool>) {
    let masks = candidates(grid, field, truth).into_iter().map(|id| field.mask(grid, &[Hit { id, score: 0.0 }]));
    let tried = masks.map(|mask| (metrics::iou(&mask, truth), mask));
    tried.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_else(|| (0.0, vec![false; truth.len()]))
}

/// The objects that come nearest to a mask by their owned pixels: one of them is the best.
fn candidates(grid: &Grid, field: &Field, truth: &[bool]) -> Vec<u16> {
    const MOST: usize = 5;
    let owners = field.owners(grid).labels;
    let mut counts = vec![[0usize; 2]; grid.objects.len() + 1];
    for (owner, inside) in owners.iter().zip(truth) {
        for id in grid.chain(*owner) {
            counts[usize::from(id)][usize::from(*inside)] += 1;
        }
    }
    let all = truth.iter().filter(|t| **t).count();
    let iou = |id: &u16| {
        let [outside, inside] = counts[usize::from(*id)];
        inside as f64 / (all + outside) as f64
    };
    let mut ids: Vec<u16> = (1..=grid.objects.len() as u16).collect();
    ids.sort_by(|a, b| iou(b).total_cmp(&iou(a)).then(a.cmp(b)));
    ids.truncate(MOST);
    ids
}

/// Best scores of texts that name nothing in the scene.
fn absent_scores(args: &Args, scene: &Scene, grid: &Grid, views: &[LabelledView]) -> Result<Vec<(String, f64)>> {
    let texts: Vec<String> = match &args.absent {
        Some(path) => std::fs::read_to_string(path).with_context(|| path.display().to_string())?.lines().map(str::to_owned).collect(),
        None => ABSENT.iter().map(|s| (*s).to_owned()).collect(),
    };
    let named = |text: &String| views.iter().flat_map(|v| &v.labels).any(|l| l.category.contains(text.as_str()));
    if views.is_empty() {
        return Ok(Vec::new());
    }
    texts.iter().filter(|t| !t.trim().is_empty() && !named(t)).map(|text| scored(scene, grid, text.clone())).collect()
}

/// The same for these texts with a colour before them.
fn colored_absent_scores(absent: &[(String, f64)], scene: &Scene, grid: &Grid) -> Result<Vec<(String, f64)>> {
    let texts = absent.iter().flat_map(|(text, _)| COLORS.map(|color| format!("{color} {text}")));
    texts.map(|text| scored(scene, grid, text)).collect()
}

/// A text with its best score.
fn scored(scene: &Scene, grid: &Grid, text: String) -> Result<(String, f64)> {
    let score = best_score(&query::rank(grid, &scene.text_query(&text)?));
    Ok((text, score))
}

/// What decides whether a text is found: the best score of any object, which need not be the first-ranked one's.
fn best_score(ranked: &[Hit]) -> f64 {
    ranked.iter().map(|hit| f64::from(hit.score)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn twins_are_apart_where_each_has_its_own_object() {
        let mask = |pixels: &str| pixels.bytes().map(|b| b == b'x').collect::<Vec<_>>();
        let best = |truth: &str, found: &str| Best { truth: mask(truth), found: mask(found) };
        // One pixel of the left twin is claimed by the right one's object; the pair around both claims all and is not compared.
        let both = [best("xx....", "x....."), best("....xx", ".x..xx"), best("xx..xx", "xxxxxx")];
        assert_eq!(apart(&both), [0.5, 1.0, 1.0]);
        // One object for both twins.
        assert_eq!(apart(&[best("xx..", "xxxx"), best("..xx", "xxxx")]), [0.0, 0.0]);
    }
}
