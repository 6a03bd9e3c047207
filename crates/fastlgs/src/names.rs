//! Names that the user has taught: examples under a name, to which every scene of the same encoder answers.

use crate::error::{Context, bail};
use crate::session::ask::{Ask, picture};
use crate::{Result, Run, Session, eyes};
use fastlgs_core::{fs, image_io};
use fastlgs_grid::query::QueryConfig;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What one lesson showed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Example {
    /// The encoder that embedded it.
    pub encoder: String,
    /// Where it was seen.
    pub from: String,
    /// Embeddings, one a view.
    pub embeddings: Vec<Vec<f32>>,
}

/// All names with their examples.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Names(BTreeMap<String, Vec<Example>>);

/// A name as it is kept: without capitals and superfluous spaces.
fn plain(name: &str) -> String {
    name.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase()
}

impl Names {
    /// The file that keeps them.
    pub fn path() -> PathBuf {
        fs::data_dir().join("names.json")
    }

    /// The user's names; none where nothing was taught yet.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn load() -> Result<Self> {
        let path = Self::path();
        if path.exists() { Self::read(&path) } else { Ok(Self::default()) }
    }

    /// The names of a file that [`Self::write`] wrote.
    ///
    /// # Errors
    /// A file that cannot be read, or holds something else.
    pub fn read(path: &Path) -> Result<Self> {
        let names: Self = fs::read_json(path).with_context(|| format!("{}: no names that were exported", path.display()))?;
        let finite = |e: &Example| !e.embeddings.is_empty() && e.embeddings.iter().flatten().all(|v| v.is_finite());
        if let Some((name, _)) = names.0.iter().find(|(name, examples)| plain(name) != **name || !examples.iter().all(finite)) {
            bail!("{}: the name '{name}' is damaged; teach it again", path.display());
        }
        Ok(names)
    }

    /// Writes them to a file.
    ///
    /// # Errors
    /// The system's refusal; what was there before then stays.
    pub fn write(&self, path: &Path) -> Result<()> {
        Ok(fs::write_json(path, self)?)
    }

    /// The examples of a name, if it was taught.
    pub fn of(&self, name: &str) -> Option<&[Example]> {
        self.0.get(&plain(name)).map(Vec::as_slice)
    }

    /// Adds an example, unless it is there already.
    pub fn add(&mut self, name: &str, example: Example) {
        let examples = self.0.entry(plain(name)).or_default();
        if !examples.contains(&example) {
            examples.push(example);
        }
    }

    /// Adds the examples of others; how many names came.
    pub fn extend(&mut self, others: Self) -> usize {
        let count = others.0.len();
        for (name, examples) in others.0 {
            examples.into_iter().for_each(|example| self.add(&name, example));
        }
        count
    }

    /// Forgets a name.
    ///
    /// # Errors
    /// A name that was never taught.
    pub fn remove(&mut self, name: &str) -> Result<()> {
        match self.0.remove(&plain(name)) {
            Some(_) => Ok(()),
            None => bail!("'{name}' was never taught; 'fastlgs names list' shows what was"),
        }
    }

    /// What a list shows: each name with its examples.
    pub fn rows(&self) -> Vec<Row> {
        let row = |(name, examples): (&String, &Vec<Example>)| Row {
            name: name.clone(),
            examples: examples.len(),
            views: examples.iter().map(|e| e.embeddings.len()).sum(),
            from: examples.iter().map(|e| e.from.clone()).collect(),
        };
        self.0.iter().map(row).collect()
    }
}

/// A name in a list.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The name.
    pub name: String,
    /// Lessons.
    pub examples: usize,
    /// Their embeddings.
    pub views: usize,
    /// Where they were seen.
    pub from: Vec<String>,
}

/// What is taught; one of `point` (with `view`), `object` and `image`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Lesson {
    /// The name, in any language.
    pub name: String,
    /// Trained scene folder, in which the thing is shown or whose encoder embeds the picture.
    pub scene: PathBuf,
    /// A pixel of the view: the object that it shows.
    #[cfg_attr(feature = "clap", arg(long, value_name = "X,Y", value_parser = crate::session::parse_point, requires = "view", group = "shown"))]
    pub point: Option<(u32, u32)>,
    /// The view that the pixel is of.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME", requires = "point"))]
    pub view: Option<String>,
    /// An object by its number.
    #[cfg_attr(feature = "clap", arg(long, value_name = "ID", group = "shown"))]
    pub object: Option<u16>,
    /// A picture of the thing.
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
    let object = match (lesson.object, lesson.point, &lesson.image) {
        (Some(id), None, None) => Some(id),
        (None, Some((x, y)), None) => Some(shown_at(&mut scene, lesson, x, y)?),
        (None, None, Some(_)) => None,
        _ => bail!("show the thing in one way: --point X,Y with --view, --object ID, or --image FILE"),
    };
    match (object, &lesson.image) {
        (Some(id), _) => learn(&scene, &lesson.name, id),
        (None, Some(path)) => {
            let embeddings = picture(&scene, &path.display().to_string(), &image_io::load_rgb(path)?)?.meant;
            keep(&scene, &lesson.name, None, path.display().to_string(), embeddings)
        }
        (None, None) => bail!("nothing was shown"),
    }
}

/// Teaches the name of an object of a scene.
///
/// # Errors
/// As [`teach`].
pub fn learn(scene: &Session, name: &str, id: u16) -> Result<Report> {
    let (grid, root) = (scene.grid()?, scene.folder.root.display().to_string());
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
    let mut names = Names::load()?;
    let views = embeddings.len();
    names.add(&name, Example { encoder: eyes::identity_of(&scene.manifest), from, embeddings });
    names.write(&Names::path())?;
    let examples = names.of(&name).map_or(0, <[Example]>::len);
    Ok(Report { name, object, views, examples, kept: Names::path() })
}

/// The object that a pixel of a view shows.
fn shown_at(scene: &mut Session, lesson: &Lesson, x: u32, y: u32) -> Result<u16> {
    let view = lesson.view.as_deref().context("--point needs the view that it is of: --view NAME")?;
    let camera = scene.cameras[scene.folder.view_index(&scene.cameras, view)?].clone();
    let (grid, field) = (scene.grid()?, scene.field(&camera, None)?);
    let found = Ask::Point(x, y).meaning(scene, &[])?.find(&grid, &field, &camera, &QueryConfig::default())?;
    let nothing = || format!("no object is at {x},{y} of '{}'", camera.name);
    Ok(found.targets.first().with_context(nothing)?.id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_kept_without_capitals_and_forgotten_by_name() {
        let example = |from: &str| Example { encoder: "offline".into(), from: from.into(), embeddings: vec![vec![0.6, 0.8]] };
        let mut names = Names::default();
        names.add("Lis  rudy", example("a"));
        names.add("lis rudy", example("a"));
        names.add("LIS RUDY", example("b"));
        assert_eq!(names.of(" Lis Rudy ").map(<[Example]>::len), Some(2));
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("names.json");
        names.write(&path).expect("a file");
        let mut others = Names::default();
        assert_eq!(others.extend(Names::read(&path).expect("names")), 1);
        assert_eq!(others, names);
        assert_eq!(names.rows()[0].from, ["a", "b"]);
        names.remove("Lis rudy").expect("it was taught");
        assert!(names.remove("lis rudy").expect_err("gone").to_string().contains("never taught"));
        std::fs::write(&path, "{\"a\": [{\"encoder\": \"\", \"from\": \"\", \"embeddings\": []}]}").expect("a file");
        assert!(Names::read(&path).expect_err("damaged").to_string().contains("'a' is damaged"));
    }
}
