//! Contact sheets: rows of images, each with a title and a note below.

use super::Scene;
use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use fastlgs_core::{Camera, image_io, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_raster::Frame;
use image::imageops::{FilterType, overlay, resize};
use image::{Rgb, RgbImage};

/// An image with its title and note.
pub struct Tile {
    picture: RgbImage,
    title: String,
    note: String,
}

impl Tile {
    /// Creates a tile from an image of any size. Title and note may be empty.
    pub fn new(picture: &RgbImage, title: impl Into<String>, note: impl Into<String>) -> Self {
        Self {
            picture: fitted(picture, IMAGE_SIDE),
            title: title.into(),
            note: note.into(),
        }
    }

    /// Creates a small tile, for sheets with many images.
    pub fn small(picture: &RgbImage, title: impl Into<String>, note: impl Into<String>) -> Self {
        Self {
            picture: fitted(picture, SMALL_IMAGE_SIDE),
            title: title.into(),
            note: note.into(),
        }
    }
}

/// Returns the tiles of a view: its photo if there is one, the render, and the object map.
pub fn view_tiles(
    scene: &Scene,
    grid: &Grid,
    camera: &Camera,
    frame: &Frame,
    field: &Field,
) -> Vec<Tile> {
    let tile = |picture: RgbImage, title: &str| Tile::new(&picture, title, &camera.name);
    let owners = field.owners(grid);
    let objects = RgbImage::from_fn(frame.width, frame.height, |x, y| {
        Rgb(turbo::id_color(owners.at(x, y)))
    });
    let render = image_io::from_planar(frame.color(), frame.width, frame.height);
    let photo = scene
        .folder()
        .photo(&camera.name)
        .ok()
        .map(|photo| tile(photo, "photo"));
    photo
        .into_iter()
        .chain([tile(render, "render"), tile(objects, "objects")])
        .collect()
}

/// Longer side of an image on the sheet, in pixels.
const IMAGE_SIDE: u32 = 320;
/// Longer side of an image of a small tile, in pixels.
const SMALL_IMAGE_SIDE: u32 = 128;
/// Space between images, in pixels.
const GAP: u32 = 10;
/// Font sizes of title and note, in pixels.
const FONT_SIZES: [f32; 2] = [19.0, 15.0];
/// Height of the text below an image, in pixels.
const TEXT_HEIGHT: u32 = 48;
/// Colour of the background.
const PAPER: Rgb<u8> = Rgb([255; 3]);
/// Colours of title and note.
const INK: [Rgb<u8>; 2] = [Rgb([20; 3]), Rgb([90; 3])];

/// Arranges tiles in rows of `columns` tiles.
pub fn sheet(tiles: &[Tile], columns: usize) -> RgbImage {
    let columns = columns.clamp(1, tiles.len().max(1)) as u32;
    let width = tiles
        .iter()
        .map(|tile| tile.picture.width())
        .max()
        .unwrap_or(IMAGE_SIDE)
        + GAP;
    let height = tiles
        .iter()
        .map(|tile| tile.picture.height())
        .max()
        .unwrap_or(0)
        + TEXT_HEIGHT
        + GAP;
    let rows = (tiles.len() as u32).div_ceil(columns);
    let mut page = RgbImage::from_pixel(columns * width + GAP, rows * height + GAP, PAPER);
    for (place, tile @ Tile { picture, .. }) in (0..).zip(tiles) {
        let (left, top) = (
            GAP + place % columns * width,
            GAP + place / columns * height,
        );
        overlay(&mut page, picture, i64::from(left), i64::from(top));
        let base = (top + picture.height()) as f32;
        draw_text(
            &mut page,
            &tile.title,
            [left as f32, base + FONT_SIZES[0] + 2.0],
            width - GAP,
            FONT_SIZES[0],
            INK[0],
        );
        draw_text(
            &mut page,
            &tile.note,
            [left as f32, base + FONT_SIZES[0] + FONT_SIZES[1] + 5.0],
            width - GAP,
            FONT_SIZES[1],
            INK[1],
        );
    }
    page
}

/// Scales an image so that its longer side has `side` pixels.
fn fitted(picture: &RgbImage, side: u32) -> RgbImage {
    let scale = side as f32 / picture.width().max(picture.height()).max(1) as f32;
    let scaled = |pixels: u32| ((pixels as f32 * scale).round() as u32).max(1);
    resize(
        picture,
        scaled(picture.width()),
        scaled(picture.height()),
        FilterType::Triangle,
    )
}

/// Draws a line of text with its baseline starting at `base` (x, y). Text beyond `room` pixels is
/// cut off.
fn draw_text(
    page: &mut RgbImage,
    words: &str,
    base: [f32; 2],
    max_width: u32,
    size: f32,
    ink: Rgb<u8>,
) {
    let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT)
        .expect("the font is part of the program");
    let font = font.as_scaled(PxScale::from(size));
    let end = base[0] + max_width as f32;
    let mut pen = base[0];
    for letter in words.chars() {
        let glyph = font.scaled_glyph(letter);
        let (id, advance) = (glyph.id, font.h_advance(glyph.id));
        if pen + advance > end {
            break;
        }
        let glyph = id.with_scale_and_position(font.scale(), point(pen, base[1]));
        if let Some(outline) = font.outline_glyph(glyph) {
            let corner = outline.px_bounds().min;
            outline.draw(|x, y, cover| {
                let (x, y) = (
                    corner.x as i64 + i64::from(x),
                    corner.y as i64 + i64::from(y),
                );
                let inside =
                    x >= 0 && y >= 0 && x < i64::from(page.width()) && y < i64::from(page.height());
                if inside {
                    let pixel = page.get_pixel_mut(x as u32, y as u32);
                    *pixel = Rgb([0, 1, 2].map(|k| {
                        (f32::from(pixel[k]) * (1.0 - cover) + f32::from(ink[k]) * cover) as u8
                    }));
                }
            });
        }
        pen += advance;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_are_arranged_in_rows_with_text_below() {
        let note = "0.98, 120 pixels, and more than there is room for on one line of a sheet";
        let tile = |color: [u8; 3], title: &str| {
            Tile::new(&RgbImage::from_pixel(64, 32, Rgb(color)), title, note)
        };
        let page = sheet(
            &[
                tile([255, 0, 0], "photo"),
                tile([0, 255, 0], ""),
                tile([0, 0, 255], "Füchse"),
            ],
            2,
        );
        assert_eq!(
            page.dimensions(),
            (
                2 * (IMAGE_SIDE + GAP) + GAP,
                2 * (IMAGE_SIDE / 2 + TEXT_HEIGHT + GAP) + GAP
            )
        );
        let [second_column, second_row] =
            [2 * GAP + IMAGE_SIDE, 2 * GAP + IMAGE_SIDE / 2 + TEXT_HEIGHT].map(|v| v + 5);
        assert_eq!(page.get_pixel(GAP + 5, GAP + 5), &Rgb([255, 0, 0]));
        assert_eq!(page.get_pixel(second_column, GAP + 5), &Rgb([0, 255, 0]));
        assert_eq!(page.get_pixel(GAP + 5, second_row), &Rgb([0, 0, 255]));
        // Text is dark on white, below its image and not wider than it.
        let dark = |x: std::ops::Range<u32>, y: std::ops::Range<u32>| {
            x.flat_map(|x| y.clone().map(move |y| (x, y)))
                .filter(|&(x, y)| page.get_pixel(x, y)[0] < 128)
                .count()
        };
        let under = GAP + IMAGE_SIDE / 2..GAP + IMAGE_SIDE / 2 + 22;
        assert!(dark(GAP..GAP + IMAGE_SIDE, under.clone()) > 20);
        assert_eq!(
            (
                dark(GAP + IMAGE_SIDE..2 * GAP + IMAGE_SIDE, 0..page.height()),
                dark(second_column..page.width(), under)
            ),
            (0, 0)
        );
    }
}
