//! Renders images of a trained scene.

use crate::error::bail;
use crate::query::ViewChoice;
use crate::{Result, Run, Scene};
use fastlgs_core::{exr_image, image_io, normal_map, turbo};
use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Contents of a rendered image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum RenderContent {
    /// Colour, as PNG.
    Color,
    /// Expected depth in world units, as EXR.
    Depth,
    /// Normals of the rendered depth in camera axes (x right, y down, z forward), as PNG: 0 to 255
    /// for -1 to 1, and black where nothing is rendered.
    Normal,
    /// The three features, as EXR.
    Feature,
    /// Object ids as colours, as PNG.
    Objects,
}

/// Options of `render`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct RenderConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Cameras to render.
    #[serde(flatten)]
    #[cfg_attr(feature = "clap", command(flatten))]
    pub views: ViewChoice,
    /// Contents of the images, separated by commas.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_enum, default_value = "color", value_delimiter = ',')
    )]
    pub what: Vec<RenderContent>,
    /// Output folder.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
}

impl Default for RenderConfig {
    fn default() -> Self {
        Self {
            scene: PathBuf::new(),
            views: ViewChoice::default(),
            what: vec![RenderContent::Color],
            output: PathBuf::new(),
        }
    }
}

/// Report of `render`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RenderReport {
    /// Scene folder.
    pub scene: PathBuf,
    /// Files of the images.
    pub files: Vec<PathBuf>,
    /// Size of the first image, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Milliseconds to render all contents of each view.
    pub render_ms: Vec<f64>,
    /// Name of the device.
    pub adapter: String,
}

/// Runs `work`, and adds its duration to `total`.
fn timed<T>(total: &mut Duration, work: impl FnOnce() -> T) -> T {
    let started = Instant::now();
    let out = work();
    *total += started.elapsed();
    out
}

/// Renders views of a trained scene, and writes them as images.
///
/// # Errors
/// A scene that is not trained, an unknown view, a device that fails, or a file that cannot be
/// written.
pub fn render(config: &RenderConfig, run: &Run) -> Result<RenderReport> {
    let mut scene = Scene::open(&config.scene, run.device)?;
    let cameras = config.views.cameras(scene.folder(), scene.cameras())?;
    let Some(first) = cameras.first() else {
        bail!("{}: the scene has no views", config.scene.display())
    };
    let size = format!("{}x{}", first.width, first.height);
    let work = run.work("render", cameras.len() as u64);
    let (mut files, mut milliseconds) = (Vec::new(), Vec::new());
    for camera in &cameras {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut rendered = Duration::ZERO;
        let mut path = |what: &str, ending: &str| {
            let name = format!("{}.{what}.{ending}", camera.name);
            let path = config.output.join(name);
            files.push(path.clone());
            path
        };
        if config.what.contains(&RenderContent::Color) {
            let frame = timed(&mut rendered, || scene.render(camera))?;
            let picture = image_io::from_planar(frame.color(), frame.width, frame.height);
            image_io::save_png(&path("color", "png"), picture)?;
        }
        if config.what.contains(&RenderContent::Feature) {
            let frame = timed(&mut rendered, || scene.render_feature(camera))?;
            let channels = [
                ("feature.0", frame.channels(3, 4)),
                ("feature.1", frame.channels(4, 5)),
                ("feature.2", frame.channels(5, 6)),
            ];
            exr_image::write(&path("feature", "exr"), w, h, &channels)?;
        }
        let uses_depth = [RenderContent::Depth, RenderContent::Normal];
        if uses_depth.iter().any(|what| config.what.contains(what)) {
            let mut depth = timed(&mut rendered, || scene.render_depth(camera))?;
            if config.what.contains(&RenderContent::Normal) {
                let normals = normal_map::normals(camera, &depth);
                let color = |x, y| Rgb(normal_map::color(normals[y as usize * w + x as usize]));
                let picture = RgbImage::from_fn(camera.width, camera.height, color);
                image_io::save_png(&path("normal", "png"), picture)?;
            }
            if config.what.contains(&RenderContent::Depth) {
                let unit = scene.manifest().frame.scale as f32;
                depth.iter_mut().for_each(|depth| *depth *= unit);
                exr_image::write(&path("depth", "exr"), w, h, &[("Z", &depth)])?;
            }
        }
        if config.what.contains(&RenderContent::Objects) {
            let ids = timed(&mut rendered, || scene.field(camera, None))?.owners(&*scene.grid()?);
            let color = |x, y| Rgb(turbo::id_color(ids.at(x, y)));
            let picture = RgbImage::from_fn(camera.width, camera.height, color);
            image_io::save_png(&path("objects", "png"), picture)?;
        }
        milliseconds.push(rendered.as_secs_f64() * 1e3);
        work.advance()?;
    }
    Ok(RenderReport {
        scene: config.scene.clone(),
        files,
        size,
        gaussians: scene.gaussians().len(),
        render_ms: milliseconds,
        adapter: scene.adapter(),
    })
}
