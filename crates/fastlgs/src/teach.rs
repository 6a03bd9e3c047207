//! Teaching a name by showing a thing: an object of a scene, or a picture.

use crate::error::{Context, bail};
use crate::names::{Example, Names, plain};
use crate::session::Pixels;
use crate::session::ask::{Ask, picture};
use crate::{Result, Run, Session, eyes};
use fastlgs_core::image_io;
use fastlgs_grid::Grid;
use fastlgs_grid::query::QueryConfig;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What is taught; one of `point` (with `view`), `object` and `image`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Lesson {
    /// The name, in any language.
    pub name: String,
    /// Trained scene folder, in which the thing is shown or whose encoder embeds the picture.
    pub scene: PathBuf,
    /// A pixel of the view: the object that it shows; several as X,Y+X,Y: the object that they tell of together.
    #[cfg_attr(feature = "clap", arg(long, value_name = "X,Y", requires = "view", group = "shown"))]
    pub point: Option<Pixels>,
    /// The view that the pixel is of.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME", requires = "point"))]
    pub view: Option<String>,
    /// An object by its number.
    #[cfg_attr(feature = "clap", arg(long, value_name = "ID", group = "shown"))]
    pub object: Option<u16>,
    /// A picture of the thing, cut out of its surroundings.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", group = "shown"))]
    pub image: Option<PathBuf>,
}

/// What was learned.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// The name.
    pub name: String,
    /// The object that was shown; nothing where a picture was.
    pub object: Option<u16>,
    /// Embeddings that it gave.
    pub views: usize,
    /// Examples of the name by now.
    pub examples: usize,
    /// The file that keeps the names.
    pub kept: PathBuf,
}

/// Teaches a name by showing a thing.
///
/// # Errors
/// An empty name, nothing or no object where it is shown, or the system's refusal; the names then stay as they were.
pub fn teach(lesson: &Lesson, run: &Run) -> Result<Report> {
    let mut scene = Session::open(&lesson.scene, run.device)?;
    let object = match (lesson.object, &lesson.point, &lesson.image) {
        (Some(id), None, None) => Some(id),
        (None, Some(pixels), None) => Some(shown_at(&mut scene, lesson, pixels)?),
        (None, None, Some(_)) => None,
        _ => bail!("show the thing in one way: --point X,Y with --view, --object ID, or --image FILE"),
    };
    match (object, &lesson.image) {
        (Some(id), _) => learn(&scene, &scene.grid()?, &lesson.name, id),
        (None, Some(path)) => {
            let embeddings = picture(&scene, &path.display().to_string(), &image_io::load_rgb(path)?)?.meant;
            keep(&scene, &lesson.name, None, path.display().to_string(), embeddings)
        }
        (None, None) => bail!("nothing was shown"),
    }
}

/// Teaches the name of an object of `grid`, the table of a scene.
///
/// # Errors
/// As [`teach`].
pub fn learn(scene: &Session, grid: &Grid, name: &str, id: u16) -> Result<Report> {
    eyes::check_version(&scene.manifest, grid, &scene.folder)?;
    let root = scene.folder.root.display().to_string();
    let Some(object) = usize::from(id).checked_sub(1).and_then(|k| grid.objects.get(k)) else {
        bail!("{root}: it has objects 1 to {}, none is {id}", grid.objects.len())
    };
    keep(scene, name, Some(id), format!("object {id} of {root}"), object.embeddings.clone())
}

fn keep(scene: &Session, name: &str, object: Option<u16>, from: String, embeddings: Vec<Vec<f32>>) -> Result<Report> {
    let name = plain(name);
    if name.is_empty() {
        bail!("the name is empty");
    }
    if embeddings.is_empty() {
        bail!("{from}: it was never seen well enough to be known again; show something larger");
    }
    let views = embeddings.len();
    let examples = Names::change(|names| {
        names.add(&name, Example { encoder: eyes::identity_of(&scene.manifest), from, embeddings });
        Ok(names.of(&name).map_or(0, <[Example]>::len))
    })?;
    Ok(Report { name, object, views, examples, kept: Names::path() })
}

/// The object that pixels of a view show.
fn shown_at(scene: &mut Session, lesson: &Lesson, pixels: &Pixels) -> Result<u16> {
    let view = lesson.view.as_deref().context("--point needs the view that it is of: --view NAME")?;
    let camera = scene.cameras[scene.folder.view_index(&scene.cameras, view)?].clone();
    let (grid, field) = (scene.grid()?, scene.field(&camera, None)?);
    let found = Ask::Point(pixels.clone()).meaning(scene, &[])?.find(&grid, &field, &camera, &QueryConfig::default())?;
    let nothing = || format!("no object is at {pixels} of '{}'", camera.name);
    Ok(found.targets.first().with_context(nothing)?.id)
}
