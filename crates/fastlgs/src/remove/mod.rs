//! Removes an object from a scene, and fills the gaps behind it (paper, object removal with
//! inpainting).
//!
//! Where other photos show the surface behind the object, it appears once the Gaussians of the
//! object are gone. Gaps that no photo shows are filled, and the Gaussians around them are trained on
//! the filled photos.

mod behind;
mod embeddings;
mod fill;
mod folder;
mod hidden;
mod membrane;
mod refine;

use crate::error::{Context, bail};
use crate::output::{SceneLock, resolve_path};
use crate::query::object_query::ObjectQuery;
use crate::query::selection;
use crate::{Error, Result, Run, Scene, transparent};
use fastlgs_core::{Camera, Gaussians, SceneFolder};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{Hit, QueryConfig};
use fastlgs_vision::inpaint::{self, Inpainter};
use fill::Filled;
use hidden::{HiddenPixels, count_set};
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
    /// Share of the hidden pixels of all training photos at which other photos show the surface
    /// behind the object.
    pub seen: f64,
    /// Number of remaining objects.
    pub left: usize,
}

/// Dilation of masks in x and y, in pixels: five times a window of 5x5 (paper).
const MASK_DILATION: [u32; 2] = [10; 2];
/// Dilation of the masks of Gaussians that belong to no object: a window of 5x5.
const EXTENSION_DILATION: [u32; 2] = [2; 2];

/// Removes the objects that `config` names, fills the gaps, and writes a new scene.
///
/// # Errors
/// A text or id without an object, an output folder that holds a scene, photos that are missing, or
/// a device that fails.
pub fn remove(config: &RemoveConfig, run: &Run) -> Result<RemoveReport> {
    check_folders(config)?;
    let _lock = SceneLock::take(&config.output, "remove")?;
    let inpainter: Box<dyn Inpainter> = if config.inpainter == "membrane" {
        Box::new(Membrane)
    } else {
        inpaint::by_name(&config.inpainter).context("the inpainter cannot be opened")?
    };
    let mut scene = open_with_photos(config, run)?;
    let grid = scene.grid()?;
    let targets = targets(config, &mut scene, &grid)?;
    let objects: Vec<u16> = targets.iter().map(|t| t.id).collect();
    let mut hidden = HiddenPixels::of(&mut scene, &grid, &targets, MASK_DILATION)?;
    extend_object(&mut scene, &grid, &objects, &hidden)?;
    hidden.extend(HiddenPixels::of(
        &mut scene,
        &grid,
        &targets,
        EXTENSION_DILATION,
    )?);
    let left = remaining(&mut scene, &grid, &objects, &hidden)?;
    if left.is_empty() {
        bail!(
            "{}: no Gaussians of the scene would remain; choose a smaller object",
            config.scene.display()
        );
    }
    let removed = scene.gaussians().len() - left.len();
    let gone = gone_objects(scene.gaussians(), &grid, &objects, &left);
    let rest = scene.gaussians().select(&left);
    scene.set_gaussians(rest)?;

    let Filled {
        gaussians,
        gap_pixels,
    } = fill::fill(&mut scene, &grid, &hidden.in_training, &*inpainter, run)?;
    let hidden_pixels: usize = hidden.in_training.iter().map(|h| count_set(&h.1)).sum();

    let (mut left_over, ids) = grid.without(&gone);
    let renumbered = |id: &u16| ids.get(usize::from(*id)).copied().unwrap_or(0);
    let ids = scene.gaussians().object_ids.iter().map(renumbered);
    let ids = ids.collect();
    scene.set_object_ids(ids);
    let what = config
        .text
        .clone()
        .unwrap_or_else(|| format!("object {}", objects[0]));
    folder::write(
        &config.output,
        &mut scene,
        &mut left_over,
        &hidden,
        &what,
        &*inpainter,
        run,
    )?;
    Ok(RemoveReport {
        scene: config.scene.clone(),
        output: config.output.clone(),
        objects,
        removed,
        filled: gaussians,
        seen: 1.0 - gap_pixels as f64 / (hidden_pixels as f64).max(1.0),
        left: left_over.objects.len(),
    })
}

/// Refuses an output folder that overlaps the scene, or holds one.
fn check_folders(config: &RemoveConfig) -> Result<()> {
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
    Ok(())
}

/// Opens the scene, and checks that its prepared photos are there.
fn open_with_photos(config: &RemoveConfig, run: &Run) -> Result<Scene> {
    let mut scene = Scene::open(&config.scene, run.device)?;
    scene.set_clip_text(config.clip_text.clone());
    let has_photo = |camera: &Camera| scene.folder().photo_path(&camera.name).is_file();
    if !scene.cameras().iter().all(has_photo) {
        bail!(
            "{}: its prepared photos are not there; remove the object from the trained scene, not from an export",
            config.scene.display()
        );
    }
    Ok(scene)
}

/// Gives the first of `objects` the Gaussians that stand where they are.
fn extend_object(
    scene: &mut Scene,
    grid: &Grid,
    objects: &[u16],
    hidden: &HiddenPixels,
) -> Result<()> {
    let own = selection::gaussians(scene.gaussians(), grid, objects);
    let protruding = behind::protruding_gaussians(scene, &own, &hidden.in_training)?;
    let mut gaussians = scene.gaussians().clone();
    for i in protruding {
        (gaussians.object_ids[i], gaussians.features[i]) = (objects[0], grid.code_of(objects[0]));
    }
    scene.set_gaussians(gaussians)
}

/// Returns the indices of the Gaussians that remain. Photos do not show transparent Gaussians, so
/// all of them remain, except those of the removed objects.
fn remaining(
    scene: &mut Scene,
    grid: &Grid,
    objects: &[u16],
    hidden: &HiddenPixels,
) -> Result<Vec<usize>> {
    let mut remains = behind::remaining_gaussians(scene, &hidden.in_training)?;
    for (i, remains) in remains.iter_mut().enumerate() {
        *remains |= transparent::is_transparent(scene.gaussians(), i);
    }
    for i in selection::gaussians(scene.gaussians(), grid, objects) {
        remains[i] = false;
    }
    Ok((0..remains.len()).filter(|i| remains[*i]).collect())
}

/// Returns for each object whether it disappears: the removed ones, their parts, and those that lose
/// more than half of their Gaussians if those in `left` remain.
fn gone_objects(scene: &Gaussians, grid: &Grid, removed: &[u16], left: &[usize]) -> Vec<bool> {
    let counts = |scene: &Gaussians| -> Vec<usize> {
        let by_object = selection::gaussians_by_object(scene, grid);
        by_object.iter().map(Vec::len).collect()
    };
    let remaining = counts(scene).into_iter().zip(counts(&scene.select(left)));
    let is_gone =
        |(is_part, (before, after)): (bool, (usize, usize))| is_part || 2 * after < before;
    let parts = grid.parts(removed).into_iter();
    parts.zip(remaining).map(is_gone).collect()
}

/// Returns the objects that `config` names.
///
/// # Errors
/// There is no such object.
fn targets(config: &RemoveConfig, scene: &mut Scene, grid: &Grid) -> Result<Vec<Hit>> {
    let root = config.scene.display();
    if let Some(id) = config.object {
        if id == 0 || usize::from(id) > grid.objects.len() {
            return Err(selection::no_object(&config.scene, grid, id));
        }
        return Ok(vec![Hit { id, score: 1.0 }]);
    }
    let text = config.text.clone().unwrap_or_default();
    let camera = scene
        .cameras()
        .first()
        .cloned()
        .with_context(|| format!("{root}: the scene has no views"))?;
    let field = scene.field(&camera, None)?;
    let found = ObjectQuery::Text(text.clone()).embed(scene, &[])?.find(
        grid,
        &field,
        &camera,
        &QueryConfig::default(),
    )?;
    if found.targets.is_empty() {
        return Err(Error::NotFound(format!(
            "{root}: '{text}' is not found; name the object by its id, which a query by a pixel reports"
        )));
    }
    Ok(found.targets)
}
