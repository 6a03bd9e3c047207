//! `fastlgs bench teach`: whether what is taught by a click in one view is found by its name in other views and in other scenes.
//!
//! The click is the pixel of a label that lies deepest in it, and the name is asked for wherever that label is. What is found is compared with the
//! best object there is. The user's own names stay as they are.

use crate::labelled::Labelled;
use crate::table;
use anyhow::Result;
use fastlgs::calibrations::Calibrations;
use fastlgs::eval::best_object;
use fastlgs::session::ask::{Ask, Meaning};
use fastlgs::{Run, Session};
use fastlgs_core::labels::{Label, LabelledView};
use fastlgs_core::{Camera, labels, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::QueryConfig;
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
const COLUMNS: [&str; 7] = ["label", "taught_in", "view", "asked_in", "object", "iou", "share_of_best"];

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
            for Taught { name, mask, .. } in &lesson.labels {
                let object = school.clicked(lesson, mask, &config)?;
                for asked in &schools {
                    rows.extend(asked.exam(school, &lesson.camera.name, name, object, &config)?);
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

    /// The object that a click into the middle of a mask means; nothing where there is none that was embedded.
    fn clicked(&self, view: &Seen, mask: &[bool], config: &QueryConfig) -> Result<Option<u16>> {
        let [x, y] = deepest(mask, view.camera.width);
        let found = Ask::Point(x, y).meaning(&self.scene, &[])?.find(&self.grid, &view.field, &view.camera, config)?;
        Ok(found.targets.first().map(|hit| hit.id))
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
                        let found = Meaning::Embedded(Box::new(query), None).find(&self.grid, &view.field, &view.camera, config)?;
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

/// The pixel of a mask that is farthest from what is not in it, the photo's border included (city-block distance).
fn deepest(mask: &[bool], width: u32) -> [u32; 2] {
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
    let place = (0..mask.len()).rev().max_by_key(|p| depth[*p]).unwrap_or(0);
    [(place % w) as u32, (place / w) as u32]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_click_goes_to_the_middle() {
        // A diamond of radius 2 in six columns.
        let at = |x: i32, y: i32| (x - 3).abs() + (y - 2).abs() <= 2;
        let diamond: Vec<bool> = (0..30).map(|p| at(p % 6, p / 6)).collect();
        assert_eq!(deepest(&diamond, 6), [3, 2]);
        // The border of the photo is one, too.
        assert_eq!(deepest(&[true; 25], 5), [2, 2]);
    }
}
