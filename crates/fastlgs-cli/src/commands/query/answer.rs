//! One answer in one view: its report and its pictures.

use super::ask::Ask;
use super::selection;
use crate::scene::Scene;
use anyhow::Result;
use fastlgs_core::{Camera, image_io, metrics, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{Field, Found, Hit, QueryConfig};
use fastlgs_raster::Frame;
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Instant;

/// Objects that a report lists with their scores, chosen or not, unless more are asked for.
pub const CANDIDATES: usize = 8;

/// What is asked, and how the answer is chosen.
pub struct Question<'a> {
    pub ask: &'a Ask,
    /// Texts that the object must not be nearer to.
    pub negatives: &'a [String],
    pub config: QueryConfig,
    /// Half width and height by which masks are widened.
    pub dilate: Option<[u32; 2]>,
    /// Objects that the report lists.
    pub candidates: usize,
}

impl Question<'_> {
    /// Asks a rendered view; the answer and its report with milliseconds, to which the view's own are added.
    pub fn put<'a>(&self, scene: &Scene, grid: &'a Grid, field: &'a Field, camera: &Camera, render_ms: f64) -> Result<(Answer<'a>, Value)> {
        let mut clock = Instant::now();
        let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed().as_secs_f64() * 1e3;
        let meaning = self.ask.meaning(scene, self.negatives)?;
        let encode_ms = lap();
        let found = meaning.find(grid, field, camera, &self.config)?;
        let select_ms = lap();
        let mut mask = field.mask(grid, &found.targets);
        let restore_ms = lap();
        if let Some(radius) = self.dilate {
            mask = metrics::dilate(&mask, camera.width, camera.height, radius);
        }
        let answer = Answer { grid, field, found, mask };
        let mut value = answer.report(scene, &self.ask.name(), camera, self.candidates);
        let total = encode_ms + render_ms + select_ms + restore_ms;
        value["ms"] = json!({ "encode": encode_ms, "render": render_ms, "select": select_ms, "restore": restore_ms, "total": total });
        Ok((answer, value))
    }
}

/// What was found, in a view.
pub struct Answer<'a> {
    pub grid: &'a Grid,
    pub field: &'a Field,
    pub found: Found,
    /// Pixels of the answer.
    pub mask: Vec<bool>,
}

/// A picture with what was selected lit up and the rest dimmed.
pub fn overlay(color: &RgbImage, mask: &[bool]) -> RgbImage {
    RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let c = color.get_pixel(x, y).0;
        Rgb(if mask[(y * color.width() + x) as usize] { [c[0] / 2 + 127, c[1] / 2 + 40, c[2] / 2] } else { c.map(|v| v / 3) })
    })
}

/// A picture under the relevancy of its pixels in turbo colours.
pub fn heatmap(color: &RgbImage, relevancy: &[f32]) -> RgbImage {
    RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let heat = turbo::turbo(relevancy[(y * color.width() + x) as usize]);
        let c = color.get_pixel(x, y).0;
        Rgb(std::array::from_fn(|k| ((u16::from(heat[k]) * 3 + u16::from(c[k])) / 4) as u8))
    })
}

/// A mask as a picture.
pub fn mask_picture(mask: &[bool], width: u32, height: u32) -> GrayImage {
    GrayImage::from_fn(width, height, |x, y| Luma([if mask[(y * width + x) as usize] { 255 } else { 0 }]))
}

impl Answer<'_> {
    /// What `--json` prints of it.
    fn report(&self, scene: &Scene, asked: &str, camera: &Camera, candidates: usize) -> Value {
        let objects: Vec<Value> = self.found.targets.iter().map(|t| self.object(scene, camera.width, t)).collect();
        json!({
            "text": asked,
            "view": camera.name,
            "size": format!("{}x{}", camera.width, camera.height),
            "found": !self.found.targets.is_empty(),
            "score": self.found.targets.first().or(self.found.ranked.first()).map_or(0.0, |h| h.score),
            "objects": objects,
            "candidates": &self.found.ranked[..self.found.ranked.len().min(candidates)],
            "pixels": self.mask.iter().filter(|m| **m).count(),
            "mask": Value::Null,
            "heatmap": Value::Null,
            "gaussians": scene.gaussians.len(),
            "adapter": scene.engine.name(),
        })
    }

    /// Box and size of one object in this view and in the world.
    fn object(&self, scene: &Scene, width: u32, hit: &Hit) -> Value {
        let mut bounds: Option<[u32; 4]> = None;
        let mask = self.field.mask(self.grid, &[*hit]);
        for p in (0..mask.len() as u32).filter(|p| mask[*p as usize]) {
            let (x, y) = (p % width, p / width);
            let b = bounds.get_or_insert([x, y, x + 1, y + 1]);
            *b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
        }
        let own = selection::gaussians(scene, self.grid, &[hit.id]);
        let object = &self.grid.objects[usize::from(hit.id) - 1];
        json!({
            "id": hit.id,
            "parent": object.parent,
            "support": object.support,
            "score": hit.score,
            "bbox2d": bounds,
            "bbox3d": selection::robust_box(scene, &own),
            "pixels": mask.iter().filter(|m| **m).count(),
            "gaussians": own.len(),
        })
    }

    /// Writes mask, overlay and, where wanted, heat map; names them in `value`.
    pub fn write(&self, folder: &Path, frame: &Frame, asked: &str, view: &str, heat: bool, value: &mut Value) -> Result<()> {
        let (w, h) = (frame.width, frame.height);
        let safe: String = asked.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect();
        let path = |what: &str| folder.join(format!("{view}.{safe}.{what}.png"));
        let color = image_io::from_planar(frame.channels(0, 3), w, h);
        if self.found.targets.is_empty() {
            // A mask of an earlier run would contradict the answer.
            for what in ["mask", "overlay"] {
                let _ = std::fs::remove_file(path(what));
            }
        } else {
            image_io::save_png(&path("mask"), mask_picture(&self.mask, w, h))?;
            image_io::save_png(&path("overlay"), overlay(&color, &self.mask))?;
            value["mask"] = json!(path("mask"));
        }
        if heat {
            image_io::save_png(&path("heatmap"), heatmap(&color, &self.field.relevancy(self.grid, &self.found.ranked)))?;
            value["heatmap"] = json!(path("heatmap"));
        }
        Ok(())
    }
}
