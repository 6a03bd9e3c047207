//! What training starts from: first Gaussians, and the pictures that they shall show.

use super::config::{Background, Config};
use super::report::Report;
use crate::error::bail;
use crate::{Result, Run};
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, WorldFrame, image_io, splat_file};
use fastlgs_grid::Grid;
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, FEW_VIEWS, FreeSpace, Target, TargetImage, Targets, View, init, pack};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What training starts from; where less is known, random points make up for the rest.
const ENOUGH: usize = 5000;

/// The given PLY, else the scene's points: with a backdrop where photos are few, and random ones where all these are too few.
pub fn gaussians(config: &Config, folder: &SceneFolder, views: &Targets, run: &Run) -> Result<Gaussians> {
    if let Some(path) = &config.init {
        // The scene's own file is in its own coordinates.
        let frame = if is_own(folder, path) { WorldFrame::default() } else { folder.manifest()?.frame };
        let (first, warning) = splat_file::read(path, &frame)?;
        warning.into_iter().for_each(|warning| run.warn(&warning));
        return if is_own(folder, path) { Ok(first) } else { with_axes_of_photos(first, path, views, config, run) };
    }
    let mut rng = Rng::new(run.seed, "init");
    let mut points = folder.points()?;
    // More than half the budget would leave no room to grow where it matters.
    let most = (config.budget(views.pixels()).most() / 2).max(1);
    // There is nothing behind what was cut out.
    let cut_out = views.cameras.iter().any(|camera| folder.alpha_path(&camera.name).is_file());
    let behind = if views.len() < FEW_VIEWS && !cut_out { init::backdrop(views, &points, most / 2)? } else { Gaussians::default() };
    let missing = ENOUGH.saturating_sub(points.len() + behind.len());
    if missing > 0 {
        run.warn(&format!("only {} points are known; training starts from {missing} random ones as well", points.len()));
        points.extend(init::random_points(views, missing, &mut rng)?);
    }
    rng.shuffle(&mut points);
    points.truncate(most - behind.len());
    let mut first = init::from_points(&points);
    first.append(behind);
    Ok(first)
}

/// Training views by which the axes of a file of another program are checked.
const CHECKED_VIEWS: usize = 4;
/// How many times smaller the squared error must be with turned axes.
const PLAIN: f64 = 2.0;

/// Gaussians of another program, in the axes of the photos' poses: some programs write y and z with the other sign, and the photos tell.
fn with_axes_of_photos(first: Gaussians, path: &Path, views: &Targets, config: &Config, run: &Run) -> Result<Gaussians> {
    let background = config.background.unwrap_or_default();
    let mut engine = fastlgs_raster::open_engine("cpu")?;
    let mut error = |scene: &Gaussians| -> Result<f64> {
        engine.set_state(&State::of(scene))?;
        let mut sum = 0.0;
        for id in (0..views.len()).step_by(views.len().div_ceil(CHECKED_VIEWS).max(1)) {
            let Target { camera, image, .. } = views.get(id)?;
            let mut view = View::new(&camera, scene.len(), scene.sh_degree);
            view.background_color[..3].copy_from_slice(&background.color);
            let frame = engine.render(view, Channels::Color)?;
            let n = image.color.len();
            let pixels = image.color.iter().enumerate().map(|(p, pixel)| (p, pixel.to_le_bytes())).filter(|(_, pixel)| pixel[3] == 255);
            let difference = |(p, pixel): (usize, [u8; 4])| {
                let shown = |c: usize| f64::from(frame.channels(0, 3)[c * n + p].clamp(0.0, 1.0)) - f64::from(pixel[c]) / 255.0;
                (0..3).map(|c| shown(c).powi(2)).sum::<f64>()
            };
            sum += pixels.map(difference).sum::<f64>();
        }
        Ok(sum)
    };
    let turned = first.clone().with_y_and_z_flipped();
    if error(&turned)? * PLAIN < error(&first)? {
        run.warn(&format!("{}: its y and z have the other sign than those of the photos' poses; they were turned", path.display()));
        return Ok(turned);
    }
    Ok(first)
}

/// Whether a file is the scene's own.
fn is_own(folder: &SceneFolder, path: &Path) -> bool {
    let place = |path: &Path| path.canonicalize().ok();
    place(path).is_some_and(|path| Some(path) == place(&folder.ply_path()))
}

/// The options, with what the scene's own Gaussians were trained with where training starts from these and nothing else was asked for.
pub fn as_before(config: &Config, folder: &SceneFolder, manifest: &Manifest) -> Result<Config> {
    let own = config.init.as_ref().filter(|path| is_own(folder, path));
    let earlier = if own.is_some() { Report::of(manifest, &folder.root)?.unwrap_or_default() } else { Report::default() };
    let background = config.background.unwrap_or(Background { color: earlier.background, learn: false });
    Ok(Config { background: Some(background), antialias: config.antialias || earlier.antialias, ..config.clone() })
}

/// What the views of `cameras` look through, where density control asks for it.
pub fn free_space(config: &Config, folder: &SceneFolder, cameras: &[Camera], first: &Gaussians) -> Result<FreeSpace> {
    if cameras.len() >= FEW_VIEWS || config.iterations() == 0 {
        return Ok(FreeSpace::default());
    }
    Ok(FreeSpace::of(cameras, &first.means, &folder.points()?))
}

/// The code of each id that object maps show, 0 included, as pictures have it.
type Codes = Arc<Vec<[u8; 3]>>;

/// The codes that views are trained towards.
pub fn codes(grid: &Grid) -> Codes {
    Arc::new((0..=grid.highest()).map(|id| grid.code_of(id).to_array().map(|v| (v * 255.0).round() as u8)).collect())
}

/// The views of `cameras` as they are trained towards; `gain` tells how bright each photo is against the mean.
pub fn targets(
    folder: &SceneFolder,
    cameras: &[Camera],
    codes: Option<&Codes>,
    background: &Background,
    gain: impl Fn(&str) -> [f32; 3],
) -> Targets {
    let gains = cameras.iter().map(|c| gain(&c.name)).collect();
    let (folder, views, codes, background) = (folder.clone(), cameras.to_vec(), codes.cloned(), *background);
    let read = move |id: usize| target(&folder, &views[id], codes.as_ref(), &background).map(|target| target.image);
    Targets::new(cameras.to_vec(), gains, move |id| read(id).map_err(|error| fastlgs_raster::Error::Picture(Box::new(error))))
}

/// Photo and, where features are trained, code map of a view. Pixels that the view's mask blackens do not count;
/// transparent ones show the background.
pub fn target(folder: &SceneFolder, camera: &Camera, codes: Option<&Codes>, background: &Background) -> Result<Target> {
    let photo = folder.photo(&camera.name)?;
    if (photo.width(), photo.height()) != (camera.width, camera.height) {
        bail!("{}: photo and camera differ in size; run 'fastlgs preprocess' again", folder.photo_path(&camera.name).display());
    }
    let mask = |path: PathBuf| path.is_file().then(|| image_io::load_gray(&path)).transpose();
    let (alpha, ignore) = (mask(folder.alpha_path(&camera.name))?, mask(folder.ignore_path(&camera.name))?);
    if alpha.is_some() && background.learn {
        bail!("--background learn: the photo of '{}' is transparent, so that its background must be given", camera.name);
    }
    let counts = |x: u32, y: u32| ignore.as_ref().is_none_or(|m| m.get_pixel(x, y)[0] >= 128);
    let color = photo.enumerate_pixels().map(|(x, y, p)| {
        let covered = alpha.as_ref().map_or(255, |a| a.get_pixel(x, y)[0]);
        let over = |c: usize| {
            let share = f32::from(covered) / 255.0;
            (f32::from(p[c]) * share + 255.0 * background.color[c] * (1.0 - share) + 0.5) as u8
        };
        pack([over(0), over(1), over(2)], counts(x, y))
    });
    let color = color.collect();
    // What no mask covers is trained towards nothing.
    let code = |codes: &Codes, id: u16| codes.get(usize::from(id)).copied().unwrap_or_default();
    let feature = match codes {
        None => Vec::new(),
        Some(codes) => {
            let map = folder.objects(&camera.name)?;
            let pixels = (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y)));
            pixels.map(|(x, y)| pack(code(codes, map.at(x, y)), counts(x, y))).collect()
        }
    };
    Ok(Target { camera: camera.clone(), image: TargetImage { size: [camera.width, camera.height], color, feature }, gain: [1.0; 3] })
}
