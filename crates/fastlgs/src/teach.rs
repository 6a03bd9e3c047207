//! Teaches a name by an example: an object of a scene, or a picture.

use crate::error::{Context, bail};
use crate::names::{Example, Names, normalise_name};
use crate::query::object_query::{ObjectQuery, picture_query};
use crate::query::{Pixels, selection};
use crate::{Error, Result, Run, Scene, model_choice};
use fastlgs_core::image_io;
use fastlgs_grid::Grid;
use fastlgs_grid::query::QueryConfig;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// A name and one example: `point` (with `view`), `object` or `image`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct TeachConfig {
    /// Name to teach, in any language.
    pub name: String,
    /// Trained scene folder with the object, or with the encoder for the picture.
    pub scene: PathBuf,
    /// Pixel of the view that shows the object; several pixels of it as X,Y+X,Y.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "X,Y", requires = "view", group = "shown")
    )]
    pub point: Option<Pixels>,
    /// View that contains the pixel.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME", requires = "point"))]
    pub view: Option<String>,
    /// Id of the object.
    #[cfg_attr(feature = "clap", arg(long, value_name = "ID", group = "shown"))]
    pub object: Option<u16>,
    /// Picture that shows only the object.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", group = "shown"))]
    pub image: Option<PathBuf>,
}

/// Report of `teach`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TeachReport {
    /// The name.
    pub name: String,
    /// Id of the object; `None` for a picture.
    pub object: Option<u16>,
    /// Number of embeddings of this example.
    pub views: usize,
    /// Number of all examples of the name.
    pub examples: usize,
    /// File that stores the names.
    pub kept: PathBuf,
}

/// Teaches a name by one example.
///
/// # Errors
/// An empty name, an example without an object, none or several examples, or a file that cannot be
/// written. The names then remain unchanged.
pub fn teach(config: &TeachConfig, run: &Run) -> Result<TeachReport> {
    teach_in(&mut Scene::open(&config.scene, run.device)?, config)
}

/// Teaches a name by an example in an opened scene; `config.scene` is ignored.
///
/// # Errors
/// As [`teach`].
pub fn teach_in(scene: &mut Scene, config: &TeachConfig) -> Result<TeachReport> {
    let object = match (config.object, &config.point, &config.image) {
        (Some(id), None, None) => id,
        (None, Some(pixels), None) => object_at(scene, config, pixels)?,
        (None, None, Some(path)) => {
            let name = path.display().to_string();
            let embeddings = picture_query(scene, &name, &image_io::load_rgb(path)?)?.positive;
            return store_example(scene, &config.name, None, name, embeddings);
        }
        _ => {
            bail!("give exactly one example: a point with its view, an object, or an image")
        }
    };
    teach_object(scene, &*scene.grid()?, &config.name, object)
}

/// Teaches `name` by the object `id` of `grid`, the object table of the scene.
///
/// # Errors
/// As [`teach`].
pub fn teach_object(scene: &Scene, grid: &Grid, name: &str, id: u16) -> Result<TeachReport> {
    model_choice::check_version(scene.manifest(), grid, scene.folder())?;
    let root = scene.folder().root.display().to_string();
    let object = usize::from(id)
        .checked_sub(1)
        .and_then(|k| grid.objects.get(k));
    let object = object.ok_or_else(|| selection::no_object(&scene.folder().root, grid, id))?;
    store_example(
        scene,
        name,
        Some(id),
        format!("object {id} of {root}"),
        object.embeddings.clone(),
    )
}

fn store_example(
    scene: &Scene,
    name: &str,
    object: Option<u16>,
    from: String,
    embeddings: Vec<Vec<f32>>,
) -> Result<TeachReport> {
    let name = normalise_name(name);
    if name.is_empty() {
        bail!("the name is empty; enter a name for the object");
    }
    if embeddings.is_empty() {
        bail!(
            "{from}: it has no embedding, because no view shows it large enough; choose a larger object"
        );
    }
    let views = embeddings.len();
    let examples = Names::change(|names| {
        names.add(
            &name,
            Example {
                encoder: model_choice::identity_of(scene.manifest()),
                from,
                embeddings,
            },
        );
        Ok(names.examples(&name).map_or(0, <[Example]>::len))
    })?;
    Ok(TeachReport {
        name,
        object,
        views,
        examples,
        kept: Names::path(),
    })
}

/// Returns the id of the object at pixels of a view.
fn object_at(scene: &mut Scene, config: &TeachConfig, pixels: &Pixels) -> Result<u16> {
    let view = config
        .view
        .as_deref()
        .context("a point needs the name of its view; set view as well")?;
    let camera = scene.cameras()[scene.folder().view_index(scene.cameras(), view)?].clone();
    let (grid, field) = (scene.grid()?, scene.field(&camera, None)?);
    let found = ObjectQuery::Point(pixels.clone()).embed(scene, &[])?.find(
        &grid,
        &field,
        &camera,
        &QueryConfig::default(),
    )?;
    let target = found.targets.first().ok_or_else(|| {
        Error::NotFound(format!(
            "there is no object at {pixels} of '{}'; choose other pixels",
            camera.name
        ))
    })?;
    Ok(target.id)
}
