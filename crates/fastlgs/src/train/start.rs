//! What training starts from: first Gaussians, and the pictures that they shall show.

use super::config::{Background, Config};
use crate::error::bail;
use crate::{Result, Run};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, SceneFolder, image_io, ply};
use fastlgs_grid::Grid;
use fastlgs_raster::{Target, TargetImage, init, pack};
use std::path::PathBuf;

/// Fewest triangulated points from which training starts without random ones.
const FEW_POINTS: usize = 500;

/// The given PLY, else the scene's points, else random ones.
pub fn gaussians(config: &Config, folder: &SceneFolder, training: &[Camera], run: &Run) -> Result<Gaussians> {
    if let Some(path) = &config.init_ply {
        return Ok(ply::read(path)?);
    }
    let mut rng = Rng::new(run.seed, "init");
    let mut points = folder.points()?;
    if points.len() < FEW_POINTS {
        run.warn(&format!("only {} points are known; starting from random ones as well", points.len()));
        points.extend(init::random_points(training, 10_000, &mut rng));
    }
    // More points than half the budget would leave no room to grow where it matters.
    rng.shuffle(&mut points);
    points.truncate((config.budget().most() / 2).max(1));
    Ok(init::from_points(&points))
}

/// Photo and, where features are trained, code map of a view. Pixels that the view's mask blackens do not count, nor do
/// unlabelled ones in the feature loss; transparent ones show the background.
pub fn target(folder: &SceneFolder, camera: &Camera, codes: Option<&Grid>, background: &Background) -> Result<Target> {
    let photo = folder.photo(&camera.name)?;
    if (photo.width(), photo.height()) != (camera.width, camera.height) {
        bail!("{}: photo and camera differ in size; run 'fastlgs preprocess' again", folder.photo_path(&camera.name).display());
    }
    let mask = |path: PathBuf| path.is_file().then(|| image_io::load_gray(&path)).transpose();
    let (alpha, ignore) = (mask(folder.alpha_path(&camera.name))?, mask(folder.ignore_path(&camera.name))?);
    if alpha.is_some() && background.learn {
        bail!("--background learn: the photo of '{}' is transparent, so that its background must be given", camera.name);
    }
    let color = photo.enumerate_pixels().map(|(x, y, p)| {
        let covered = alpha.as_ref().map_or(255, |a| a.get_pixel(x, y)[0]);
        let over = |c: usize| {
            let share = f32::from(covered) / 255.0;
            (f32::from(p[c]) * share + 255.0 * background.color[c] * (1.0 - share) + 0.5) as u8
        };
        pack([over(0), over(1), over(2)], ignore.as_ref().is_none_or(|m| m.get_pixel(x, y)[0] >= 128))
    });
    let color = color.collect();
    let code = |grid: &Grid, id: u16| match grid.objects.get(usize::from(id).wrapping_sub(1)) {
        Some(object) => pack(object.code.to_array().map(|v| (v * 255.0).round() as u8), true),
        None => pack([0; 3], false),
    };
    let feature = match codes {
        None => Vec::new(),
        Some(grid) => folder.objects(&camera.name)?.labels.iter().map(|id| code(grid, *id)).collect(),
    };
    Ok(Target { camera: camera.clone(), image: TargetImage { size: [camera.width, camera.height], color, feature } })
}
