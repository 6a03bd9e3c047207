//! Loads photos: undistorts and scales them, writes them into the scene folder, and detects key
//! points.

use super::config::PreprocessConfig;
use crate::cache::{self, Cache, Key};
use crate::error::{Context, bail};
use crate::{Result, Run};
use fastlgs_core::dataset::{Dataset, PosedPhoto};
use fastlgs_core::image_io::OrientationRule;
use fastlgs_core::mask_image::MaskImage;
use fastlgs_core::undistort::{Distortion, coverage_mask, undistort, undistort_gray};
use fastlgs_core::{Camera, SceneFolder, image_io};
use fastlgs_sfm::keypoints::{self, Keypoints};
use fastlgs_sfm::photo_quality::{self, PhotoStats};
use glam::Vec2;
use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// A prepared photo: undistorted and scaled.
pub struct Photo {
    /// Camera at the size of the prepared photo.
    pub camera: Camera,
    /// RGB pixels.
    pub pixels: RgbImage,
    /// Alpha channel, if the photo has one: 0 is transparent, 255 is opaque.
    alpha: Option<GrayImage>,
    /// Mask of the pixels that count. Pixels with values below 128 are ignored.
    ignore: Option<GrayImage>,
    /// Share of the photo that its mask file keeps; `None` without a mask file.
    mask_extent: Option<Extent>,
}

/// Whether a mask covers no pixel, some pixels, or all pixels of a photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Extent {
    Nothing,
    Part,
    Everything,
}

impl Extent {
    fn of(pixels: usize, all: usize) -> Self {
        match pixels {
            0 => Self::Nothing,
            n if n == all => Self::Everything,
            _ => Self::Part,
        }
    }
}

/// Data of a prepared photo that stays in memory. Pixels stay on disk, so that memory suffices for
/// thousands of photos.
pub(super) struct PreparedPhoto {
    pub camera: Camera,
    /// Fingerprint of the pixels.
    pub key: Key,
    stats: PhotoStats,
    /// Share of the photo that its mask file keeps; `None` without a mask file.
    mask_extent: Option<Extent>,
    /// Extent of the pixels that are not fully transparent.
    opaque: Extent,
    pub points: Keypoints,
    /// Colour at each key point.
    pub colors: Vec<[u8; 3]>,
    /// Radial term that `remove_distortion` removed in addition to the stated distortion; 0 if
    /// none.
    pub removed_k1: f32,
}

/// Warns about blurred and repeated photos, which are used nevertheless.
pub(super) fn warn_of_bad_photos(photos: &[PreparedPhoto], run: &Run, warnings: &mut Vec<String>) {
    let seen: Vec<PhotoStats> = photos.iter().map(|p| p.stats.clone()).collect();
    for (list, what) in [
        (photo_quality::blurred(&seen), "are blurred"),
        (
            photo_quality::repeated(&seen),
            "are nearly identical to the photo before them",
        ),
    ] {
        if !list.is_empty() {
            let names: Vec<&str> = list
                .iter()
                .map(|&i| photos[i].camera.name.as_str())
                .collect();
            let warning = format!(
                "{} of {} photos {what}: {}",
                list.len(),
                photos.len(),
                names.join(", ")
            );
            run.warn(&warning);
            warnings.push(warning);
        }
    }
}

/// Checks the masks and alpha channels of the photos. Warns if only some of them are unusable.
///
/// # Errors
/// All mask files ignore every pixel, or all mask files ignore no pixel, or all photos are fully
/// transparent.
pub(super) fn check_masks(
    photos: &[PreparedPhoto],
    run: &Run,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let masked: Vec<&PreparedPhoto> = photos.iter().filter(|p| p.mask_extent.is_some()).collect();
    let names_with_extent = |extent| {
        masked
            .iter()
            .filter(|p| p.mask_extent == Some(extent))
            .map(|p| p.camera.name.as_str())
            .collect::<Vec<_>>()
    };
    let (nothing, everything) = (
        names_with_extent(Extent::Nothing),
        names_with_extent(Extent::Everything),
    );
    let transparent: Vec<&str> = photos
        .iter()
        .filter(|p| p.opaque == Extent::Nothing)
        .map(|p| p.camera.name.as_str())
        .collect();
    if !masked.is_empty() && nothing.len() == masked.len() {
        bail!(
            "the masks of all {} masked photos leave nothing to train on, because black pixels are ignored; check whether the masks are inverted",
            masked.len()
        );
    }
    if !masked.is_empty() && everything.len() == masked.len() {
        bail!(
            "the masks of all {} masked photos ignore no pixel; check that they are the right files and that ignored pixels are black",
            masked.len()
        );
    }
    if transparent.len() == photos.len() {
        bail!(
            "all {} photos are fully transparent; export them with their colours",
            photos.len()
        );
    }
    let unused = "have masks that ignore every pixel, so that training does not use them";
    let invisible = "are fully transparent and show only the background";
    for (list, what) in [
        (nothing, unused),
        (everything, "have masks that ignore no pixel"),
        (transparent, invisible),
    ] {
        if !list.is_empty() {
            let (count, all, names) = (list.len(), photos.len(), list.join(", "));
            let warning = format!("{count} of {all} photos {what}: {names}");
            super::warn(run, warnings, warning);
        }
    }
    Ok(())
}

/// Sets the colour of points that come without one to the mean over the photos that show them.
pub(super) fn color_points(
    dataset: &mut Dataset,
    photos: &[PreparedPhoto],
    folder: &SceneFolder,
) -> Result<()> {
    if dataset.track_photos.is_empty() {
        return Ok(());
    }
    let mut sums = vec![[0u32; 4]; dataset.points.len()];
    for (index, known) in photos.iter().enumerate() {
        let pixels = folder.photo(&known.camera.name)?;
        let shows = |list: &Vec<u32>| list.is_empty() || list.contains(&(index as u32));
        for (point, sum) in dataset
            .points
            .iter()
            .zip(&mut sums)
            .zip(&dataset.track_photos)
            .filter(|(_, list)| shows(list))
            .map(|p| p.0)
        {
            if let Some((place, _)) = known.camera.pixel_and_depth(point.position) {
                let (x, y) = (place as u32 % pixels.width(), place as u32 / pixels.width());
                let [r, g, b] = pixels.get_pixel(x, y).0.map(u32::from);
                *sum = [sum[0] + r, sum[1] + g, sum[2] + b, sum[3] + 1];
            }
        }
    }
    for (point, [r, g, b, count]) in dataset
        .points
        .iter_mut()
        .zip(sums)
        .filter(|(_, sum)| sum[3] > 0)
    {
        point.color = [r, g, b].map(|sum| (sum / count) as u8);
    }
    Ok(())
}

/// Memory to decode, scale, undistort and encode a photo, in bytes per pixel of its file.
const BYTES_A_PIXEL: u64 = 12;

/// Loads all photos, writes the prepared photos into the scene folder, and detects their key
/// points. `config.memory` limits how many are loaded at once.
pub(super) fn load(
    dataset: &Dataset,
    config: &PreprocessConfig,
    folder: &SceneFolder,
    cache: &Cache,
    run: &Run,
) -> Result<Vec<PreparedPhoto>> {
    let work = run.work("photos", dataset.photos.len() as u64);
    let largest = dataset
        .photos
        .iter()
        .map(|p| u64::from(p.camera.width) * u64::from(p.camera.height))
        .max()
        .unwrap_or(1);
    let batch_size = (config.memory / (BYTES_A_PIXEL * largest.max(1))).clamp(1, 256) as usize;
    let mut photos = Vec::with_capacity(dataset.photos.len());
    for batch in dataset.photos.chunks(batch_size) {
        let loaded: Vec<Result<PreparedPhoto>> = batch
            .par_iter()
            .map(|posed| {
                let photo = load_photo(posed, config.max_side)?;
                save_photo(&photo, folder)?;
                work.advance()?;
                prepare(photo, cache)
            })
            .collect();
        for photo in loaded {
            photos.push(photo?);
        }
    }
    Ok(photos)
}

fn fingerprint(camera: &Camera, pixels: &RgbImage) -> Key {
    cache::key(&[&camera.width.to_le_bytes(), pixels.as_raw()])
}

/// Detects key points, and measures colours, sharpness and coverage of a prepared photo. Key points
/// are cached.
fn prepare(
    Photo {
        camera,
        pixels,
        alpha,
        mask_extent,
        ..
    }: Photo,
    cache: &Cache,
) -> Result<PreparedPhoto> {
    let covered = |alpha: GrayImage| {
        Extent::of(
            alpha.pixels().filter(|p| p[0] > 0).count(),
            alpha.pixels().len(),
        )
    };
    let opaque = alpha.map_or(Extent::Everything, covered);
    let key = fingerprint(&camera, &pixels);
    let inputs = cache::key(&[&key, keypoints::version().as_bytes()]);
    let points = cache.get("key points", &inputs, || {
        Ok(keypoints::detect(&image::imageops::grayscale(&pixels))?)
    })?;
    let color = |p: &Vec2| {
        pixels
            .get_pixel(
                (p.x as u32).min(pixels.width() - 1),
                (p.y as u32).min(pixels.height() - 1),
            )
            .0
    };
    let colors = points.positions.iter().map(color).collect();
    Ok(PreparedPhoto {
        stats: PhotoStats::of(&pixels),
        mask_extent,
        opaque,
        camera,
        key,
        points,
        colors,
        removed_k1: 0.0,
    })
}

/// Writes a prepared photo with its masks into the scene folder.
fn save_photo(photo: &Photo, folder: &SceneFolder) -> Result<()> {
    let name = &photo.camera.name;
    image_io::save_png(&folder.photo_path(name), photo.pixels.clone())?;
    for (mask, path) in [
        (&photo.alpha, folder.alpha_path(name)),
        (&photo.ignore, folder.ignore_path(name)),
    ] {
        match mask {
            Some(mask) => image_io::save_png(&path, mask.clone())?,
            // A mask of an earlier run does not belong to this photo.
            None if path.is_file() => {
                std::fs::remove_file(&path).with_context(|| path.display().to_string())?
            }
            None => {}
        }
    }
    Ok(())
}

/// Removes additional radial distortion from the prepared photos and their key points. `k1` holds
/// the radial term of each photo, for the current focal length of its camera.
pub(super) fn remove_distortion(
    photos: &mut [PreparedPhoto],
    k1: &[f32],
    folder: &SceneFolder,
) -> Result<()> {
    photos.par_iter_mut().zip(k1).try_for_each(|(known, &k1)| {
        let (camera, lens) = (
            known.camera.clone(),
            Distortion {
                k1,
                ..Distortion::default()
            },
        );
        let known_mask = |path: PathBuf| {
            path.is_file()
                .then(|| image_io::load_gray(&path))
                .transpose()
        };
        let (alpha, ignore) = (
            known_mask(folder.alpha_path(&camera.name))?,
            known_mask(folder.ignore_path(&camera.name))?,
        );
        let mask = |mask: &GrayImage| undistort_gray(mask, &camera, &lens);
        let ignore = intersect_masks(ignore.as_ref().map(mask), coverage_mask(&camera, &lens));
        let color = |photo: &RgbImage| undistort(photo, &camera, &lens);
        let (pixels, alpha) = resampled(&folder.photo(&camera.name)?, alpha.as_ref(), color, mask);
        (known.key, known.removed_k1) = (fingerprint(&camera, &pixels), k1);
        known
            .points
            .positions
            .iter_mut()
            .for_each(|p| *p = lens.undistort_pixel(&camera, *p));
        save_photo(
            &Photo {
                camera,
                pixels,
                alpha,
                ignore,
                mask_extent: known.mask_extent,
            },
            folder,
        )
    })
}

/// Returns the smaller value of two masks at each pixel. If only one mask exists, returns that.
fn intersect_masks(one: Option<GrayImage>, other: Option<GrayImage>) -> Option<GrayImage> {
    match (one, other) {
        (Some(mut one), Some(other)) => {
            one.pixels_mut()
                .zip(other.pixels())
                .for_each(|(a, b)| a[0] = a[0].min(b[0]));
            Some(one)
        }
        (one, other) => one.or(other),
    }
}

/// Loads a photo, scales it to at most `max_side` pixels and undistorts it. Scaling comes first,
/// because undistorting fewer pixels is faster and distortion does not depend on scale.
///
/// # Errors
/// The photo or its mask cannot be read, or its proportions differ from those of its camera.
pub fn load_photo(posed: &PosedPhoto, max_side: u32) -> Result<Photo> {
    let orientation_rule = if posed.upright {
        OrientationRule::Upright
    } else {
        OrientationRule::AsPosed(posed.camera.width, posed.camera.height)
    };
    let image_io::Photo { pixels: raw, alpha } =
        image_io::load_photo(&posed.path, orientation_rule)?;
    // The size of the file is authoritative: some tools scale photos and keep the file of the
    // poses.
    let camera = posed
        .camera
        .resized(raw.width(), raw.height())
        .shrunk_to(max_side);
    if !has_same_proportions(raw.dimensions(), (posed.camera.width, posed.camera.height)) {
        bail!(
            "{}: the photo is {}x{}, but its camera is {}x{}; check whether it was rotated or cropped after the poses were computed",
            posed.path.display(),
            raw.width(),
            raw.height(),
            posed.camera.width,
            posed.camera.height
        );
    }
    let mask = |mask: &GrayImage| {
        undistort_gray(
            &image_io::resize_gray(mask, camera.width, camera.height),
            &camera,
            &posed.distortion,
        )
    };
    let color = |photo: &RgbImage| {
        let small = image_io::resize(photo, camera.width, camera.height);
        if posed.distortion.is_none() {
            small
        } else {
            undistort(&small, &camera, &posed.distortion)
        }
    };
    let (pixels, alpha) = resampled(&raw, alpha.as_ref(), color, mask);
    let own = posed.ignore.as_deref();
    let own = own.map(|path| ignore_mask(path, raw.dimensions()));
    let own = own.transpose()?;
    let ignore = own.as_ref().map(|own| mask(&own.to_gray()));
    let ignore = intersect_masks(ignore, coverage_mask(&camera, &posed.distortion));
    Ok(Photo {
        pixels,
        alpha,
        ignore,
        mask_extent: own.map(|own| Extent::of(own.area(), own.inside.len())),
        camera,
    })
}

/// Loads the ignore mask of a photo of this size.
fn ignore_mask(path: &Path, (width, height): (u32, u32)) -> Result<MaskImage> {
    let mask = MaskImage::load(path)?;
    if !has_same_proportions((mask.width, mask.height), (width, height)) {
        bail!(
            "{}: the mask is {}x{}, but its photo is {width}x{height}; check whether it was rotated or cropped",
            path.display(),
            mask.width,
            mask.height
        );
    }
    Ok(mask)
}

/// Returns whether two sizes have the same proportions within 2 %, which allows for rounding.
fn has_same_proportions((w, h): (u32, u32), (width, height): (u32, u32)) -> bool {
    (f64::from(w) / f64::from(h) * f64::from(height) / f64::from(width) - 1.0).abs() <= 0.02
}

/// Resamples a photo and its alpha channel. Colours are multiplied by alpha before and divided by
/// it after, so that transparent pixels do not affect opaque ones.
fn resampled(
    pixels: &RgbImage,
    alpha: Option<&GrayImage>,
    color: impl Fn(&RgbImage) -> RgbImage,
    mask: impl Fn(&GrayImage) -> GrayImage,
) -> (RgbImage, Option<GrayImage>) {
    let Some(alpha) = alpha else {
        return (color(pixels), None);
    };
    let scale_by_alpha = |photo: &mut RgbImage, alpha: &GrayImage, factor: fn(f32) -> f32| {
        for (pixel, covered) in photo.pixels_mut().zip(alpha.pixels()) {
            let factor = factor(f32::from(covered[0]) / 255.0);
            pixel.0 = pixel.0.map(|v| (f32::from(v) * factor + 0.5) as u8);
        }
    };
    let mut weighted = pixels.clone();
    scale_by_alpha(&mut weighted, alpha, |covered| covered);
    let (mut pixels, alpha) = (color(&weighted), mask(alpha));
    scale_by_alpha(&mut pixels, &alpha, |covered| {
        if covered > 0.0 { 1.0 / covered } else { 0.0 }
    });
    (pixels, Some(alpha))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Luma, Rgb};

    #[test]
    fn points_without_colours_take_them_from_the_photos_that_show_them() {
        let dir = tempfile::tempdir().unwrap();
        let photos = dir.path().join("photos");
        for (name, color) in [("a.png", [200, 10, 20]), ("b.png", [100, 30, 40])] {
            image_io::save_png(
                &photos.join("images").join(name),
                RgbImage::from_pixel(64, 64, Rgb(color)),
            )
            .unwrap();
        }
        let model = photos.join("sparse/0");
        std::fs::create_dir_all(&model).unwrap();
        let write = |name: &str, text: &str| std::fs::write(model.join(name), text).unwrap();
        write("cameras.txt", "1 PINHOLE 64 64 60 60 32 32\n");
        write(
            "images.txt",
            "1 1 0 0 0 0 0 4 1 a.png\n\n2 1 0 0 0 0 0 4 1 b.png\n\n",
        );
        // Both photos show the first point; only the second photo shows the second point.
        write(
            "points3D.txt",
            "1 0 0 0 0 0 0 0.5 1 0 2 0\n2 0.1 0 0 0 0 0 0.5 2 1\n",
        );
        let mut dataset = fastlgs_core::dataset::load(&photos).unwrap();
        let folder = SceneFolder::new(dir.path().join("scene"));
        let (cache, run) = (
            Cache::new(&folder),
            Run {
                device: "cpu",
                seed: 0,
                progress: &crate::Silent,
            },
        );
        let config = PreprocessConfig {
            photos,
            ..PreprocessConfig::default()
        };
        let known = load(&dataset, &config, &folder, &cache, &run).unwrap();
        color_points(&mut dataset, &known, &folder).unwrap();
        let colors: Vec<[u8; 3]> = dataset.points.iter().map(|point| point.color).collect();
        assert_eq!(colors, [[150, 20, 30], [100, 30, 40]]);
    }

    #[test]
    fn transparent_pixels_do_not_darken_opaque_ones() {
        // The left half is white. The right half is transparent and black, as files store it.
        let pixels = RgbImage::from_fn(6, 2, |x, _| Rgb([if x < 3 { 255 } else { 0 }; 3]));
        let alpha = GrayImage::from_fn(6, 2, |x, _| Luma([if x < 3 { 255 } else { 0 }]));
        let (half, covered) = resampled(
            &pixels,
            Some(&alpha),
            |p| image_io::resize(p, 3, 1),
            |m| image_io::resize_gray(m, 3, 1),
        );
        let covered = covered.unwrap();
        assert!(
            (1..255).contains(&covered.get_pixel(1, 0)[0]),
            "{covered:?}"
        );
        assert!(
            half.pixels()
                .zip(covered.pixels())
                .all(|(p, a)| a[0] == 0 || p[0] >= 254),
            "{half:?}"
        );
    }
}
