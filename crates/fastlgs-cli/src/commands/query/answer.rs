//! One answer in one view: its report and its pictures.

use super::selection;
use crate::scene::Scene;
use anyhow::Result;
use fastlgs_core::{Camera, image_io, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{Field, Found, Hit};
use fastlgs_raster::Frame;
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use std::path::Path;

/// Objects that a report lists with their scores, chosen or not.
const CANDIDATES: usize = 8;

/// What was found, in a view.
pub struct Answer<'a> {
    pub grid: &'a Grid,
    pub field: &'a Field,
    pub found: &'a Found,
    /// Pixels of the answer.
    pub mask: &'a [bool],
}

impl Answer<'_> {
    /// What `--json` prints of it.
    pub fn report(&self, scene: &Scene, asked: &str, camera: &Camera) -> Value {
        let objects: Vec<Value> = self.found.targets.iter().map(|t| self.object(scene, camera.width, t)).collect();
        json!({
            "text": asked,
            "view": camera.name,
            "size": format!("{}x{}", camera.width, camera.height),
            "found": !self.found.targets.is_empty(),
            "score": self.found.targets.first().or(self.found.ranked.first()).map_or(0.0, |h| h.score),
            "objects": objects,
            "candidates": &self.found.ranked[..self.found.ranked.len().min(CANDIDATES)],
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
        let own = selection::gaussians(scene, self.grid, &[*hit]);
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
    pub fn write(&self, folder: &Path, frame: &Frame, asked: &str, view: &str, heatmap: bool, value: &mut Value) -> Result<()> {
        let (w, h) = (frame.width, frame.height);
        let safe: String = asked.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect();
        let path = |what: &str| folder.join(format!("{view}.{safe}.{what}.png"));
        let at = |x: u32, y: u32| (y * w + x) as usize;
        let color = image_io::from_planar(frame.channels(0, 3), w, h);
        if self.found.targets.is_empty() {
            // A mask of an earlier run would contradict the answer.
            for what in ["mask", "overlay"] {
                let _ = std::fs::remove_file(path(what));
            }
        } else {
            image_io::save_png(&path("mask"), GrayImage::from_fn(w, h, |x, y| Luma([if self.mask[at(x, y)] { 255 } else { 0 }])))?;
            let overlay = RgbImage::from_fn(w, h, |x, y| {
                let c = color.get_pixel(x, y).0;
                Rgb(if self.mask[at(x, y)] { [c[0] / 2 + 127, c[1] / 2 + 40, c[2] / 2] } else { c.map(|v| v / 3) })
            });
            image_io::save_png(&path("overlay"), overlay)?;
            value["mask"] = json!(path("mask"));
        }
        if heatmap {
            let relevancy = self.field.relevancy(self.grid, &self.found.ranked);
            let picture = RgbImage::from_fn(w, h, |x, y| {
                let heat = turbo::turbo(relevancy[at(x, y)]);
                let c = color.get_pixel(x, y).0;
                Rgb(std::array::from_fn(|k| ((u16::from(heat[k]) * 3 + u16::from(c[k])) / 4) as u8))
            });
            image_io::save_png(&path("heatmap"), picture)?;
            value["heatmap"] = json!(path("heatmap"));
        }
        Ok(())
    }
}
