//! The answer to a query in one view, with its report and images.

use super::object_query::{EmbeddedQuery, ObjectQuery};
use super::pictures::{heatmap, mask_picture, overlay};
use super::selection;
use crate::{Result, Scene};
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{Found, Hit, best_score};
use fastlgs_raster::Frame;
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Default number of objects that a report lists as candidates.
pub const CANDIDATES: usize = 8;
/// Largest number of objects that a report lists as nearest.
const MAX_NEAREST: usize = 3;
/// Least score of a nearest object.
const MIN_NEAREST_SCORE: f32 = 0.01;
/// Number of pixels below which an answer counts as hardly visible in a view.
const MIN_VISIBLE_PIXELS: usize = 30;

/// Report of an answer.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct AnswerReport {
    /// Text, picture name or pixels of the query.
    pub text: String,
    /// Name of the view.
    pub view: String,
    /// Size of the view, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Whether an object was found.
    pub found: bool,
    /// Largest score of all objects, found or not: the share of absent names that score lower.
    pub score: f32,
    /// Whether the encoder of the scene is calibrated. Otherwise scores use assumed constants for
    /// this kind of encoder.
    pub calibrated: bool,
    /// Whether the text is a taught name.
    pub taught: bool,
    /// Whether encoder or detector know the name. An unknown name is never found.
    pub known: bool,
    /// Targets: the objects of the answer.
    pub objects: Vec<ObjectReport>,
    /// Objects of the highest ranks, targets or not.
    pub candidates: Vec<Hit>,
    /// Nearest objects, if nothing was found; see [`Self::find_nearest`].
    pub nearest: Vec<NearObject>,
    /// Number of pixels in the mask.
    pub pixels: usize,
    /// View that shows the answer best, if this view hardly shows it; see [`Self::find_best_view`].
    pub seen_best: Option<String>,
    /// File of the mask, if it was written.
    pub mask: Option<PathBuf>,
    /// File of the heat map, if it was written.
    pub heatmap: Option<PathBuf>,
    /// Number of Gaussians in the scene.
    pub gaussians: usize,
    /// Name of the device.
    pub adapter: String,
    /// Duration of each step.
    pub ms: Milliseconds,
}

impl AnswerReport {
    /// Sets `nearest` to the objects of the highest ranks, at most three, if nothing was found. Objects
    /// without any evidence are left out.
    ///
    /// # Errors
    /// The device fails.
    pub fn find_nearest(&mut self, scene: &mut Scene, grid: &Grid, ranked: &[Hit]) -> Result<()> {
        if self.found {
            return Ok(());
        }
        let near = ranked.iter().filter(|hit| hit.score >= MIN_NEAREST_SCORE);
        for &Hit { id, score } in near.take(MAX_NEAREST) {
            let best_view = scene.most_visible_view(grid, &[id])?;
            self.nearest.push(NearObject {
                id,
                score,
                best_view,
            });
        }
        Ok(())
    }

    /// Sets `seen_best` if this view shows fewer than 30 pixels of the answer.
    ///
    /// # Errors
    /// The device fails.
    pub fn find_best_view(&mut self, scene: &mut Scene, grid: &Grid) -> Result<()> {
        // Pixels that dilation adds do not count.
        if self.found
            && self
                .objects
                .iter()
                .map(|object| object.pixels)
                .sum::<usize>()
                < MIN_VISIBLE_PIXELS
        {
            let ids: Vec<u16> = self.objects.iter().map(|o| o.id).collect();
            self.seen_best = scene.most_visible_view(grid, &ids)?;
        }
        Ok(())
    }
}

/// An object that is near to a query, but not near enough to answer it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct NearObject {
    /// Object id.
    pub id: u16,
    /// Score, 0 to 1.
    pub score: f32,
    /// View that shows most of it.
    pub best_view: Option<String>,
}

/// One object of an answer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ObjectReport {
    /// Object id.
    pub id: u16,
    /// Id of the object that it is a part of; 0 for none.
    pub parent: u16,
    /// Support: mean IoU with the best mask of each view, 0 to 1.
    pub support: f32,
    /// Score, 0 to 1.
    pub score: f32,
    /// Box in the view: left, top, right and bottom in pixels, the last two exclusive. `None` if
    /// the view does not show the object.
    pub bbox2d: Option<[u32; 4]>,
    /// Box in world coordinates: minimum and maximum corner, without outliers.
    pub bbox3d: Option<[[f64; 3]; 2]>,
    /// Number of its pixels in the view.
    pub pixels: usize,
    /// Number of its Gaussians.
    pub gaussians: usize,
}

/// Duration of the steps of an answer, in milliseconds.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Milliseconds {
    /// Embedding the query.
    pub encode: f64,
    /// Rendering the view.
    pub render: f64,
    /// Selecting the targets.
    pub select: f64,
    /// Computing the mask.
    pub restore: f64,
    /// Sum of the steps above.
    pub total: f64,
    /// Collecting the Gaussians of the answer, for boxes and exports. It is not part of the total.
    pub gaussians: f64,
}

/// Largest number of characters of a query in a file name.
const NAME_LENGTH: usize = 60;

/// Converts a text to a part of a file name. If characters other than spaces are lost, a hash of
/// the text is appended.
fn file_name(text: &str) -> String {
    let safe: String = text
        .chars()
        .map(|c| if c.is_alphanumeric() { c } else { '_' })
        .take(NAME_LENGTH)
        .collect();
    let is_unchanged = text.chars().count() <= NAME_LENGTH
        && text.chars().all(|c| c.is_alphanumeric() || c == ' ');
    if is_unchanged {
        safe
    } else {
        format!(
            "{safe}_{}",
            text.bytes()
                .fold(5381u32, |hash, byte| hash.wrapping_mul(33)
                    ^ u32::from(byte))
        )
    }
}

/// The answer to a query in one view.
pub struct Answer {
    /// The object table.
    pub grid: Arc<Grid>,
    /// Rendered object data of the view.
    pub field: Arc<Field>,
    /// Camera of the view.
    pub camera: Camera,
    /// Ranked objects and targets.
    pub found: Found,
    /// Mask of the answer, row by row.
    pub mask: Vec<bool>,
    /// Report of the answer.
    pub report: AnswerReport,
}

impl Answer {
    /// Returns the ids of the objects of the answer.
    pub fn target_ids(&self) -> Vec<u16> {
        self.found.targets.iter().map(|target| target.id).collect()
    }

    /// Returns the relevancy of each pixel for a heat map, 0 to 1, row by row.
    pub fn relevancy(&self) -> Vec<f32> {
        self.field.relevancy(&self.grid, &self.found.heat())
    }

    pub(super) fn describe(
        &self,
        scene: &Scene,
        query: &ObjectQuery,
        embedded: &EmbeddedQuery,
        candidates: usize,
        mut ms: Milliseconds,
    ) -> AnswerReport {
        let Found { ranked, targets } = &self.found;
        let text = query.name();
        let started = Instant::now();
        let owned: Vec<Vec<usize>> = targets
            .iter()
            .map(|t| selection::gaussians(scene.gaussians(), &self.grid, &[t.id]))
            .collect();
        ms.gaussians = started.elapsed().as_secs_f64() * 1e3;
        AnswerReport {
            view: self.camera.name.clone(),
            size: format!("{}x{}", self.camera.width, self.camera.height),
            found: !targets.is_empty(),
            score: best_score(ranked),
            calibrated: embedded.is_calibrated(),
            known: embedded.is_known(&self.grid),
            taught: matches!(query, ObjectQuery::Text(_)) && scene.is_taught(&text),
            text,
            objects: targets
                .iter()
                .zip(&owned)
                .map(|(t, own)| self.object(scene, t, own))
                .collect(),
            candidates: ranked[..ranked.len().min(candidates)].to_vec(),
            pixels: self.mask.iter().filter(|m| **m).count(),
            nearest: Vec::new(),
            seen_best: None,
            mask: None,
            heatmap: None,
            gaussians: scene.gaussians().len(),
            adapter: scene.adapter(),
            ms,
        }
    }

    /// Measures one object: its boxes in this view and in the world, its pixels and its Gaussians.
    fn object(&self, scene: &Scene, hit: &Hit, own: &[usize]) -> ObjectReport {
        let width = self.camera.width;
        let mut bounds: Option<[u32; 4]> = None;
        let mask = self.field.mask(&self.grid, &[*hit]);
        for p in (0..mask.len() as u32).filter(|p| mask[*p as usize]) {
            let (x, y) = (p % width, p / width);
            let b = bounds.get_or_insert([x, y, x + 1, y + 1]);
            *b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
        }
        let object = &self.grid.objects[usize::from(hit.id) - 1];
        ObjectReport {
            id: hit.id,
            parent: object.parent,
            support: object.support,
            score: hit.score,
            bbox2d: bounds,
            bbox3d: selection::robust_box(scene.gaussians(), &scene.manifest().frame, own),
            pixels: mask.iter().filter(|m| **m).count(),
            gaussians: own.len(),
        }
    }

    /// Writes the mask, the overlay and, with `heat`, the heat map to `folder`. Records mask and
    /// heat map in the report, and returns the overlay.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&mut self, folder: &Path, frame: &Frame, heat: bool) -> Result<RgbImage> {
        let report = &mut self.report;
        let (w, h) = (frame.width, frame.height);
        let safe = file_name(&report.text);
        let view = report.view.clone();
        let path = |what: &str| folder.join(format!("{view}.{safe}.{what}.png"));
        let color = image_io::from_planar(frame.color(), w, h);
        let overlay_image = overlay(&color, &self.mask);
        if self.found.targets.is_empty() {
            // Without targets, mask and overlay of an earlier run would be wrong.
            for what in ["mask", "overlay"] {
                let _ = std::fs::remove_file(path(what));
            }
        } else {
            image_io::save_png(&path("mask"), mask_picture(&self.mask, w, h))?;
            image_io::save_png(&path("overlay"), overlay_image.clone())?;
            report.mask = Some(path("mask"));
        }
        if heat {
            let relevancy = self.field.relevancy(&self.grid, &self.found.heat());
            image_io::save_png(&path("heatmap"), heatmap(&color, &relevancy))?;
            report.heatmap = Some(path("heatmap"));
        }
        Ok(overlay_image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_queries_have_different_file_names() {
        assert_eq!(
            [
                file_name("fox"),
                file_name("red cup"),
                file_name("Füchse 2")
            ],
            ["fox", "red_cup", "Füchse_2"]
        );
        let long = [file_name(&"1,2+".repeat(64)), file_name(&"1,3+".repeat(64))];
        assert!(
            long[0] != long[1] && long.iter().all(|name| name.len() < 80),
            "{long:?}"
        );
        assert_ne!(file_name("red-cup"), file_name("red_cup"));
    }
}
