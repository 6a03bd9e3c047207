//! Measures rendered depth against true depth maps. `docs/guide.md` defines the measures.

use crate::error::bail;
use crate::{Result, Scene};
use fastlgs_core::{exr_image, image_io};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Relative errors of depth above which the shares of pixels are reported.
const LIMITS: [f64; 3] = [0.05, 0.10, 0.25];

/// Depth accuracy over all pixels with a known depth. The error of a pixel is
/// |rendered - true| / true; it is infinite where nothing is rendered.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct DepthQuality {
    /// Number of views with true depth.
    pub views: usize,
    /// Number of pixels with a known depth.
    pub pixels: usize,
    /// Median relative error; `None` if nothing is rendered in most pixels.
    pub median_error: Option<f64>,
    /// Share of pixels whose error exceeds 5 %.
    pub above_5_percent: f64,
    /// Share of pixels whose error exceeds 10 %.
    pub above_10_percent: f64,
    /// Share of pixels whose error exceeds 25 %.
    pub above_25_percent: f64,
}

/// A depth map of a file, row by row; 0 where the depth is unknown.
struct DepthMap {
    size: [usize; 2],
    depth: Vec<f32>,
}

impl DepthMap {
    /// Returns the depth at a pixel of an image of `size`, from the nearest pixel of the map.
    fn at(&self, [x, y]: [usize; 2], size: [usize; 2]) -> f32 {
        let nearest = |at: usize, side: usize, own: usize| (2 * at + 1) * own / (2 * side);
        let column = nearest(x, size[0], self.size[0]);
        let row = nearest(y, size[1], self.size[1]);
        self.depth[row * self.size[0] + column]
    }
}

/// Reads a depth map: the first channel of an EXR, or a 16-bit PNG times `unit`.
fn read(path: &Path, unit: f32) -> Result<DepthMap> {
    if path.extension().is_some_and(|ending| ending == "exr") {
        let (width, height, channels) = exr_image::read(path)?;
        let Some((_, depth)) = channels.into_iter().next() else {
            bail!("{}: the EXR has no channel", path.display());
        };
        let size = [width, height];
        return Ok(DepthMap { size, depth });
    }
    let image::DynamicImage::ImageLuma16(values) = image_io::load_any(path)? else {
        bail!(
            "{}: a depth map must be a grey PNG of 16 bits or an EXR",
            path.display()
        );
    };
    Ok(DepthMap {
        size: [values.width() as usize, values.height() as usize],
        depth: values.iter().map(|v| f32::from(*v) * unit).collect(),
    })
}

/// Returns the PNG and EXR files of a folder, sorted by name.
fn depth_files(folder: &Path) -> Result<Vec<PathBuf>> {
    let is_depth_map = |path: &PathBuf| {
        let ending = path.extension().and_then(|ending| ending.to_str());
        matches!(ending, Some("png" | "exr"))
    };
    let entries = std::fs::read_dir(folder).map_err(fastlgs_core::Error::io(folder))?;
    let paths = entries.flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = paths.filter(is_depth_map).collect();
    files.sort();
    if files.is_empty() {
        bail!("{}: there is no .png and no .exr file", folder.display());
    }
    Ok(files)
}

/// Measures the held-out views that have a depth map in `folder`. `unit` is the depth in world
/// units of one step of a PNG.
///
/// # Errors
/// A folder or file that cannot be read, or no map of a held-out view.
pub fn quality(scene: &mut Scene, folder: &Path, unit: f32) -> Result<DepthQuality> {
    let held_out = scene.manifest().held_out(scene.cameras());
    let world_scale = scene.manifest().frame.scale as f32;
    let mut views = 0;
    let mut errors = Vec::new();
    for path in depth_files(folder)? {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        let index = scene.folder().view_index(&held_out, &name);
        let Some(camera) = index.ok().map(|index| &held_out[index]) else {
            continue;
        };
        views += 1;
        let truth = read(&path, unit)?;
        let rendered = scene.render_depth(camera)?;
        let size = [camera.width as usize, camera.height as usize];
        for (pixel, depth) in rendered.iter().enumerate() {
            let known = truth.at([pixel % size[0], pixel / size[0]], size);
            if known > 0.0 && known.is_finite() {
                errors.push(f64::from((depth * world_scale - known).abs() / known));
            }
        }
    }
    if errors.is_empty() {
        bail!(
            "{}: no depth map belongs to a held-out view; its files must have the names of held-out photos",
            folder.display()
        );
    }
    Ok(summary(views, errors))
}

/// Computes the measures from the errors of all pixels.
fn summary(views: usize, mut errors: Vec<f64>) -> DepthQuality {
    errors.sort_by(f64::total_cmp);
    let pixels = errors.len();
    let share_above = |limit: f64| {
        let within = errors.partition_point(|error| *error <= limit);
        (pixels - within) as f64 / pixels as f64
    };
    let [above_5_percent, above_10_percent, above_25_percent] = LIMITS.map(share_above);
    DepthQuality {
        views,
        pixels,
        median_error: Some(errors[pixels / 2]).filter(|error| error.is_finite()),
        above_5_percent,
        above_10_percent,
        above_25_percent,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_measures_of_known_errors() {
        let errors = vec![0.2, 0.01, f64::INFINITY, 0.06, 0.03, 0.3, 0.0, 0.02];
        let quality = summary(1, errors);
        assert_eq!((quality.views, quality.pixels), (1, 8));
        assert_eq!(quality.median_error, Some(0.06));
        assert_eq!(quality.above_5_percent, 0.5);
        assert_eq!(quality.above_10_percent, 0.375);
        assert_eq!(quality.above_25_percent, 0.25);
        let empty = summary(1, vec![f64::INFINITY; 3]);
        assert_eq!((empty.median_error, empty.above_25_percent), (None, 1.0));
    }

    #[test]
    fn maps_of_another_size_and_format() {
        let folder = tempfile::tempdir().unwrap();
        let png = folder.path().join("a.png");
        let values = image::ImageBuffer::from_raw(2, 1, vec![1000u16, 0]).unwrap();
        image::DynamicImage::ImageLuma16(values).save(&png).unwrap();
        let map = read(&png, 0.001).unwrap();
        let row: Vec<f32> = (0..4).map(|x| map.at([x, 1], [4, 2])).collect();
        assert_eq!(row, [1.0, 1.0, 0.0, 0.0]);
        let exr = folder.path().join("b.exr");
        exr_image::write(&exr, 2, 1, &[("Z", &[1.5, 2.5])]).unwrap();
        assert_eq!(read(&exr, 9.0).unwrap().depth, [1.5, 2.5]);
        let grey = folder.path().join("c.png");
        image::GrayImage::new(2, 1).save(&grey).unwrap();
        let error = read(&grey, 1.0).err().unwrap().to_string();
        assert!(
            error.contains("c.png") && error.contains("16 bits"),
            "{error}"
        );
        assert_eq!(depth_files(folder.path()).unwrap().len(), 3);
    }
}
