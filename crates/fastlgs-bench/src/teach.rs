//! `fastlgs bench teach`: whether what is taught by a click in one view is found by its name in other views and in other scenes.
//!
//! The first click is the pixel of a label that lies deepest in it, further ones go to what is far from those before, and the name is asked for wherever
//! that label is. What is found is compared with the best object there is. The user's own names stay as they are.

use crate::labelled::Labelled;
use crate::table;
use anyhow::Result;
use fastlgs::calibrations::Calibrations;
use fastlgs::eval::best_object;
use fastlgs::session::Pixels;
use fastlgs::session::ask::{Ask, Meaning};
use fastlgs::{Run, Session, eyes};
use fastlgs_core::labels::{Label, LabelledView};
use fastlgs_core::{Camera, labels, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{Hit, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench teach scenes/fox scenes/office --labels photos/fox/labels,photos/office/labels -o out")]
pub struct Args {
    #[command(flatten)]
    labelled: Labelled,
    /// Share of the names of absent things that may be answered all the same.
    #[arg(long, value_name = "SHARE", default_value_t = QueryConfig::default().false_alarms)]
    false_alarms: f32,
    /// Clicks into each label.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=9))]
    clicks: u8,
    /// Folder for the table (teach.md, teach.csv, teach.json).
    #[arg(short, long)]
    output: Option<PathBuf>,
}

/// A labelled view of an opened scene, rendered.
struct Seen {
    camera: Camera,
    field: Field,
    labels: Vec<Taught>,
}

/// A label of a view: its name, its pixels, and the IoU of the object that fits it best.
struct Taught {
    name: String,
    mask: Vec<bool>,
    best: f64,
}

/// A scene with its labelled views.
struct School {
    name: String,
    scene: Session,
    grid: Grid,
    seen: Vec<Seen>,
}

/// Columns of the table.
const COLUMNS: [&str; 8] = ["label", "taught_in", "view", "clicked", "asked_in", "object", "iou", "share_of_best"];

/// Share of the best object's IoU from which a name counts as known.
const KNOWN: f64 = 0.8;

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let config = QueryConfig { false_alarms: args.false_alarms, ..QueryConfig::default() };
    let mut schools = Vec::new();
    for (root, folder) in args.labelled.pairs()? {
        schools.push(School::open(root, &labels::load(folder, None)?, run)?);
    }
    let work = run.work("teach", schools.len() as u64);
    let mut rows = Vec::new();
    for school in &schools {
        for lesson in &school.seen {
            for Taught { name, mask, best } in &lesson.labels {
                let targets = school.clicked(lesson, mask, args.clicks, &config)?;
                let clicked = metrics::iou(&lesson.field.mask(&school.grid, &targets), mask) / best.max(f64::MIN_POSITIVE);
                for asked in &schools {
                    let mut found = asked.exam(school, &lesson.camera.name, name, targets.first().map(|hit| hit.id), &config)?;
                    found.iter_mut().for_each(|row| row["clicked"] = json!(clicked));
                    rows.extend(found);
                }
            }
        }
        work.advance()?;
    }
    if let Some(folder) = &args.output {
        table::write(folder, "teach", &COLUMNS, &rows, "")?;
    }
    let (own, others): (Vec<&Value>, Vec<&Value>) = rows.iter().partition(|row| row["taught_in"] == row["asked_in"]);
    Ok(json!({ "same_scene": summary(&own), "other_scenes": summary(&others), "rows": rows }))
}

/// How many names of how many are known, and the mean share of the best object's IoU.
fn summary(rows: &[&Value]) -> Value {
    let shares: Vec<f64> = rows.iter().map(|row| table::number(row, "share_of_best")).collect();
    let mean = (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64);
    let iou = (!rows.is_empty()).then(|| rows.iter().map(|row| table::number(row, "iou")).sum::<f64>() / rows.len() as f64);
    json!({ "asked": rows.len(), "known": shares.iter().filter(|share| **share >= KNOWN).count(), "share_of_best": mean, "iou": iou })
}

impl School {
    fn open(root: &Path, views: &[LabelledView], run: &Run) -> Result<Self> {
        let mut scene = Session::open(root, run.device)?;
        scene.forget_taught();
        let grid = scene.grid()?;
        eyes::check_version(&scene.manifest, &grid, &scene.folder)?;
        let mut seen = Vec::new();
        for view in views {
            let camera = scene.cameras[scene.folder.view_index(&scene.cameras, &view.name)?].clone();
            let field = scene.field(&camera, None)?;
            let taught = |label: &Label| {
                let mask = view.mask(label, camera.width, camera.height);
                Taught { name: label.category.clone(), best: best_object(&grid, &field, &mask).0, mask }
            };
            let labels = view.labels.iter().map(taught).collect();
            seen.push(Seen { camera, field, labels });
        }
        Ok(Self { name: crate::trial::name(root), scene, grid, seen })
    }

    /// The object that so many clicks into a mask mean; nothing where there is none that was embedded.
    fn clicked(&self, view: &Seen, mask: &[bool], clicks: u8, config: &QueryConfig) -> Result<Vec<Hit>> {
        let pixels = Pixels::new(clicked(mask, view.camera.width, clicks)).map_err(anyhow::Error::msg)?;
        Ok(Ask::Point(pixels).meaning(&self.scene, &[])?.find(&self.grid, &view.field, &view.camera, config)?.targets)
    }

    /// Asks for a name, wherever it labels something here, that was taught by an object of another scene or of this one.
    fn exam(&self, teacher: &Self, lesson: &str, name: &str, object: Option<u16>, config: &QueryConfig) -> Result<Vec<Value>> {
        let mut rows = Vec::new();
        let shown = object.map(|id| teacher.grid.objects[usize::from(id) - 1].embeddings.clone()).filter(|shown| !shown.is_empty());
        for view in &self.seen {
            for label in view.labels.iter().filter(|label| label.name == name) {
                let iou = match &shown {
                    None => 0.0,
                    Some(shown) => {
                        let query = TextQuery::of_examples(shown.clone(), Calibrations::of(&self.scene.manifest).pictures);
                        let found = Meaning::Embedded(Box::new(query.into())).find(&self.grid, &view.field, &view.camera, config)?;
                        metrics::iou(&view.field.mask(&self.grid, &found.targets), &label.mask)
                    }
                };
                rows.push(json!({
                    "label": name,
                    "taught_in": teacher.name,
                    "view": lesson,
                    "asked_in": self.name,
                    "object": object,
                    "iou": iou,
                    "share_of_best": iou / label.best.max(f64::MIN_POSITIVE),
                }));
            }
        }
        Ok(rows)
    }
}

/// Clicks into a mask: the pixel that is farthest from what is not in it, and then those that are farthest from the clicks before and a third as far as that
/// one from what is not in it.
fn clicked(mask: &[bool], width: u32, clicks: u8) -> Vec<(u32, u32)> {
    let depth = depths(mask, width);
    let at = |p: usize| (p as u32 % width, p as u32 / width);
    let first = (0..mask.len()).rev().max_by_key(|p| depth[*p]).unwrap_or(0);
    let mut pixels = vec![at(first)];
    let inside: Vec<usize> = (0..mask.len()).filter(|p| mask[*p] && 3 * depth[*p] >= depth[first]).collect();
    while pixels.len() < usize::from(clicks) {
        let far = |p: &usize| pixels.iter().map(|(x, y)| at(*p).0.abs_diff(*x) + at(*p).1.abs_diff(*y)).min();
        let Some(next) = inside.iter().copied().max_by_key(far).filter(|p| !pixels.contains(&at(*p))) else { break };
        pixels.push(at(next));
    }
    pixels
}

/// How far each pixel of a mask is from what is not in it, the photo's border included (city-block distance).
fn depths(mask: &[bool], width: u32) -> Vec<u32> {
    let (w, h) = (width as usize, mask.len() / width as usize);
    let mut depth = vec![0u32; mask.len()];
    let at = |depth: &[u32], x: usize, y: usize| if x < w && y < h { depth[y * w + x] } else { 0 };
    for p in 0..mask.len() {
        let (x, y) = (p % w, p / w);
        let before = at(&depth, x.wrapping_sub(1), y).min(at(&depth, x, y.wrapping_sub(1)));
        depth[p] = if mask[p] { before + 1 } else { 0 };
    }
    for p in (0..mask.len()).rev() {
        let (x, y) = (p % w, p / w);
        depth[p] = depth[p].min(at(&depth, x + 1, y).min(at(&depth, x, y + 1)) + 1);
    }
    depth
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_click_goes_to_the_middle() {
        // A diamond of radius 2 in six columns.
        let at = |x: i32, y: i32| (x - 3).abs() + (y - 2).abs() <= 2;
        let diamond: Vec<bool> = (0..30).map(|p| at(p % 6, p / 6)).collect();
        assert_eq!(clicked(&diamond, 6, 1), [(3, 2)]);
        // The border of the photo is one, too.
        assert_eq!(clicked(&[true; 25], 5, 1), [(2, 2)]);
        // Of a row, all of which lies at the border, the first, the last, and the middle.
        assert_eq!(clicked(&[true; 9], 9, 3), [(0, 0), (8, 0), (4, 0)]);
        assert_eq!(clicked(&[true; 4], 2, 9).len(), 4, "each pixel once");
    }
}
