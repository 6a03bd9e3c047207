//! Writes the scene folder of a scene without the removed object.

use super::hidden::HiddenPixels;
use super::{embeddings, fill, refine};
use crate::staged::StagedOutput;
use crate::{Result, Run, Scene, SceneNotes, transparent};
use fastlgs_core::{Camera, Error, SceneFolder, image_io, ply};
use fastlgs_grid::Grid;
use fastlgs_grid::mask_pairs::{self, Pairs};
use fastlgs_vision::inpaint::Inpainter;
use image::{GrayImage, Luma, Rgb, RgbImage};
use std::collections::BTreeSet;
use std::path::Path;

/// Files that are not copied, because they describe the original photos.
const NOT_COPIED: [&str; 2] = ["masks/objects", "embeddings.safetensors"];

/// Share of hidden pixels from which a mask belongs to the removed object.
const MIN_HIDDEN_SHARE: f64 = 0.5;

/// Writes the scene that `session` holds to `output`. `what` names the removed object in the
/// manifest.
///
/// In training photos, rendered and inpainted colours replace the hidden pixels, and the scene is refined on these
/// photos. Held-out photos still show the object, so their hidden pixels are ignored.
pub fn write(
    output: &Path,
    session: &mut Scene,
    grid: &mut Grid,
    hidden: &HiddenPixels,
    what: &str,
    inpainter: &dyn Inpainter,
    run: &Run,
) -> Result<()> {
    let scene = SceneFolder::new(output);
    let staged = StagedOutput::new(&scene, "remove")?;
    let folder = &staged.folder;
    copy(
        &session.manifest().files,
        &session.folder().root,
        &folder.root,
    )?;
    let mut manifest = session.manifest().clone();
    let held_out = manifest.held_out(session.cameras());
    for view in &hidden.all {
        if held_out.iter().any(|c| c.name == view.0.name) {
            ignore_hidden(folder, &view.0, &view.1)?;
        } else {
            let colors = fill::photo_colors(session, view, inpainter)?;
            replace_hidden(folder, view, &colors)?;
        }
    }
    refine::refine(session, folder, &hidden.in_training, run)?;
    embeddings::renew(session, grid, folder, &hidden.in_training, run)?;
    // The masks have other labels now, so the pairs of the original scene are invalid.
    mask_pairs::save_pairs(folder, &Pairs::new())?;
    grid.save(folder)?;
    ply::write(&folder.ply_path(), session.gaussians())?;
    let compact = folder.compact_path();
    if compact.is_file() {
        std::fs::remove_file(&compact).map_err(Error::io(&compact))?;
    }
    // The result is not an output of `make`.
    let mut notes = SceneNotes::read(&manifest, &folder.root)?;
    notes.made = None;
    notes.removed.push(what.to_owned());
    if let Some(train) = &mut notes.train {
        train.gaussians = session.gaussians().len();
        train.objects = grid.objects.len();
        train.clear = transparent::count(session.gaussians());
    }
    notes.store(&mut manifest)?;
    staged.publish(&scene, &[], [], &manifest)
}

/// Adds the hidden pixels of a held-out view to its ignore mask.
fn ignore_hidden(folder: &SceneFolder, camera: &Camera, hidden: &[bool]) -> Result<()> {
    let path = folder.ignore_path(&camera.name);
    let before = path
        .is_file()
        .then(|| image_io::load_gray(&path))
        .transpose()?;
    let counts = |x: u32, y: u32| before.as_ref().map_or(255, |b| b.get_pixel(x, y)[0]);
    let mask = GrayImage::from_fn(camera.width, camera.height, |x, y| {
        let is_hidden = hidden[(y * camera.width + x) as usize];
        Luma([if is_hidden { 0 } else { counts(x, y) }])
    });
    Ok(image_io::save_png(&path, mask)?)
}

/// Replaces the hidden pixels of a training photo by `colors`, `[3][h][w]`, and removes the masks of
/// the object.
fn replace_hidden(
    folder: &SceneFolder,
    (camera, hidden): &(Camera, Vec<bool>),
    colors: &[f32],
) -> Result<()> {
    let mut photo = folder.photo(&camera.name)?;
    let counts = pixels_that_count(folder, &camera.name, hidden.len())?;
    patch(&mut photo, hidden, &counts, colors);
    image_io::save_png(&folder.photo_path(&camera.name), photo)?;
    let path = folder.masks_path(&camera.name);
    if !path.is_file() {
        return Ok(());
    }
    let mut masks = folder.masks(camera)?;
    let (width, height) = (masks.width, masks.height);
    masks.masks.retain(|mask| {
        let pixels = mask.runs.pixel_indices(width, height);
        let covered = pixels.filter(|p| hidden[*p]).count();
        (covered as f64) < MIN_HIDDEN_SHARE * mask.runs.area() as f64
    });
    Ok(masks.save(&path)?)
}

/// Returns the pixels of a photo that count: opaque ones that no mask ignores.
fn pixels_that_count(folder: &SceneFolder, name: &str, pixels: usize) -> Result<Vec<bool>> {
    let mut counts = vec![true; pixels];
    for path in [folder.alpha_path(name), folder.ignore_path(name)]
        .into_iter()
        .filter(|path| path.is_file())
    {
        counts
            .iter_mut()
            .zip(image_io::load_gray(&path)?.pixels())
            .for_each(|(counts, p)| *counts &= p[0] >= 128);
    }
    Ok(counts)
}

/// Smallest and largest gain of a photo relative to its render.
const GAINS: [f32; 2] = [0.25, 4.0];

/// Replaces the hidden pixels of a photo by rendered colours, `[3][h][w]`. A gain for each channel
/// matches the brightness of the visible pixels that count.
fn patch(photo: &mut RgbImage, hidden: &[bool], counts: &[bool], color: &[f32]) {
    let n = hidden.len();
    let gain: [f32; 3] = std::array::from_fn(|c| {
        let visible_pixels = photo
            .pixels()
            .zip(&color[c * n..(c + 1) * n])
            .zip(hidden.iter().zip(counts))
            .filter(|(_, (hidden, counts))| !**hidden && **counts);
        let (shown, rendered) = visible_pixels.fold((0.0, 0.0), |(a, b), ((p, v), _)| {
            (a + f32::from(p[c]) / 255.0, b + v.clamp(0.0, 1.0))
        });
        if rendered > 0.0 {
            (shown / rendered).clamp(GAINS[0], GAINS[1])
        } else {
            1.0
        }
    });
    for (p, pixel) in photo.pixels_mut().enumerate().filter(|(p, _)| hidden[*p]) {
        *pixel = Rgb(std::array::from_fn(|c| {
            (255.0 * (gain[c] * color[c * n + p]).clamp(0.0, 1.0) + 0.5) as u8
        }));
    }
}

/// Copies the files of a scene that exist, except those in `NOT_COPIED`.
fn copy(files: &BTreeSet<String>, from: &Path, to: &Path) -> Result<()> {
    let stays = |file: &&String| {
        !NOT_COPIED
            .iter()
            .any(|left| Path::new(file).starts_with(left))
            && from.join(file).is_file()
    };
    for file in files.iter().filter(stays) {
        let (old, new) = (from.join(file), to.join(file));
        let parent = new.parent().unwrap_or(to);
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
        std::fs::copy(&old, &new).map_err(Error::io(&old))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patched_colours_match_the_brightness_of_the_photo() {
        // The visible half of the photo is half as bright as the render; the right half is hidden.
        let mut photo = RgbImage::from_fn(8, 2, |x, _| Rgb([if x < 4 { 50 } else { 255 }; 3]));
        let hidden: Vec<bool> = (0..16).map(|p| p % 8 >= 4).collect();
        // A pixel that does not count does not affect the gain.
        photo.put_pixel(0, 0, Rgb([255; 3]));
        let counts: Vec<bool> = (0..16).map(|p| p != 0).collect();
        patch(&mut photo, &hidden, &counts, &[100.0 / 255.0; 3 * 16]);
        assert!(photo.pixels().skip(1).all(|p| p.0 == [50; 3]), "{photo:?}");
    }
}
