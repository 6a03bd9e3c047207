//! Removes an object from a scene, and fills the gaps behind it (paper, object removal with
//! inpainting).
//!
//! Where other photos show the surface behind the object, it appears once the Gaussians of the
//! object are gone. Gaps that no photo shows are filled view by view, the largest gap first.
//! Inverse depth is continued into the gap, and an inpainter computes its colours. Each pixel of
//! the gap becomes a Gaussian, which later views contain, so that all views agree on one surface.

mod behind;
mod folder;
mod membrane;

use crate::error::{Context, bail};
use crate::output::{SceneLock, resolve_path};
use crate::query::object_query::ObjectQuery;
use crate::query::selection;
use crate::{Result, Run, Scene, transparent};
use fastlgs_core::{Camera, SceneFolder, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{Hit, QueryConfig};
use fastlgs_vision::inpaint::{self, Inpainter};
use glam::Vec2;
use membrane::Membrane;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Options of a removal.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct RemoveConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Text that names the object to remove.
    #[cfg_attr(feature = "clap", arg(required_unless_present = "object"))]
    pub text: Option<String>,
    /// Id of the object to remove, instead of a text; `query` reports ids.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "ID", conflicts_with = "text")
    )]
    pub object: Option<u16>,
    /// Scene folder to write.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
    /// Inpainter for regions that no photo shows: membrane (smoothest), opencv (Telea), or an ONNX
    /// file such as LaMa.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME|FILE", default_value_t = Self::default().inpainter))]
    pub inpainter: String,
    /// CLIP text tower, for scenes with imported embeddings, or if its file has moved.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
}

impl Default for RemoveConfig {
    fn default() -> Self {
        let inpainter = "membrane".to_owned();
        Self {
            scene: PathBuf::new(),
            text: None,
            object: None,
            output: PathBuf::new(),
            inpainter,
            clip_text: None,
        }
    }
}

/// Report of a removal.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RemoveReport {
    /// Folder of the original scene.
    pub scene: PathBuf,
    /// Folder of the new scene.
    pub output: PathBuf,
    /// Ids of the removed objects in the original scene.
    pub objects: Vec<u16>,
    /// Number of Gaussians that were removed.
    pub removed: usize,
    /// Number of Gaussians that were added in gaps.
    pub filled: usize,
    /// Share of the hidden pixels of all training photos behind which other photos show a surface.
    pub seen: f64,
    /// Number of remaining objects.
    pub left: usize,
}

/// Dilation of masks in x and y, in pixels: five times a window of 5x5 (paper).
const MASK_DILATION: [u32; 2] = [10; 2];
/// Opacity of the Gaussians that fill a gap.
const FILL_OPACITY: f32 = 0.95;
/// Radius of these Gaussians in pixel spacings at their depth: wide enough to close the space
/// between neighbours.
const FILL_RADIUS: f32 = 0.7;
/// Share of the pixels of a view up to which a gap is not filled.
const MIN_GAP_SHARE: f64 = 1e-5;
/// Transmittance above which a pixel is empty.
const EMPTY_TRANSMITTANCE: f32 = 0.5;

/// Removes the objects that `config` names, fills the gaps, and writes a new scene.
///
/// # Errors
/// A text or id without an object, an output folder that holds a scene, photos that are missing, or
/// a device that fails.
pub fn remove(config: &RemoveConfig, run: &Run) -> Result<RemoveReport> {
    let (output, scene) = (resolve_path(&config.output)?, resolve_path(&config.scene)?);
    if output.starts_with(&scene) || scene.starts_with(&output) {
        bail!(
            "{}: the output folder and the scene must not contain each other; choose a folder beside {}",
            config.output.display(),
            config.scene.display()
        );
    }
    if SceneFolder::open(&config.output).is_ok() {
        bail!(
            "{}: this folder already holds a scene; choose a folder that does not exist yet",
            config.output.display()
        );
    }
    let _lock = SceneLock::take(&config.output, "remove")?;
    let inpainter: Box<dyn Inpainter> = if config.inpainter == "membrane" {
        Box::new(Membrane)
    } else {
        inpaint::by_name(&config.inpainter).context("the inpainter cannot be opened")?
    };
    let mut session = Scene::open(&config.scene, run.device)?;
    session.set_clip_text(config.clip_text.clone());
    if session
        .cameras()
        .iter()
        .any(|camera| !session.folder().photo_path(&camera.name).is_file())
    {
        bail!(
            "{}: its prepared photos are not there; remove the object from the trained scene, not from an export",
            config.scene.display()
        );
    }
    let grid = session.grid()?;
    let targets = targets(config, &mut session, &grid)?;
    let views = session.manifest().training(session.cameras());
    let trained_on = |camera: &Camera| views.iter().any(|v| v.name == camera.name);
    let (mut hidden, mut hidden_in_training) = (Vec::new(), Vec::new());
    for camera in session.cameras().to_vec() {
        let widened = |field: &Field| {
            metrics::dilate(
                &field.mask(&grid, &targets),
                camera.width,
                camera.height,
                MASK_DILATION,
            )
        };
        let thing = widened(&*session.field(&camera, None)?);
        if trained_on(&camera) {
            // A transparent object does not hide the surface behind it.
            hidden_in_training.push((
                camera.clone(),
                if session.trained().clear > 0 {
                    widened(&session.field_without_transparent(&camera)?)
                } else {
                    thing.clone()
                },
            ));
        }
        hidden.push((camera, thing));
    }
    let objects: Vec<u16> = targets.iter().map(|t| t.id).collect();
    let mut remains = behind::remaining_gaussians(&session, &hidden_in_training)?;
    // Photos do not show transparent Gaussians, so all of them remain, except those of the removed
    // objects.
    remains
        .iter_mut()
        .enumerate()
        .for_each(|(i, stays)| *stays |= transparent::is_clear(session.gaussians(), i));
    selection::gaussians(session.gaussians(), &grid, &objects)
        .into_iter()
        .for_each(|i| remains[i] = false);
    let left: Vec<usize> = (0..remains.len()).filter(|i| remains[*i]).collect();
    if left.is_empty() {
        bail!(
            "{}: no Gaussians of the scene would remain; choose a smaller object",
            config.scene.display()
        );
    }
    let removed = remains.len() - left.len();
    let rest = session.gaussians().select(&left);
    session.set_gaussians(rest)?;

    let mut gaps = Vec::new();
    for (camera, hidden) in &hidden_in_training {
        gaps.push(gap(&mut session, camera, hidden)?);
    }
    let count = |pixels: &mut dyn Iterator<Item = usize>| pixels.sum::<usize>() as f64;
    let seen = 1.0
        - count(&mut gaps.iter().map(|g| count_set(g)))
            / count(&mut hidden_in_training.iter().map(|s| count_set(&s.1))).max(1.0);
    let filled = fill(
        &mut session,
        &grid,
        &hidden_in_training,
        &gaps,
        &*inpainter,
        run,
    )?;

    let (left_over, ids) = grid.without(&objects);
    let renumbered = |id: &u16| ids.get(usize::from(*id)).copied().unwrap_or(0);
    session.set_object_ids(
        session
            .gaussians()
            .object_ids
            .iter()
            .map(renumbered)
            .collect(),
    );
    let what = config
        .text
        .clone()
        .unwrap_or_else(|| format!("object {}", objects[0]));
    folder::write(&config.output, &mut session, &left_over, &hidden, &what)?;
    Ok(RemoveReport {
        scene: config.scene.clone(),
        output: config.output.clone(),
        objects,
        removed,
        filled,
        seen,
        left: left_over.objects.len(),
    })
}

fn count_set(pixels: &[bool]) -> usize {
    pixels.iter().filter(|p| **p).count()
}

/// Returns the objects that `config` names.
///
/// # Errors
/// There is no such object.
fn targets(config: &RemoveConfig, session: &mut Scene, grid: &Grid) -> Result<Vec<Hit>> {
    let root = config.scene.display();
    if let Some(id) = config.object {
        if id == 0 || usize::from(id) > grid.objects.len() {
            bail!(
                "{root}: its object ids are 1 to {}, and none is {id}; choose one of them",
                grid.objects.len()
            );
        }
        return Ok(vec![Hit { id, score: 1.0 }]);
    }
    let text = config.text.clone().unwrap_or_default();
    let camera = session
        .cameras()
        .first()
        .cloned()
        .with_context(|| format!("{root}: the scene has no views"))?;
    let field = session.field(&camera, None)?;
    let found = ObjectQuery::Text(text.clone()).embed(session, &[])?.find(
        grid,
        &field,
        &camera,
        &QueryConfig::default(),
    )?;
    if found.targets.is_empty() {
        bail!(
            "{root}: '{text}' is not found; name the object by its id with --object ('fastlgs query --point X,Y' reports ids)"
        );
    }
    Ok(found.targets)
}

/// Renders colours without the share of the background, `[3][h][w]`. At the border of a gap, this
/// share is up to half of the light.
fn solid_colors(session: &mut Scene, camera: &Camera) -> Result<Vec<f32>> {
    let frame = session.render(camera)?;
    let behind = session.trained().background;
    let transmittance = frame.transmittance();
    let solid = |c: usize| {
        let channel = frame.channels(c, c + 1).iter().zip(transmittance);
        channel.map(move |(color, t)| {
            if *t < EMPTY_TRANSMITTANCE {
                (color - t * behind[c]) / (1.0 - t)
            } else {
                *color
            }
        })
    };
    Ok((0..3).flat_map(solid).collect())
}

/// Returns the hidden pixels of a view that are empty.
fn gap(session: &mut Scene, camera: &Camera, hidden: &[bool]) -> Result<Vec<bool>> {
    let frame = session.render(camera)?;
    Ok(hidden
        .iter()
        .zip(frame.transmittance())
        .map(|(hidden, transmittance)| *hidden && *transmittance > EMPTY_TRANSMITTANCE)
        .collect())
}

/// Fills the gaps of all views with Gaussians, and returns their number.
fn fill(
    session: &mut Scene,
    grid: &Grid,
    views: &[(Camera, Vec<bool>)],
    gaps: &[Vec<bool>],
    inpainter: &dyn Inpainter,
    run: &Run,
) -> Result<usize> {
    let before = session.gaussians().len();
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by_key(|k| std::cmp::Reverse(count_set(&gaps[*k])));
    let work = run.work("gaps", order.len() as u64);
    for (camera, hidden) in order.into_iter().map(|k| &views[k]) {
        work.advance()?;
        // Other views may have filled a part of this gap.
        let gap = gap(session, camera, hidden)?;
        let (n, width) = (gap.len(), camera.width as usize);
        if count_set(&gap) as f64 <= MIN_GAP_SHARE * n as f64 || count_set(&gap) == n {
            continue;
        }
        let depth = session.render_depth(camera)?;
        let mut inverse: Vec<f32> = depth
            .iter()
            .map(|depth| if depth.is_finite() { 1.0 / depth } else { 0.0 })
            .collect();
        Membrane::fill_planes(&mut inverse, &gap, width);
        let mut colors = solid_colors(session, camera)?;
        inpainter.fill(&mut colors, &gap, camera.width)?;
        let ids = membrane::extend_labels(
            &session.field_without_transparent(camera)?.ids(grid).labels,
            &gap,
            width,
        );
        let to_world = camera.world_to_camera.inverse();
        let mut scene = session.gaussians().clone();
        for p in (0..n).filter(|p| gap[*p] && inverse[*p] > 0.0) {
            let depth = 1.0 / inverse[p];
            let pixel = Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
            let place = to_world.transform_point3(camera.ray(pixel) * depth);
            scene.push_sphere(
                place,
                FILL_RADIUS * depth / camera.fx,
                FILL_OPACITY,
                std::array::from_fn(|c| colors[c * n + p].clamp(0.0, 1.0)),
            );
            let last = scene.len() - 1;
            (scene.object_ids[last], scene.features[last]) = (ids[p], grid.code_of(ids[p]));
        }
        session.set_gaussians(scene)?;
    }
    Ok(session.gaussians().len() - before)
}
