//! Inputs of training: initial Gaussians and target images.

use super::config::{Background, TrainConfig};
use super::report::TrainReport;
use super::texture;
use crate::error::bail;
use crate::masks;
use crate::{Result, Run, SceneNotes};
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, WorldFrame, image_io, splat_file};
use fastlgs_grid::Grid;
use fastlgs_raster::density::State;
use fastlgs_raster::{
    Channels, FEW_VIEWS, FreeSpace, Target, TargetImage, Targets, View, init, pack,
};
use fastlgs_sfm::depth_map::DepthMap;
use fastlgs_sfm::surfaces::Surfaces;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Least number of initial Gaussians. Random points are added if there are fewer.
const MIN_INITIAL_GAUSSIANS: usize = 5000;
/// Least share of the photos without texture from which surfaces are used. In a room with white
/// walls it is 0.5; photos of things are from 0 to 0.3, and surfaces lower their PSNR.
const MIN_BARE_SHARE: f32 = 0.4;

/// Returns the initial Gaussians: those of `config.init`, else one for each point of the scene. A
/// backdrop is added if there are fewer than [`FEW_VIEWS`] views, and random points if there are
/// fewer than [`MIN_INITIAL_GAUSSIANS`].
pub fn gaussians(
    config: &TrainConfig,
    folder: &SceneFolder,
    views: &Targets,
    surfaces: Option<&Surfaces>,
    run: &Run,
) -> Result<Gaussians> {
    if let Some(path) = &config.init {
        // The scene's own file is already in the scene's frame.
        let frame = if is_scene_ply(folder, path) {
            WorldFrame::default()
        } else {
            folder.manifest()?.frame
        };
        let (first, warning) = splat_file::read(path, &frame)?;
        warning.into_iter().for_each(|warning| run.warn(&warning));
        return if is_scene_ply(folder, path) {
            Ok(first)
        } else {
            with_matching_axes(first, path, views, config, run)
        };
    }
    let mut rng = Rng::new(run.seed, "init");
    let mut points = folder.points()?;
    if let Some(surfaces) = surfaces {
        points.extend(surface_points(surfaces, views)?);
    }
    // Start with at most half of the budget, so that density control can add Gaussians.
    let most = (config.budget(views.pixels()).max_gaussians() / 2).max(1);
    // Photos with an alpha channel show a cut-out object, which needs no backdrop.
    let cut_out = views
        .cameras
        .iter()
        .any(|camera| folder.alpha_path(&camera.name).is_file());
    let backdrop = if views.len() < FEW_VIEWS && config.treats_weak_photos() && !cut_out {
        init::backdrop(views, &points, most / 2)?
    } else {
        Gaussians::default()
    };
    let missing = MIN_INITIAL_GAUSSIANS.saturating_sub(points.len() + backdrop.len());
    if missing > 0 {
        run.warn(&format!(
            "the scene has only {} points; training starts from {missing} random ones in addition",
            points.len()
        ));
        points.extend(init::random_points(views, missing, &mut rng)?);
    }
    rng.shuffle(&mut points);
    points.truncate(most - backdrop.len());
    let mut first = init::from_points(&points);
    first.append(backdrop);
    Ok(first)
}

/// Returns the surfaces of the training views: planes through the points that their masks show.
/// `None` if the photos have enough texture, if they are few, or if training starts from the
/// Gaussians of a file.
pub fn surfaces(
    config: &TrainConfig,
    folder: &SceneFolder,
    targets: &Targets,
) -> Result<Option<Surfaces>> {
    let is_off = !config.treats_weak_photos() || config.depth_weight <= 0.0;
    let starts_from_points = config.init.is_none() && config.iterations() > 0;
    let is_few = targets.len() < FEW_VIEWS;
    if is_off || !starts_from_points || is_few || texture::bare_share(targets)? < MIN_BARE_SHARE {
        return Ok(None);
    }
    let (cameras, points) = (&targets.cameras, folder.points()?);
    let masks = |view: usize| masks::whole_masks(folder, &cameras[view]);
    Surfaces::new(cameras, &points, masks).map(Some)
}

/// Returns points on surfaces where no point is known, with the colours of the photos.
fn surface_points(surfaces: &Surfaces, views: &Targets) -> Result<Vec<SfmPoint>> {
    let images = (0..views.len()).map(|id| views.get(id).map(|target| target.image));
    let images: Vec<TargetImage> = images.collect::<Result<_, _>>()?;
    Ok(surfaces.new_points(|view, place| {
        let image = &images[view];
        let [x, y] = [place.x, place.y];
        let [width, height] = image.size;
        let (x, y) = ((x * width as f32) as u32, (y * height as f32) as u32);
        let [r, g, b, _] = image.color[(y * width + x) as usize].to_le_bytes();
        [r, g, b]
    }))
}

/// Returns the targets with the depths of surfaces, one map for each view. The depth loss ignores the
/// pixels that the colour loss ignores.
pub fn with_depths(targets: Targets, maps: Vec<DepthMap>) -> Targets {
    targets.with_depths(move |id, image| {
        let mut depth = maps[id].resized(image.size[0], image.size[1]);
        let ignored = image
            .color
            .iter()
            .map(|pixel| pixel.to_le_bytes()[3] != 255);
        depth
            .iter_mut()
            .zip(ignored)
            .filter(|(_, ignored)| *ignored)
            .for_each(|(depth, _)| *depth = NO_DEPTH_LOSS);
        depth
    })
}

/// Depth of pixels that the depth loss ignores.
const NO_DEPTH_LOSS: f32 = -1.0;

/// Number of training views that decide whether the axes of an imported file are flipped.
const CHECKED_VIEWS: usize = 4;
/// Factor by which flipped axes must lower the squared error.
const MIN_ERROR_RATIO: f64 = 2.0;

/// Flips y and z of Gaussians of another program if the photos then fit clearly better. Some
/// programs write y and z with the opposite sign.
fn with_matching_axes(
    first: Gaussians,
    path: &Path,
    views: &Targets,
    config: &TrainConfig,
    run: &Run,
) -> Result<Gaussians> {
    let background = config.background.unwrap_or_default();
    let mut engine = fastlgs_raster::open_engine("cpu")?;
    let mut error = |scene: &Gaussians| -> Result<f64> {
        engine.set_state(&State::of(scene))?;
        let mut sum = 0.0;
        for id in (0..views.len()).step_by(views.len().div_ceil(CHECKED_VIEWS).max(1)) {
            let Target { camera, image, .. } = views.get(id)?;
            let view =
                View::new(&camera, scene.len(), scene.sh_degree).with_background(background.color);
            let frame = engine.render(view, Channels::Color)?;
            let n = image.color.len();
            let pixels = image
                .color
                .iter()
                .enumerate()
                .map(|(p, pixel)| (p, pixel.to_le_bytes()))
                .filter(|(_, pixel)| pixel[3] == 255);
            let difference = |(p, pixel): (usize, [u8; 4])| {
                let shown = |c: usize| {
                    f64::from(frame.color()[c * n + p].clamp(0.0, 1.0))
                        - f64::from(pixel[c]) / 255.0
                };
                (0..3).map(|c| shown(c).powi(2)).sum::<f64>()
            };
            sum += pixels.map(difference).sum::<f64>();
        }
        Ok(sum)
    };
    let flipped = first.clone().with_y_and_z_flipped();
    if error(&flipped)? * MIN_ERROR_RATIO < error(&first)? {
        run.warn(&format!("{}: y and z have the opposite sign of those of the photos' poses; the Gaussians were flipped", path.display()));
        return Ok(flipped);
    }
    Ok(first)
}

/// Returns whether `path` is the `scene.ply` of this scene.
fn is_scene_ply(folder: &SceneFolder, path: &Path) -> bool {
    let place = |path: &Path| path.canonicalize().ok();
    place(path).is_some_and(|path| Some(path) == place(&folder.ply_path()))
}

/// Returns the options with background and filter set. If training starts from the scene's own
/// Gaussians, those of their training are the defaults.
pub fn with_earlier_settings(
    config: &TrainConfig,
    folder: &SceneFolder,
    manifest: &Manifest,
) -> Result<TrainConfig> {
    let own = config
        .init
        .as_ref()
        .filter(|path| is_scene_ply(folder, path));
    let earlier = if own.is_some() {
        SceneNotes::read(manifest, &folder.root)?
            .train
            .unwrap_or_default()
    } else {
        TrainReport::default()
    };
    let background = config.background.unwrap_or(Background {
        color: earlier.background,
        learn: false,
    });
    Ok(TrainConfig {
        background: Some(background),
        antialias: config.antialias || earlier.antialias,
        ..config.clone()
    })
}

/// Returns the space that the views show to be empty, in which density control removes floaters.
/// With [`FEW_VIEWS`] or more views, that is the space before `surfaces`. Without iterations,
/// nothing is known to be empty.
pub fn free_space(
    config: &TrainConfig,
    folder: &SceneFolder,
    cameras: &[Camera],
    first: &Gaussians,
    surfaces: Option<&Surfaces>,
) -> Result<FreeSpace> {
    let few = cameras.len() < FEW_VIEWS && config.treats_weak_photos();
    if few && config.iterations() > 0 {
        return Ok(FreeSpace::of(cameras, &first.means, &folder.points()?));
    }
    let maps = surfaces.iter().flat_map(|surfaces| &surfaces.maps);
    let maps = maps.map(|map| (&map.camera, map.depth.as_slice()));
    Ok(FreeSpace::before_surfaces(maps))
}

/// Code of each object id, 0 included, as 8-bit RGB.
type Codes = Arc<Vec<[u8; 3]>>;

/// Returns the codes of all objects as 8-bit RGB.
pub fn codes(grid: &Grid) -> Codes {
    Arc::new(
        (0..=grid.highest())
            .map(|id| {
                grid.code_of(id)
                    .to_array()
                    .map(|v| (v * 255.0).round() as u8)
            })
            .collect(),
    )
}

/// Returns the targets of `cameras`, whose images are read on demand. `gain` returns the brightness
/// of a photo relative to the mean, by channel.
pub fn targets(
    folder: &SceneFolder,
    cameras: &[Camera],
    codes: Option<&Codes>,
    background: &Background,
    gain: impl Fn(&str) -> [f32; 3],
) -> Targets {
    let gains = cameras.iter().map(|c| gain(&c.name)).collect();
    let (folder, views, codes, background) = (
        folder.clone(),
        cameras.to_vec(),
        codes.cloned(),
        *background,
    );
    let read = move |id: usize| {
        target(&folder, &views[id], codes.as_ref(), &background).map(|target| target.image)
    };
    Targets::new(cameras.to_vec(), gains, move |id| {
        read(id).map_err(|error| fastlgs_raster::Error::Picture(Box::new(error)))
    })
}

/// Loads the target image of a view: the photo and, with `codes`, the code map. Ignored pixels are
/// packed as pixels that do not count. Transparent pixels show the background.
///
/// # Errors
/// A file that cannot be read, a photo whose size differs from its camera, or a transparent photo
/// with a learned background.
pub fn target(
    folder: &SceneFolder,
    camera: &Camera,
    codes: Option<&Codes>,
    background: &Background,
) -> Result<Target> {
    let photo = folder.photo(&camera.name)?;
    if (photo.width(), photo.height()) != (camera.width, camera.height) {
        bail!(
            "{}: photo and camera differ in size; run 'fastlgs preprocess' again",
            folder.photo_path(&camera.name).display()
        );
    }
    let mask = |path: PathBuf| {
        path.is_file()
            .then(|| image_io::load_gray(&path))
            .transpose()
    };
    let (alpha, ignore) = (
        mask(folder.alpha_path(&camera.name))?,
        mask(folder.ignore_path(&camera.name))?,
    );
    if alpha.is_some() && background.learn {
        bail!(
            "the background cannot be learned, because the photo of '{}' is partly transparent; set background to a colour",
            camera.name
        );
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
    // Pixels without an object are trained towards the origin.
    let code = |codes: &Codes, id: u16| codes.get(usize::from(id)).copied().unwrap_or_default();
    let feature = match codes {
        None => Vec::new(),
        Some(codes) => {
            let map = folder.objects(&camera.name)?;
            let pixels = (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y)));
            pixels
                .map(|(x, y)| pack(code(codes, map.at(x, y)), counts(x, y)))
                .collect()
        }
    };
    Ok(Target {
        camera: camera.clone(),
        image: TargetImage {
            size: [camera.width, camera.height],
            color,
            feature,
            depth: Vec::new(),
        },
        gain: [1.0; 3],
    })
}
