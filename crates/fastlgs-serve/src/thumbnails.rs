//! Small pictures of objects: each as the training view that shows most of it does.

use anyhow::Result;
use fastlgs::Session;
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use image::RgbImage;
use image::imageops::{FilterType, crop_imm, resize};
use std::collections::BTreeMap;

/// Views that are searched, spread over all.
const VIEWS: usize = 16;
/// Longer side of these views.
const VIEW_SIDE: u32 = 400;
/// Longer side of a thumbnail.
const SIDE: u32 = 96;
/// Share of its box that is shown around an object.
const MARGIN: f32 = 0.15;

/// Pictures that were made, and where to make more from.
#[derive(Default)]
pub struct Thumbnails {
    views: Vec<RgbImage>,
    best: Vec<Option<Best>>,
    made: BTreeMap<u16, Vec<u8>>,
}

/// Where an object is largest: view, pixels, and box (left, top, right, bottom; the last two excluded).
#[derive(Clone, Copy)]
struct Best {
    view: usize,
    pixels: u32,
    bounds: [u32; 4],
}

/// Of so many views one is searched.
fn step(scene: &Session) -> usize {
    scene.cameras.len().div_ceil(VIEWS).max(1)
}

impl Thumbnails {
    /// The PNG of an object; nothing for one that no view shows.
    pub fn png(&mut self, scene: &mut Session, grid: &Grid, id: u16) -> Result<Option<Vec<u8>>> {
        if !self.made.contains_key(&id) {
            let Some(picture) = self.picture(scene, grid, id)? else { return Ok(None) };
            self.made.insert(id, image_io::encode_png(picture)?);
        }
        Ok(self.made.get(&id).cloned())
    }

    /// The picture of an object; nothing for one that no view shows.
    pub fn picture(&mut self, scene: &mut Session, grid: &Grid, id: u16) -> Result<Option<RgbImage>> {
        let Some(Best { view, bounds: [left, top, right, bottom], .. }) = self.best(scene, grid, id)? else { return Ok(None) };
        let picture = &self.views[view];
        let margin = (MARGIN * (right - left).max(bottom - top) as f32).ceil() as u32 + 2;
        let (left, top) = (left.saturating_sub(margin), top.saturating_sub(margin));
        let (right, bottom) = ((right + margin).min(picture.width()), (bottom + margin).min(picture.height()));
        let (w, h) = (right - left, bottom - top);
        let scale = SIDE as f32 / w.max(h) as f32;
        let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
        Ok(Some(resize(&*crop_imm(picture, left, top, w, h), size(w), size(h), FilterType::Triangle)))
    }

    /// The view, of those that are searched, that shows most of an object; nothing for one that none shows.
    pub fn view(&mut self, scene: &mut Session, grid: &Grid, id: u16) -> Result<Option<String>> {
        let best = self.best(scene, grid, id)?;
        Ok(best.map(|best| scene.cameras[best.view * step(scene)].name.clone()))
    }

    fn best(&mut self, scene: &mut Session, grid: &Grid, id: u16) -> Result<Option<Best>> {
        if self.best.is_empty() {
            self.search(scene, grid)?;
        }
        Ok(self.best.get(usize::from(id)).copied().flatten())
    }

    /// Looks through some views for the place where each object is largest.
    fn search(&mut self, scene: &mut Session, grid: &Grid) -> Result<()> {
        let cameras: Vec<Camera> = scene.cameras.iter().step_by(step(scene)).map(|c| c.shrunk_to(VIEW_SIDE)).collect();
        let mut best: Vec<Option<Best>> = vec![None; grid.objects.len() + 1];
        let mut views = Vec::new();
        for (view, camera) in cameras.iter().enumerate() {
            let mut here: BTreeMap<u16, Best> = BTreeMap::new();
            let mut pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
            scene.field(camera, None)?.each(grid, |objects| {
                let (x, y) = pixels.next().unwrap_or_default();
                for id in objects {
                    let own = here.entry(*id).or_insert(Best { view, pixels: 0, bounds: [x, y, x, y] });
                    let b = own.bounds;
                    own.pixels += 1;
                    own.bounds = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
                }
            });
            for (id, own) in here {
                let known = &mut best[usize::from(id)];
                if known.is_none_or(|known| known.pixels < own.pixels) {
                    *known = Some(own);
                }
            }
            let frame = scene.render(camera)?;
            views.push(image_io::from_planar(frame.channels(0, 3), frame.width, frame.height));
        }
        self.views = views;
        self.best = best;
        Ok(())
    }
}
