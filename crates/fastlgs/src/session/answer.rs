//! One answer in one view: its report and its pictures.

use super::ask::Ask;
use super::pictures::{heatmap, mask_picture, overlay};
use super::{Session, selection};
use crate::Result;
use fastlgs_core::{Camera, image_io, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{Found, Hit, QueryConfig, best_score};
use fastlgs_raster::Frame;
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Objects that a report lists with their scores, chosen or not, unless more are asked for.
pub const CANDIDATES: usize = 8;
/// Pixels below which an answer is hardly seen.
const VISIBLE: usize = 30;

/// What is asked, and how the answer is chosen.
pub struct Question<'a> {
    /// What is asked.
    pub ask: &'a Ask,
    /// Texts that the object must not be nearer to.
    pub negatives: &'a [String],
    /// What counts as found.
    pub config: QueryConfig,
    /// Half width and height by which masks are widened.
    pub dilate: Option<[u32; 2]>,
    /// Objects that the report lists.
    pub candidates: usize,
}

impl Question<'_> {
    /// Asks a rendered view; the answer and its report with milliseconds, to which the view's own are added.
    ///
    /// # Errors
    /// A text or picture that cannot be embedded, or a point outside the view.
    pub fn put<'a>(
        &self,
        session: &Session,
        grid: &'a Grid,
        field: &'a Field,
        camera: &Camera,
        render_ms: f64,
    ) -> Result<(Answer<'a>, Report)> {
        let mut clock = Instant::now();
        let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed().as_secs_f64() * 1e3;
        let meaning = self.ask.meaning(session, self.negatives)?;
        let encode_ms = lap();
        let found = meaning.find(grid, field, camera, &self.config)?;
        let select_ms = lap();
        let mut mask = field.mask(grid, &found.targets);
        let restore_ms = lap();
        if let Some(radius) = self.dilate {
            mask = metrics::dilate(&mask, camera.width, camera.height, radius);
        }
        let answer = Answer { grid, field, found, mask, calibrated: meaning.is_calibrated() };
        let total = encode_ms + render_ms + select_ms + restore_ms;
        let ms = Milliseconds { encode: encode_ms, render: render_ms, select: select_ms, restore: restore_ms, total, gaussians: 0.0 };
        let report = answer.report(session, self.ask, camera, self.candidates, ms);
        Ok((answer, report))
    }
}

/// What is told of an answer.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Report {
    /// The text, the picture's name, or the point.
    pub text: String,
    /// Name of the view.
    pub view: String,
    /// Its size.
    pub size: String,
    /// Whether anything in the scene matches.
    pub found: bool,
    /// Score of the object that is most like what is asked, found or not: the share of absent names that score lower.
    pub score: f32,
    /// Whether that was measured with the scene's encoder; otherwise it follows from what is published about its kind.
    pub calibrated: bool,
    /// Whether the text is a name that the user has taught.
    pub taught: bool,
    /// The objects that form the answer.
    pub objects: Vec<ObjectReport>,
    /// The best objects, chosen or not.
    pub candidates: Vec<Hit>,
    /// Pixels of the mask.
    pub pixels: usize,
    /// The view that shows it best, where this one hardly does ([`Self::look_elsewhere`]).
    pub seen_best: Option<String>,
    /// File of the mask, where it was written.
    pub mask: Option<PathBuf>,
    /// File of the heat map, where it was written.
    pub heatmap: Option<PathBuf>,
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// The device's name.
    pub adapter: String,
    /// Where the time went.
    pub ms: Milliseconds,
}

impl Report {
    /// Names the view that shows the answer best, where this one hardly does.
    ///
    /// # Errors
    /// When the device fails.
    pub fn look_elsewhere(&mut self, session: &mut Session, grid: &Grid) -> Result<()> {
        // Without what widening adds to the mask.
        if self.found && self.objects.iter().map(|object| object.pixels).sum::<usize>() < VISIBLE {
            let ids: Vec<u16> = self.objects.iter().map(|o| o.id).collect();
            self.seen_best = session.seen_best(grid, &ids)?;
        }
        Ok(())
    }
}

/// One object of an answer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ObjectReport {
    /// Its number in the object table.
    pub id: u16,
    /// The object that it is a part of; 0 for none.
    pub parent: u16,
    /// How well the views' masks fit it, as their mean IoU.
    pub support: f32,
    /// Its score.
    pub score: f32,
    /// Left, top, right, bottom in pixels of the view, the last two excluded; nothing where the view does not show it.
    pub bbox2d: Option<[u32; 4]>,
    /// Its box in the world, without stray Gaussians.
    pub bbox3d: Option<[[f64; 3]; 2]>,
    /// Its pixels in the view.
    pub pixels: usize,
    /// Its Gaussians.
    pub gaussians: usize,
}

/// Milliseconds of an answer.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Milliseconds {
    /// Embedding the question.
    pub encode: f64,
    /// Rendering the view.
    pub render: f64,
    /// Choosing objects.
    pub select: f64,
    /// Making the mask.
    pub restore: f64,
    /// All of it.
    pub total: f64,
    /// Choosing the Gaussians of the answer, for boxes and exports, which a mask does not wait for.
    pub gaussians: f64,
}

/// Letters of a file's name that tell what was asked.
const NAME_LENGTH: usize = 60;

/// A text as part of a file's name. Where more than spaces gets lost, a number that only this text has takes its place.
fn file_name(text: &str) -> String {
    let safe: String = text.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).take(NAME_LENGTH).collect();
    let is_told = text.chars().count() <= NAME_LENGTH && text.chars().all(|c| c.is_alphanumeric() || c == ' ');
    if is_told { safe } else { format!("{safe}_{}", text.bytes().fold(5381u32, |hash, byte| hash.wrapping_mul(33) ^ u32::from(byte))) }
}

/// What was found, in a view.
pub struct Answer<'a> {
    /// The object table.
    pub grid: &'a Grid,
    /// What the view tells about objects.
    pub field: &'a Field,
    /// Objects by score, and those chosen.
    pub found: Found,
    /// Pixels of the answer.
    pub mask: Vec<bool>,
    /// See [`Report::calibrated`].
    pub calibrated: bool,
}

impl Answer<'_> {
    fn report(&self, session: &Session, ask: &Ask, camera: &Camera, candidates: usize, mut ms: Milliseconds) -> Report {
        let Found { ranked, targets } = &self.found;
        let text = ask.name();
        let started = Instant::now();
        let owned: Vec<Vec<usize>> = targets.iter().map(|t| selection::gaussians(&session.gaussians, self.grid, &[t.id])).collect();
        ms.gaussians = started.elapsed().as_secs_f64() * 1e3;
        Report {
            view: camera.name.clone(),
            size: format!("{}x{}", camera.width, camera.height),
            found: !targets.is_empty(),
            score: best_score(ranked),
            calibrated: self.calibrated,
            taught: matches!(ask, Ask::Text(_)) && session.is_taught(&text),
            text,
            objects: targets.iter().zip(&owned).map(|(t, own)| self.object(session, camera.width, t, own)).collect(),
            candidates: ranked[..ranked.len().min(candidates)].to_vec(),
            pixels: self.mask.iter().filter(|m| **m).count(),
            seen_best: None,
            mask: None,
            heatmap: None,
            gaussians: session.gaussians.len(),
            adapter: session.engine.name(),
            ms,
        }
    }

    /// Box and size of one object in this view and in the world.
    fn object(&self, session: &Session, width: u32, hit: &Hit, own: &[usize]) -> ObjectReport {
        let mut bounds: Option<[u32; 4]> = None;
        let mask = self.field.mask(self.grid, &[*hit]);
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
            bbox3d: selection::robust_box(&session.gaussians, &session.manifest.frame, own),
            pixels: mask.iter().filter(|m| **m).count(),
            gaussians: own.len(),
        }
    }

    /// Writes mask, overlay and, where wanted, heat map; names them in `report`, and returns the overlay.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn write(&self, folder: &Path, frame: &Frame, heat: bool, report: &mut Report) -> Result<RgbImage> {
        let (w, h) = (frame.width, frame.height);
        let safe = file_name(&report.text);
        let view = report.view.clone();
        let path = |what: &str| folder.join(format!("{view}.{safe}.{what}.png"));
        let color = image_io::from_planar(frame.channels(0, 3), w, h);
        let lit = overlay(&color, &self.mask);
        if self.found.targets.is_empty() {
            // A mask of an earlier run would contradict the answer.
            for what in ["mask", "overlay"] {
                let _ = std::fs::remove_file(path(what));
            }
        } else {
            image_io::save_png(&path("mask"), mask_picture(&self.mask, w, h))?;
            image_io::save_png(&path("overlay"), lit.clone())?;
            report.mask = Some(path("mask"));
        }
        if heat {
            image_io::save_png(&path("heatmap"), heatmap(&color, &self.field.relevancy(self.grid, &self.found.heat())))?;
            report.heatmap = Some(path("heatmap"));
        }
        Ok(lit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_different_questions_have_different_names() {
        assert_eq!([file_name("fox"), file_name("red cup"), file_name("Füchse 2")], ["fox", "red_cup", "Füchse_2"]);
        let long = [file_name(&"1,2+".repeat(64)), file_name(&"1,3+".repeat(64))];
        assert!(long[0] != long[1] && long.iter().all(|name| name.len() < 80), "{long:?}");
        assert_ne!(file_name("red-cup"), file_name("red_cup"));
    }
}
