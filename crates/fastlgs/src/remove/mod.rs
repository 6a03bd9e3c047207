//! A thing is taken out of a scene, and what lay behind it is put in its place (paper, applications: object removal with inpainting).
//!
//! What other photos saw past the thing is there once its Gaussians are gone. What no photo saw is filled in one view after the other, the
//! largest gap first: inverse depth is continued into the gap, colour by an inpainter, and each of its pixels becomes a Gaussian, which the next view sees.
//! So the filling is one surface and not one opinion a view.

mod behind;
mod folder;
mod membrane;

use crate::error::{Context, bail};
use crate::output::{SceneLock, resolved};
use crate::session::ask::Ask;
use crate::session::selection;
use crate::{Result, Run, Session, clear};
use fastlgs_core::{Camera, SceneFolder, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{Hit, QueryConfig};
use fastlgs_raster::Channels;
use fastlgs_vision::inpaint::{self, Inpainter};
use glam::Vec2;
use membrane::Membrane;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What is removed.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Config {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// What is removed, in words.
    #[cfg_attr(feature = "clap", arg(required_unless_present = "object"))]
    pub text: Option<String>,
    /// The object with this number instead; `query` tells numbers.
    #[cfg_attr(feature = "clap", arg(long, value_name = "ID", conflicts_with = "text"))]
    pub object: Option<u16>,
    /// Scene folder to write.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
    /// What colours places that no photo saw: membrane (the smoothest), opencv (Telea's), or an ONNX file like LaMa's.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME|FILE", default_value_t = Self::default().inpainter))]
    pub inpainter: String,
    /// CLIP's text tower, for scenes whose embeddings were imported, or when the file has moved.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        let inpainter = "membrane".to_owned();
        Self { scene: PathBuf::new(), text: None, object: None, output: PathBuf::new(), inpainter, clip_text: None }
    }
}

/// What was removed, and what took its place.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// The scene that it was in.
    pub scene: PathBuf,
    /// The scene without it.
    pub output: PathBuf,
    /// Numbers of the objects that were removed, in the first scene.
    pub objects: Vec<u16>,
    /// Gaussians that were removed.
    pub removed: usize,
    /// Gaussians that were made where no photo saw anything.
    pub filled: usize,
    /// Share of the thing's pixels, over all photos, behind which other photos saw something.
    pub seen: f64,
    /// Objects that are left.
    pub left: usize,
}

/// By how many pixels masks are widened: five times a window of 5x5 (paper).
const WIDENED: [u32; 2] = [10; 2];
/// Opacity of the Gaussians that fill a gap.
const SOLID: f32 = 0.95;
/// Their radius in distances of pixels: so wide, neighbours leave no gaps.
const RADIUS: f32 = 0.7;
/// Share of a view's pixels below which a gap is left alone.
const SMALL: f64 = 1e-5;
/// Transmittance from which nothing is where a pixel looks.
const EMPTY: f32 = 0.5;

/// Removes a thing from a scene; the result is a scene like any other, which does not know it.
///
/// # Errors
/// A text that names nothing in the scene, an object that it does not have, a folder that exists already, or a device that fails.
pub fn remove(config: &Config, run: &Run) -> Result<Report> {
    let (output, scene) = (resolved(&config.output)?, resolved(&config.scene)?);
    if output.starts_with(&scene) || scene.starts_with(&output) {
        bail!("{}: it lies in the scene itself; name a folder beside {}", config.output.display(), config.scene.display());
    }
    if SceneFolder::open(&config.output).is_ok() {
        bail!("{}: there is a scene already; name a folder that is not there yet", config.output.display());
    }
    let _lock = SceneLock::take(&config.output, "remove")?;
    let inpainter: Box<dyn Inpainter> =
        if config.inpainter == "membrane" { Box::new(Membrane) } else { inpaint::named(&config.inpainter).context("--inpainter")? };
    let mut session = Session::open(&config.scene, run.device)?;
    session.clip_text.clone_from(&config.clip_text);
    if session.cameras.iter().any(|camera| !session.folder.photo_path(&camera.name).is_file()) {
        bail!("{}: its photos are not there; remove the thing from the scene that was trained, not from an export", config.scene.display());
    }
    let grid = session.grid()?;
    let targets = targets(config, &mut session, &grid)?;
    let views = session.manifest.training(&session.cameras);
    let trained_on = |camera: &Camera| views.iter().any(|v| v.name == camera.name);
    let (mut hidden, mut shown) = (Vec::new(), Vec::new());
    for camera in session.cameras.clone() {
        let widened = |field: Field| metrics::dilate(&field.mask(&grid, &targets), camera.width, camera.height, WIDENED);
        let thing = widened(session.field(&camera, None)?);
        if trained_on(&camera) {
            // What is seen through the thing is not hidden by it.
            shown.push((camera.clone(), if session.trained.clear > 0 { widened(session.field_of_shown(&camera)?) } else { thing.clone() }));
        }
        hidden.push((camera, thing));
    }
    let objects: Vec<u16> = targets.iter().map(|t| t.id).collect();
    let mut stays = behind::seen(&session, &shown)?;
    // No photo shows what is clear.
    stays.iter_mut().enumerate().for_each(|(i, stays)| *stays |= clear::is_clear(&session.gaussians, i));
    selection::gaussians(&session.gaussians, &grid, &objects).into_iter().for_each(|i| stays[i] = false);
    let left: Vec<usize> = (0..stays.len()).filter(|i| stays[*i]).collect();
    if left.is_empty() {
        bail!("{}: nothing of the scene would be left", config.scene.display());
    }
    let removed = stays.len() - left.len();
    let rest = session.gaussians.select(&left);
    session.show(rest)?;

    let mut gaps = Vec::new();
    for (camera, hidden) in &shown {
        gaps.push(gap(&mut session, camera, hidden)?);
    }
    let count = |pixels: &mut dyn Iterator<Item = usize>| pixels.sum::<usize>() as f64;
    let seen = 1.0 - count(&mut gaps.iter().map(|g| set(g))) / count(&mut shown.iter().map(|s| set(&s.1))).max(1.0);
    let filled = fill(&mut session, &grid, &shown, &gaps, &*inpainter, run)?;

    let (left_over, ids) = grid.without(&objects);
    for id in &mut session.gaussians.object_ids {
        *id = ids.get(usize::from(*id)).copied().unwrap_or(0);
    }
    let what = config.text.clone().unwrap_or_else(|| format!("object {}", objects[0]));
    folder::write(&config.output, &mut session, &left_over, &hidden, &what)?;
    Ok(Report { scene: config.scene.clone(), output: config.output.clone(), objects, removed, filled, seen, left: left_over.objects.len() })
}

fn set(pixels: &[bool]) -> usize {
    pixels.iter().filter(|p| **p).count()
}

/// The objects that are meant.
fn targets(config: &Config, session: &mut Session, grid: &Grid) -> Result<Vec<Hit>> {
    let root = config.scene.display();
    if let Some(id) = config.object {
        if id == 0 || usize::from(id) > grid.objects.len() {
            bail!("{root}: it has objects 1 to {}, none is {id}", grid.objects.len());
        }
        return Ok(vec![Hit { id, score: 1.0 }]);
    }
    let text = config.text.clone().unwrap_or_default();
    let camera = session.cameras.first().cloned().with_context(|| format!("{root}: the scene has no views"))?;
    let field = session.field(&camera, None)?;
    let found = Ask::Text(text.clone()).meaning(session, &[])?.find(grid, &field, &camera, &QueryConfig::default())?;
    if found.targets.is_empty() {
        bail!("{root}: '{text}' is not found; name the object by its number with --object ('fastlgs query --point X,Y' tells it)");
    }
    Ok(found.targets)
}

/// Colours of what is there, without the background that shines through: at the rim of a gap that is up to half of the light.
fn solid_colors(session: &mut Session, camera: &Camera) -> Result<Vec<f32>> {
    let frame = session.render(camera)?;
    let behind = session.trained.background;
    let transmittance = frame.channels(6, 7);
    let solid = |c: usize| {
        let channel = frame.channels(c, c + 1).iter().zip(transmittance);
        channel.map(move |(color, t)| if *t < EMPTY { (color - t * behind[c]) / (1.0 - t) } else { *color })
    };
    Ok((0..3).flat_map(solid).collect())
}

/// The hidden pixels of a view where nothing is left.
fn gap(session: &mut Session, camera: &Camera, hidden: &[bool]) -> Result<Vec<bool>> {
    let frame = session.engine.render(session.view(camera), Channels::Color)?;
    Ok(hidden.iter().zip(frame.channels(6, 7)).map(|(hidden, transmittance)| *hidden && *transmittance > EMPTY).collect())
}

/// Makes Gaussians where nothing is left that was photographed, and adds them to the scene; returns how many.
fn fill(
    session: &mut Session,
    grid: &Grid,
    views: &[(Camera, Vec<bool>)],
    gaps: &[Vec<bool>],
    inpainter: &dyn Inpainter,
    run: &Run,
) -> Result<usize> {
    let before = session.gaussians.len();
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by_key(|k| std::cmp::Reverse(set(&gaps[*k])));
    let work = run.work("gaps", order.len() as u64);
    for (camera, hidden) in order.into_iter().map(|k| &views[k]) {
        work.advance()?;
        // What is left of it when others are filled.
        let gap = gap(session, camera, hidden)?;
        let (n, width) = (gap.len(), camera.width as usize);
        if set(&gap) as f64 <= SMALL * n as f64 || set(&gap) == n {
            continue;
        }
        let depth = session.render_depth(camera)?;
        let mut inverse: Vec<f32> = depth.iter().map(|depth| if depth.is_finite() { 1.0 / depth } else { 0.0 }).collect();
        Membrane::span(&mut inverse, &gap, width);
        let mut colors = solid_colors(session, camera)?;
        inpainter.fill(&mut colors, &gap, camera.width)?;
        let ids = membrane::continued(&session.field_of_shown(camera)?.ids(grid).labels, &gap, width);
        let to_world = camera.world_to_camera.inverse();
        let mut scene = session.gaussians.clone();
        for p in (0..n).filter(|p| gap[*p] && inverse[*p] > 0.0) {
            let depth = 1.0 / inverse[p];
            let pixel = Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
            let place = to_world.transform_point3(camera.ray(pixel) * depth);
            scene.push_sphere(place, RADIUS * depth / camera.fx, SOLID, std::array::from_fn(|c| colors[c * n + p].clamp(0.0, 1.0)));
            let last = scene.len() - 1;
            (scene.object_ids[last], scene.features[last]) = (ids[p], grid.code_of(ids[p]));
        }
        session.show(scene)?;
    }
    Ok(session.gaussians.len() - before)
}
