//! Small pictures of objects. Each is cut from the searched view that shows most of the object.

use anyhow::Result;
use fastlgs::Scene;
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use image::RgbImage;
use image::imageops::{FilterType, crop_imm, resize};
use std::collections::BTreeMap;

/// Largest number of views that are searched, evenly spread.
const THUMBNAIL_VIEWS: usize = 16;
/// Longer side of these views, in pixels.
const VIEW_SIDE: u32 = 400;
/// Longer side of a thumbnail, in pixels.
const THUMBNAIL_SIDE: u32 = 96;
/// Margin around the box of an object, relative to the longer side of the box.
const MARGIN: f32 = 0.15;

/// Cached thumbnails, and the rendered views from which more are cut.
#[derive(Default)]
pub struct Thumbnails {
    views: Vec<RgbImage>,
    best: Vec<Option<Best>>,
    png_cache: BTreeMap<u16, Vec<u8>>,
}

/// The searched view in which an object has most pixels: index, number of pixels, and box (left,
/// top, right, bottom; right and bottom are exclusive).
#[derive(Clone, Copy)]
struct Best {
    view: usize,
    pixels: u32,
    bounds: [u32; 4],
}

/// Returns the step between searched views.
fn step(scene: &Scene) -> usize {
    scene.cameras().len().div_ceil(THUMBNAIL_VIEWS).max(1)
}

impl Thumbnails {
    /// Returns the thumbnail of an object as PNG, or `None` if no searched view shows it.
    pub fn png(&mut self, scene: &mut Scene, grid: &Grid, id: u16) -> Result<Option<Vec<u8>>> {
        if !self.png_cache.contains_key(&id) {
            let Some(picture) = self.picture(scene, grid, id)? else {
                return Ok(None);
            };
            self.png_cache.insert(id, image_io::encode_png(picture)?);
        }
        Ok(self.png_cache.get(&id).cloned())
    }

    /// Returns the thumbnail of an object, or `None` if no searched view shows it.
    pub fn picture(&mut self, scene: &mut Scene, grid: &Grid, id: u16) -> Result<Option<RgbImage>> {
        let Some(Best {
            view,
            bounds: [left, top, right, bottom],
            ..
        }) = self.best(scene, grid, id)?
        else {
            return Ok(None);
        };
        let picture = &self.views[view];
        let margin = (MARGIN * (right - left).max(bottom - top) as f32).ceil() as u32 + 2;
        let (left, top) = (left.saturating_sub(margin), top.saturating_sub(margin));
        let (right, bottom) = (
            (right + margin).min(picture.width()),
            (bottom + margin).min(picture.height()),
        );
        let (w, h) = (right - left, bottom - top);
        let scale = THUMBNAIL_SIDE as f32 / w.max(h) as f32;
        let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
        Ok(Some(resize(
            &*crop_imm(picture, left, top, w, h),
            size(w),
            size(h),
            FilterType::Triangle,
        )))
    }

    /// Returns the name of the searched view that shows most of an object, or `None` if none does.
    pub fn view(&mut self, scene: &mut Scene, grid: &Grid, id: u16) -> Result<Option<String>> {
        let best = self.best(scene, grid, id)?;
        Ok(best.map(|best| scene.cameras()[best.view * step(scene)].name.clone()))
    }

    fn best(&mut self, scene: &mut Scene, grid: &Grid, id: u16) -> Result<Option<Best>> {
        if self.best.is_empty() {
            self.search(scene, grid)?;
        }
        Ok(self.best.get(usize::from(id)).copied().flatten())
    }

    /// Renders the searched views, and finds for each object the one with most of its pixels.
    fn search(&mut self, scene: &mut Scene, grid: &Grid) -> Result<()> {
        let cameras: Vec<Camera> = scene
            .cameras()
            .iter()
            .step_by(step(scene))
            .map(|c| c.shrunk_to(VIEW_SIDE))
            .collect();
        let mut best: Vec<Option<Best>> = vec![None; grid.objects.len() + 1];
        let mut views = Vec::new();
        for (view, camera) in cameras.iter().enumerate() {
            let mut in_view: BTreeMap<u16, Best> = BTreeMap::new();
            let mut pixels =
                (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
            scene.field(camera, None)?.for_each_pixel(grid, |objects| {
                let (x, y) = pixels.next().unwrap_or_default();
                for id in objects {
                    let own = in_view.entry(*id).or_insert(Best {
                        view,
                        pixels: 0,
                        bounds: [x, y, x, y],
                    });
                    let b = own.bounds;
                    own.pixels += 1;
                    own.bounds = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
                }
            });
            for (id, own) in in_view {
                let known = &mut best[usize::from(id)];
                if known.is_none_or(|known| known.pixels < own.pixels) {
                    *known = Some(own);
                }
            }
            let frame = scene.render(camera)?;
            views.push(image_io::from_planar(
                frame.color(),
                frame.width,
                frame.height,
            ));
        }
        self.views = views;
        self.best = best;
        Ok(())
    }
}
