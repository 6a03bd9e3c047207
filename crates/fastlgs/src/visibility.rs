//! Which views show which objects, and small pictures of objects.

use crate::{Result, Scene};
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use image::RgbImage;
use image::imageops::{FilterType, crop_imm, resize};
use std::collections::BTreeMap;

/// Longer side of the views in which pixels are counted, in pixels.
const SEARCH_SIDE: u32 = 192;
/// Longer side of the views from which pictures are cut, in pixels.
const PICTURE_SIDE: u32 = 400;
/// Longer side of a thumbnail, in pixels.
const THUMBNAIL_SIDE: u32 = 96;
/// Margin around the box of an object, relative to the longer side of the box.
const MARGIN: f32 = 0.15;

/// Pixels of each object in each view, and the rendered views from which pictures are cut.
pub struct Visibility {
    /// By view: number of pixels and box of each object that it shows.
    views: Vec<BTreeMap<u16, Extent>>,
    /// Views that were rendered for pictures.
    rendered: BTreeMap<usize, RgbImage>,
}

/// Number of pixels, and box: left, top, right, bottom as shares of the view's width and height.
#[derive(Clone, Copy)]
struct Extent {
    pixels: u32,
    bounds: [f32; 4],
}

impl Visibility {
    /// Counts the pixels of each object in each view of the scene.
    ///
    /// # Errors
    /// The device fails.
    pub fn of(scene: &mut Scene, grid: &Grid) -> Result<Self> {
        let cameras = scene.cameras().to_vec();
        let extents = |camera: &Camera| extents(scene, grid, &camera.shrunk_to(SEARCH_SIDE));
        Ok(Self {
            views: cameras.iter().map(extents).collect::<Result<_>>()?,
            rendered: BTreeMap::new(),
        })
    }

    /// Returns the index of the view that shows most pixels of some objects; `None` if no view
    /// shows them.
    pub fn best_view(&self, ids: &[u16]) -> Option<usize> {
        let pixels = |view: usize| -> u32 {
            let extent = |id: &u16| self.views[view].get(id).map_or(0, |extent| extent.pixels);
            ids.iter().map(extent).sum()
        };
        // Of equal views the first counts; `max_by_key` returns the last.
        let best = (0..self.views.len())
            .rev()
            .max_by_key(|view| pixels(*view))?;
        (pixels(best) > 0).then_some(best)
    }

    /// Returns a picture of an object, cut from the view that shows most of it; `None` if no view
    /// shows it.
    ///
    /// # Errors
    /// The device fails.
    pub fn thumbnail(&mut self, scene: &mut Scene, id: u16) -> Result<Option<RgbImage>> {
        let Some(view) = self.best_view(&[id]) else {
            return Ok(None);
        };
        let picture = match self.rendered.entry(view) {
            std::collections::btree_map::Entry::Occupied(known) => known.into_mut(),
            std::collections::btree_map::Entry::Vacant(empty) => {
                let camera = scene.cameras()[view].shrunk_to(PICTURE_SIDE);
                let frame = scene.render(&camera)?;
                let picture = image_io::from_planar(frame.color(), frame.width, frame.height);
                empty.insert(picture)
            }
        };
        Ok(Some(cut(picture, self.views[view][&id].bounds)))
    }
}

/// Returns the extent of each object in a view.
fn extents(scene: &mut Scene, grid: &Grid, camera: &Camera) -> Result<BTreeMap<u16, Extent>> {
    let (width, height) = (camera.width as f32, camera.height as f32);
    let mut found: BTreeMap<u16, Extent> = BTreeMap::new();
    let mut pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
    let field = scene.render_objects(camera, None)?;
    field.for_each_pixel(grid, |objects| {
        let (x, y) = pixels.next().unwrap_or_default();
        let [left, right] = [x, x + 1].map(|x| x as f32 / width);
        let [top, bottom] = [y, y + 1].map(|y| y as f32 / height);
        for id in objects {
            let own = found.entry(*id).or_insert(Extent {
                pixels: 0,
                bounds: [left, top, right, bottom],
            });
            let b = own.bounds;
            own.pixels += 1;
            own.bounds = [
                b[0].min(left),
                b[1].min(top),
                b[2].max(right),
                b[3].max(bottom),
            ];
        }
    });
    Ok(found)
}

/// Cuts a box out of a picture with a margin, and scales it to the size of a thumbnail.
fn cut(picture: &RgbImage, [left, top, right, bottom]: [f32; 4]) -> RgbImage {
    let (width, height) = (picture.width() as f32, picture.height() as f32);
    let [left, right] = [left, right].map(|x| x * width);
    let [top, bottom] = [top, bottom].map(|y| y * height);
    let margin = MARGIN * (right - left).max(bottom - top) + 2.0;
    let low = |v: f32| (v - margin).floor().max(0.0) as u32;
    let high = |v: f32, most: u32| ((v + margin).ceil() as u32).min(most);
    let (x, y) = (low(left), low(top));
    let (w, h) = (
        high(right, picture.width()) - x,
        high(bottom, picture.height()) - y,
    );
    let scale = THUMBNAIL_SIDE as f32 / w.max(h) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    let part = crop_imm(picture, x, y, w, h);
    resize(&*part, size(w), size(h), FilterType::Triangle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn the_best_view_shows_most_pixels_of_all_objects_together() {
        let view = |pixels: [u32; 2]| {
            let extent = |pixels: u32| Extent {
                pixels,
                bounds: [0.0, 0.0, 1.0, 1.0],
            };
            (1..).zip(pixels.map(extent)).collect()
        };
        let visibility = Visibility {
            views: vec![view([5, 0]), view([4, 4]), view([4, 4])],
            rendered: BTreeMap::new(),
        };
        let best = |ids: &[u16]| visibility.best_view(ids);
        assert_eq!([best(&[1]), best(&[1, 2])], [Some(0), Some(1)]);
        assert_eq!([best(&[3]), best(&[])], [None, None]);
    }

    #[test]
    fn thumbnails_have_a_margin_inside_the_picture() {
        let picture = RgbImage::from_fn(400, 200, |x, _| Rgb([(x / 2) as u8, 0, 0]));
        let part = cut(&picture, [0.0, 0.5, 0.25, 0.75]);
        // 117 x 84 pixels with the margin of 17.
        assert_eq!(part.dimensions(), (96, 69));
        assert!(part.get_pixel(95, 10)[0].abs_diff(58) < 3);
    }
}
