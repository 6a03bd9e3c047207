//! Measures accuracy on held-out views. `docs/guide.md` defines the measures.

mod color;
mod depth;

use crate::absent::{ABSENT, COLORS};
use crate::error::{Context, bail};
use crate::query::object_query::ObjectQuery;
use crate::{Result, Run, Scene};
pub use depth::DepthQuality;
use fastlgs_core::labels::{Label, LabelledView};
use fastlgs_core::{Camera, labels, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{self, Hit, QueryConfig};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Instant;

/// Options of an evaluation.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct EvalConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Folder of labels in the layout of LERF-OVS, 3D-OVS or SPIn-NeRF. Without it, only colour is
    /// measured.
    #[cfg_attr(feature = "clap", arg(long))]
    pub labels: Option<PathBuf>,
    /// Name of the object in SPIn-NeRF masks, instead of the name of their folder.
    #[cfg_attr(feature = "clap", arg(long, value_name = "TEXT"))]
    pub label_text: Option<String>,
    /// Decide pixels as in the paper: largest distance of a rendered code from the code of its
    /// object, on a scale of 0 to 255.
    #[cfg_attr(feature = "clap", arg(long, value_name = "DISTANCE"))]
    pub tau_ac: Option<f32>,
    /// Accepted share of absent names that are answered, 0 to 1.
    #[cfg_attr(feature = "clap", arg(long, value_name = "SHARE", default_value_t = QueryConfig::default().false_alarms))]
    pub false_alarms: f32,
    /// File of absent names, one a line, instead of the built-in list of everyday objects.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub absent: Option<PathBuf>,
    /// CLIP text tower, for scenes with imported embeddings, or if its file has moved.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
    /// Folder of true depth maps of held-out views, named as their photos: grey PNG of 16 bits, or
    /// EXR in world units. 0 means unknown.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FOLDER"))]
    pub depth: Option<PathBuf>,
    /// Depth in world units of one step of the PNG files of --depth. The default suits millimetres
    /// in a scene in metres.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "UNITS", default_value_t = 0.001)
    )]
    pub depth_unit: f32,
}

impl Default for EvalConfig {
    fn default() -> Self {
        let false_alarms = QueryConfig::default().false_alarms;
        Self {
            scene: PathBuf::new(),
            labels: None,
            label_text: None,
            tau_ac: None,
            false_alarms,
            absent: None,
            clip_text: None,
            depth: None,
            depth_unit: 0.001,
        }
    }
}

/// Report of an evaluation. Values are means over all labels of all views, unless stated otherwise.
/// `docs/guide.md` defines them.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct EvalReport {
    /// The scene folder.
    pub scene: PathBuf,
    /// Number of labelled views.
    pub views_scored: usize,
    /// Number of labels that were scored.
    pub labels_scored: usize,
    /// Number of all labels.
    pub labels_total: usize,
    /// mIoU of the answers with the labels.
    pub miou: Option<f64>,
    /// mIoU of the first-ranked object, whether it was found or not. Benchmarks without absent names
    /// (LERF, 3D-OVS) accept it always.
    pub first_miou: Option<f64>,
    /// Recall of the first-ranked object, whether it was found or not.
    pub first_macc: Option<f64>,
    /// Boundary IoU of the first-ranked object, whether it was found or not.
    pub first_boundary_iou: Option<f64>,
    /// mIoU by label.
    pub miou_by_label: BTreeMap<String, Option<f64>>,
    /// Recall: share of the pixels of a label that the answer covers.
    pub macc: Option<f64>,
    /// Boundary IoU of the answers.
    pub boundary_iou: Option<f64>,
    /// Boundary IoU of the best object for each label.
    pub oracle_boundary_iou: Option<f64>,
    /// Localisation accuracy: share of labels whose relevancy peak lies in one of their boxes.
    pub loc_acc: Option<f64>,
    /// Oracle mIoU: IoU of the best object for each label.
    pub oracle_miou: Option<f64>,
    /// Oracle mIoU by label.
    pub oracle_by_label: BTreeMap<String, Option<f64>>,
    /// Share of a label's pixels that are not covered by the best object of another label.
    pub apart: Option<f64>,
    /// Share of labels that contain more than half of the first-ranked object.
    pub text_top1: Option<f64>,
    /// Share of labels whose best object has a rank of at most 1, 3 and 5.
    pub oracle_ranked: [Option<f64>; 3],
    /// By label: rank of its best object, from 1 on; the worst over the views.
    pub oracle_rank_by_label: BTreeMap<String, usize>,
    /// Number of labels by outcome.
    pub outcomes: BTreeMap<Outcome, usize>,
    /// AUROC of the scores of present and absent names.
    pub absent_auroc: Option<f64>,
    /// Number of absent names.
    pub absent_texts: usize,
    /// Number of absent names that were not found.
    pub absent_rejected: usize,
    /// Share of absent names with a colour in front that were not found.
    pub absent_colored_rejected: Option<f64>,
    /// Absent name with the largest score.
    pub absent_best: Option<Absent>,
    /// Largest score by absent name.
    pub absent_scores: BTreeMap<String, f64>,
    /// Largest score by label.
    pub present_scores: BTreeMap<String, f64>,
    /// PSNR of the held-out views in dB.
    pub psnr: Option<f64>,
    /// PSNR in dB after the pose of each held-out view is aligned to the scene.
    pub psnr_aligned: Option<f64>,
    /// PSNR in dB after a gain and an offset of each channel are fitted to each photo as well.
    pub psnr_affine: Option<f64>,
    /// SSIM of the held-out views.
    pub ssim: Option<f64>,
    /// Accuracy of the rendered depth; `None` without true depth.
    pub depth: Option<DepthQuality>,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of objects, parts included.
    pub objects: usize,
    /// Size of all files that queries need, in bytes.
    pub scene_bytes: u64,
    /// Milliseconds of the first query in a view, rendering included.
    pub query_ms_first: Option<f64>,
    /// Milliseconds of each further query in the same view.
    pub query_ms_next: Option<f64>,
    /// Size of the first view, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Name of the device.
    pub adapter: String,
}

/// Outcome of the query for a label.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The answer has an IoU of at least 0.5.
    Right,
    /// No object was found.
    Refused,
    /// The first target is a part of the best object, or contains it.
    WrongLevel,
    /// The first target is another object.
    WrongObject,
    /// The first target is the best object, but the mask of the answer does not fit.
    WrongMask,
}

/// Least IoU of a right answer.
const MIN_RIGHT_IOU: f64 = 0.5;

/// An absent name with its score.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Absent {
    /// The name.
    pub text: String,
    /// Its largest score over all objects.
    pub score: f64,
}

/// Values of all labels and queries, from which the report is computed.
#[derive(Default)]
struct Sums {
    iou: Vec<f64>,
    oracle: BTreeMap<String, Vec<f64>>,
    apart: Vec<f64>,
    recall: Vec<f64>,
    boundary: Vec<f64>,
    first_iou: Vec<f64>,
    first_recall: Vec<f64>,
    first_boundary: Vec<f64>,
    oracle_boundary: Vec<f64>,
    localised: Vec<f64>,
    top1: Vec<f64>,
    present: Vec<f64>,
    labels: Vec<String>,
    by_label: BTreeMap<String, Vec<f64>>,
    first_ms: Vec<f64>,
    next_ms: Vec<f64>,
    ranks: BTreeMap<String, Vec<usize>>,
    outcomes: BTreeMap<Outcome, usize>,
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Measures accuracy on held-out views.
///
/// # Errors
/// A scene that is not trained, labels of a view that is not held out, or a device that fails.
pub fn eval(config: &EvalConfig, run: &Run) -> Result<EvalReport> {
    let mut scene = Scene::open(&config.scene, run.device)?;
    scene.set_clip_text(config.clip_text.clone());
    eval_scene(scene, config)
}

/// Measures accuracy of an opened scene.
///
/// # Errors
/// As [`eval`].
pub fn eval_scene(mut scene: Scene, config: &EvalConfig) -> Result<EvalReport> {
    scene.ignore_taught_names();
    let grid = scene.grid()?;
    let color = color::quality(&mut scene)?;
    let depth_folder = config.depth.as_deref();
    let depth = depth_folder
        .map(|folder| depth::quality(&mut scene, folder, config.depth_unit))
        .transpose()?;
    let label_text = config.label_text.as_deref();
    let views = config
        .labels
        .as_deref()
        .map(|folder| labels::load(folder, label_text))
        .transpose()?
        .unwrap_or_default();
    let query = QueryConfig {
        false_alarms: config.false_alarms,
        ..QueryConfig::default()
    };
    let sums = score_views(&mut scene, &grid, config, &query, &views)?;
    let absent = absent_scores(config, &scene, &grid, &views)?;
    let colored = colored_absent_scores(&absent, &scene, &grid)?;
    let camera = &scene.cameras()[0];
    let report = EvalReport {
        scene: config.scene.clone(),
        views_scored: views.len(),
        labels_total: views.iter().map(|v| v.labels.len()).sum(),
        psnr: color.map(|c| c.psnr),
        psnr_aligned: color.map(|c| c.psnr_aligned),
        psnr_affine: color.map(|c| c.psnr_affine),
        ssim: color.map(|c| c.ssim),
        depth,
        gaussians: scene.gaussians().len(),
        objects: grid.objects.len(),
        scene_bytes: crate::scene::query_file_bytes(&config.scene),
        size: format!("{}x{}", camera.width, camera.height),
        adapter: scene.adapter(),
        ..EvalReport::default()
    };
    let min_score = query.min_score(scene.rule());
    let report = with_absent(report, &absent, &colored, min_score, &sums.present);
    Ok(with_labels(report, sums))
}

/// Scores all labels of the views.
fn score_views(
    scene: &mut Scene,
    grid: &Grid,
    config: &EvalConfig,
    query: &QueryConfig,
    views: &[LabelledView],
) -> Result<Sums> {
    let mut sums = Sums::default();
    for view in views {
        let index = scene
            .folder()
            .view_index(scene.cameras(), &view.name)
            .context("the labels do not fit the scene")?;
        let camera = scene.cameras()[index].clone();
        if !scene.manifest().is_held_out(index, &camera.name) {
            bail!(
                "'{}' has labels but was trained on; preprocess the photos again with holdout or holdout_labels, so that it is held out",
                camera.name
            );
        }
        scene.render_objects(&camera, config.tau_ac)?; // compiles the shaders before the timing
        let started = Instant::now();
        let field = scene.render_objects(&camera, config.tau_ac)?;
        let render_ms = started.elapsed().as_secs_f64() * 1e3;
        // Loads the text encoder before the first query is timed.
        scene.text_query("warm up")?;
        let mut best = Vec::new();
        for (k, label) in view.labels.iter().enumerate() {
            let (ms, masks) =
                score_label(scene, grid, query, view, label, &camera, &field, &mut sums)?;
            if k == 0 {
                sums.first_ms.push(render_ms + ms)
            } else {
                sums.next_ms.push(ms)
            }
            best.push(masks);
        }
        sums.apart.extend(label_separation(&best));
    }
    Ok(sums)
}

/// Adds the results of absent names to a report. Those with at least `min_score` are answered.
/// `present` holds the scores of the labels.
fn with_absent(
    report: EvalReport,
    absent: &[(String, f64)],
    colored: &[(String, f64)],
    min_score: f32,
    present: &[f64],
) -> EvalReport {
    let rejected = |names: &[(String, f64)]| {
        let is_rejected = |name: &&(String, f64)| name.1 < f64::from(min_score);
        names.iter().filter(is_rejected).count()
    };
    let scores: Vec<f64> = absent.iter().map(|a| a.1).collect();
    let auroc = metrics::auroc(present, &scores);
    let best = absent.iter().max_by(|a, b| a.1.total_cmp(&b.1));
    EvalReport {
        absent_auroc: (!auroc.is_nan()).then_some(auroc),
        absent_texts: absent.len(),
        absent_rejected: rejected(absent),
        absent_colored_rejected: (!colored.is_empty())
            .then(|| rejected(colored) as f64 / colored.len() as f64),
        absent_scores: absent.iter().cloned().collect(),
        absent_best: best.map(|(text, score)| Absent {
            text: text.clone(),
            score: *score,
        }),
        ..report
    }
}

/// Adds the means over all labels to a report.
fn with_labels(report: EvalReport, sums: Sums) -> EvalReport {
    let all_oracle: Vec<f64> = sums.oracle.values().flatten().copied().collect();
    let all_ranks: Vec<usize> = sums.ranks.values().flatten().copied().collect();
    let ranked_within = |first: usize| {
        let within = all_ranks
            .iter()
            .map(|rank| f64::from(u8::from(*rank <= first)));
        mean(&within.collect::<Vec<_>>())
    };
    let by_label = |values: &BTreeMap<String, Vec<f64>>| {
        let means = values.iter().map(|(label, v)| (label.clone(), mean(v)));
        means.collect()
    };
    let worst_rank =
        |(label, ranks): (&String, &Vec<usize>)| Some((label.clone(), *ranks.iter().max()?));
    EvalReport {
        labels_scored: sums.iou.len(),
        miou: mean(&sums.iou),
        first_miou: mean(&sums.first_iou),
        first_macc: mean(&sums.first_recall),
        first_boundary_iou: mean(&sums.first_boundary),
        miou_by_label: by_label(&sums.by_label),
        macc: mean(&sums.recall),
        boundary_iou: mean(&sums.boundary),
        oracle_boundary_iou: mean(&sums.oracle_boundary),
        loc_acc: mean(&sums.localised),
        oracle_miou: mean(&all_oracle),
        oracle_by_label: by_label(&sums.oracle),
        apart: mean(&sums.apart),
        text_top1: mean(&sums.top1),
        oracle_ranked: [1, 3, 5].map(ranked_within),
        oracle_rank_by_label: sums.ranks.iter().filter_map(worst_rank).collect(),
        outcomes: sums.outcomes,
        present_scores: sums.labels.into_iter().zip(sums.present).collect(),
        query_ms_first: mean(&sums.first_ms),
        query_ms_next: mean(&sums.next_ms),
        ..report
    }
}

/// Masks of a label and of the object that fits it best.
struct LabelMasks {
    truth: Vec<bool>,
    found: Vec<bool>,
}

/// Returns for each label the share of its pixels that are not covered by the best object of
/// another label. The share is 1 if the objects are separate, even if no text finds them. Labels
/// that overlap are not compared. If two labels have the same best object, it counts against both.
fn label_separation(best: &[LabelMasks]) -> Vec<f64> {
    let pixels = best.first().map_or(0, |b| b.truth.len());
    let at = |p: usize, mask: fn(&LabelMasks) -> &Vec<bool>| {
        (0..best.len())
            .filter(|&k| mask(&best[k])[p])
            .collect::<Vec<_>>()
    };
    let labels_at_pixels: Vec<[Vec<usize>; 2]> = (0..pixels)
        .into_par_iter()
        .map(|p| [at(p, |b| &b.truth), at(p, |b| &b.found)])
        .collect();
    let overlapping: BTreeSet<(usize, usize)> = labels_at_pixels
        .iter()
        .flat_map(|[truth, _]| {
            truth
                .iter()
                .flat_map(move |a| truth.iter().map(move |b| (*a, *b)))
        })
        .collect();
    let mut counts = vec![[0usize; 2]; best.len()];
    for [truth, found] in &labels_at_pixels {
        for &own in truth {
            let is_confused = found
                .iter()
                .any(|other| !overlapping.contains(&(own, *other)));
            counts[own][0] += usize::from(is_confused);
            counts[own][1] += 1;
        }
    }
    counts
        .iter()
        .map(|[mixed, all]| 1.0 - *mixed as f64 / (*all).max(1) as f64)
        .collect()
}

/// Scores one label. Returns the milliseconds of the query without rendering, and the masks.
fn score_label(
    scene: &Scene,
    grid: &Grid,
    config: &QueryConfig,
    view: &LabelledView,
    label: &Label,
    camera: &Camera,
    field: &Field,
    sums: &mut Sums,
) -> Result<(f64, LabelMasks)> {
    let (w, h) = (camera.width, camera.height);
    let truth = view.mask(label, w, h);
    if !truth.contains(&true) {
        bail!(
            "the label '{}' of '{}' covers no pixel at {w}x{h}; correct or remove this label",
            label.category,
            view.name
        );
    }
    let started = Instant::now();
    let query::Found { ranked, targets } = ObjectQuery::Text(label.category.clone())
        .embed(scene, &[])?
        .find(grid, field, camera, config)?;
    let mask = field.mask(grid, &targets);
    let ms = started.elapsed().as_secs_f64() * 1e3;
    let iou = metrics::iou(&mask, &truth);
    // Width of the boundary: 2 % of the diagonal (Cheng et al., Boundary IoU).
    let band = (0.02 * f64::from(w).hypot(f64::from(h))).round().max(1.0) as u32;
    let boxes = view.boxes(label, w, h);
    let peak = metrics::peak_in_box(&field.relevancy(grid, &ranked), w, h, &boxes);
    // Oracle: the best single object. Top-1: whether more than half of the first-ranked object lies
    // in the label.
    let (oracle, found, id) = best_object(grid, field, &truth);
    let rank = ranked.iter().position(|h| h.id == id);
    let first = field.mask(grid, ranked.get(..1).unwrap_or_default());
    let covered = first.iter().zip(&truth).filter(|(m, _)| **m);
    let (hit, all) = covered.fold((0, 0), |(h, a), (_, t)| (h + usize::from(*t), a + 1));
    let is_first = all > 0 && 2 * hit > all;
    let outcome = match targets.first() {
        None => Outcome::Refused,
        _ if iou >= MIN_RIGHT_IOU => Outcome::Right,
        Some(first) if first.id == id => Outcome::WrongMask,
        Some(first) if grid.related(id)[usize::from(first.id) - 1] => Outcome::WrongLevel,
        Some(_) => Outcome::WrongObject,
    };
    let name = || label.category.clone();
    sums.iou.push(iou);
    sums.by_label.entry(name()).or_default().push(iou);
    sums.recall.push(metrics::recall(&mask, &truth));
    sums.boundary
        .push(metrics::boundary_iou(&mask, &truth, w, h, band));
    sums.first_iou.push(metrics::iou(&first, &truth));
    sums.first_recall.push(metrics::recall(&first, &truth));
    sums.first_boundary
        .push(metrics::boundary_iou(&first, &truth, w, h, band));
    sums.localised.push(f64::from(u8::from(peak)));
    sums.labels.push(name());
    sums.present.push(f64::from(query::best_score(&ranked)));
    sums.oracle.entry(name()).or_default().push(oracle);
    sums.oracle_boundary
        .push(metrics::boundary_iou(&found, &truth, w, h, band));
    let rank = rank.unwrap_or(ranked.len()) + 1;
    sums.ranks.entry(name()).or_default().push(rank);
    sums.top1.push(f64::from(u8::from(is_first)));
    *sums.outcomes.entry(outcome).or_default() += 1;
    Ok((ms, LabelMasks { truth, found }))
}

/// Returns IoU, mask and id of the object that fits a mask best; id 0 if there are no objects.
pub fn best_object(grid: &Grid, field: &Field, truth: &[bool]) -> (f64, Vec<bool>, u16) {
    let masks = candidates(grid, field, truth)
        .into_iter()
        .map(|id| (field.mask(grid, &[Hit { id, score: 0.0 }]), id));
    let tried = masks.map(|(mask, id)| (metrics::iou(&mask, truth), mask, id));
    tried
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .unwrap_or_else(|| (0.0, vec![false; truth.len()], 0))
}

/// Returns the five objects with the largest IoU with a mask, counted in one pass over the pixels.
/// [`best_object`] computes the masks of these objects only, because masks of all objects take
/// long.
fn candidates(grid: &Grid, field: &Field, truth: &[bool]) -> Vec<u16> {
    const MAX_CANDIDATES: usize = 5;
    let mut counts = vec![[0usize; 2]; grid.objects.len() + 1];
    let mut inside = truth.iter().map(|inside| usize::from(*inside));
    field.for_each_pixel(grid, |objects| {
        let inside = inside.next().unwrap_or(0);
        objects
            .iter()
            .for_each(|id| counts[usize::from(*id)][inside] += 1);
    });
    let all = truth.iter().filter(|t| **t).count();
    let iou = |id: &u16| {
        let [outside, inside] = counts[usize::from(*id)];
        inside as f64 / (all + outside) as f64
    };
    let mut ids: Vec<u16> = (1..=grid.objects.len() as u16).collect();
    ids.sort_by(|a, b| iou(b).total_cmp(&iou(a)).then(a.cmp(b)));
    ids.truncate(MAX_CANDIDATES);
    ids
}

/// Returns the largest score of each absent name. Names that occur in a label are left out; without
/// labels, the result is empty.
fn absent_scores(
    options: &EvalConfig,
    scene: &Scene,
    grid: &Grid,
    views: &[LabelledView],
) -> Result<Vec<(String, f64)>> {
    let texts: Vec<String> = match &options.absent {
        Some(path) => std::fs::read_to_string(path)
            .with_context(|| path.display().to_string())?
            .lines()
            .map(str::to_owned)
            .collect(),
        None => ABSENT.iter().map(|s| (*s).to_owned()).collect(),
    };
    let named = |text: &str| {
        views
            .iter()
            .flat_map(|v| &v.labels)
            .any(|l| l.category.to_lowercase().contains(&text.to_lowercase()))
    };
    if views.is_empty() {
        return Ok(Vec::new());
    }
    let texts = texts.iter().map(|text| text.trim());
    texts
        .filter(|text| !text.is_empty() && !named(text))
        .map(|text| scored(scene, grid, text.to_owned()))
        .collect()
}

/// Returns the largest score of each absent name with a colour in front.
fn colored_absent_scores(
    absent: &[(String, f64)],
    scene: &Scene,
    grid: &Grid,
) -> Result<Vec<(String, f64)>> {
    let texts = absent
        .iter()
        .flat_map(|(text, _)| COLORS.map(|color| format!("{color} {text}")));
    texts.map(|text| scored(scene, grid, text)).collect()
}

/// Returns a text with its largest score over all objects.
fn scored(scene: &Scene, grid: &Grid, text: String) -> Result<(String, f64)> {
    let score = f64::from(query::best_score(&query::rank(
        grid,
        &scene.text_query(&text)?,
    )));
    Ok((text, score))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_with_separate_objects_are_not_confused() {
        let mask = |pixels: &str| pixels.bytes().map(|b| b == b'x').collect::<Vec<_>>();
        let best = |truth: &str, found: &str| LabelMasks {
            truth: mask(truth),
            found: mask(found),
        };
        // The object of the right twin covers one pixel of the left twin. The label of the pair
        // overlaps both twins, so it is not compared with them.
        let both = [
            best("xx....", "x....."),
            best("....xx", ".x..xx"),
            best("xx..xx", "xxxxxx"),
        ];
        assert_eq!(label_separation(&both), [0.5, 1.0, 1.0]);
        // One object for both twins.
        assert_eq!(
            label_separation(&[best("xx..", "xxxx"), best("..xx", "xxxx")]),
            [0.0, 0.0]
        );
    }
}
