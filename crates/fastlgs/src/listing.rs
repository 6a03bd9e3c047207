//! Lists what is in a scene: its objects with their likeliest names, and a sheet of pictures.

use crate::query::selection;
use crate::query::sheet::{self, Tile};
use crate::{Result, Run, Scene};
use fastlgs_core::image_io;
use fastlgs_grid::evidence;
use fastlgs_grid::query::QueryConfig;
use fastlgs_grid::relevancy::{Rule, Source};
use fastlgs_grid::{Grid, Object};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Options of `objects`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ListConfig {
    /// Trained scene folder.
    pub scene: PathBuf,
    /// Folder for `objects.png`, a sheet with a picture of each object.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: Option<PathBuf>,
    /// Number of names for each object.
    #[cfg_attr(feature = "clap", arg(long, value_name = "N", default_value_t = Self::default().names))]
    pub names: usize,
    /// CLIP text tower, for scenes with imported embeddings, or if its file has moved.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
}

impl Default for ListConfig {
    fn default() -> Self {
        Self {
            scene: PathBuf::new(),
            output: None,
            names: 3,
            clip_text: None,
        }
    }
}

/// Report of `objects`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ListReport {
    /// The scene folder.
    pub scene: PathBuf,
    /// All objects and parts, the largest first.
    pub objects: Vec<ListedObject>,
    /// File of the sheet, if it was written.
    pub sheet: Option<PathBuf>,
}

/// An object of a scene.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ListedObject {
    /// Object id.
    pub id: u16,
    /// Id of the object that it is a part of; 0 for none.
    pub parent: u16,
    /// Likeliest names, best first. They are guesses: a low score means that none fits.
    pub names: Vec<NameScore>,
    /// Number of training views that show it.
    pub views: usize,
    /// View that shows most of it.
    pub best_view: Option<String>,
    /// Share of the scene's surface, 0 to 1.
    pub share: f32,
    /// Number of its Gaussians.
    pub gaussians: usize,
    /// Box in world coordinates: minimum and maximum corner, without outliers.
    pub bbox3d: Option<[[f64; 3]; 2]>,
}

/// A name with its score for an object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NameScore {
    /// The name.
    pub name: String,
    /// Score that a query of this name gives the object, 0 to 1.
    pub score: f32,
}

/// Lists the objects of a scene.
///
/// # Errors
/// A scene that is not trained, a text encoder that cannot be loaded, a sheet that cannot be
/// written, or a device that fails.
pub fn list(config: &ListConfig, run: &Run) -> Result<ListReport> {
    let mut scene = Scene::open(&config.scene, run.device)?;
    scene.set_clip_text(config.clip_text.clone());
    let objects = list_objects(&mut scene, config.names)?;
    let sheet = config
        .output
        .as_ref()
        .map(|folder| folder.join("objects.png"));
    if let Some(path) = &sheet {
        let grid = scene.grid()?;
        let mut tiles = Vec::new();
        for object in &objects {
            if let Some(picture) = scene.thumbnail(&grid, object.id)? {
                let view = object.best_view.clone().unwrap_or_default();
                tiles.push(Tile::small(&picture, object.title(), view));
            }
        }
        image_io::save_png(path, sheet::sheet(&tiles, TILES_PER_ROW))?;
    }
    Ok(ListReport {
        scene: config.scene.clone(),
        objects,
        sheet,
    })
}

/// Number of tiles in a row of the sheet.
const TILES_PER_ROW: usize = 10;

impl ListedObject {
    /// Returns the id and the likeliest name.
    fn title(&self) -> String {
        let name = self.names.first().map(|name| name.name.as_str());
        format!("#{} {}", self.id, name.unwrap_or_default())
    }
}

/// Lists the objects of an opened scene with at most `names` names each, the largest object first.
///
/// # Errors
/// As [`list`].
pub fn list_objects(scene: &mut Scene, names: usize) -> Result<Vec<ListedObject>> {
    let grid = scene.grid()?;
    let named = likeliest_names(scene, &grid, names)?;
    let shares = grid.shares();
    let owned = selection::gaussians_by_object(scene.gaussians(), &grid);
    let mut objects = Vec::new();
    for (((object, names), share), own) in grid.objects.iter().zip(named).zip(shares).zip(owned) {
        objects.push(ListedObject {
            id: object.id,
            parent: object.parent,
            names,
            views: object.views,
            best_view: scene.most_visible_view(&grid, &[object.id])?,
            share,
            gaussians: own.len(),
            bbox3d: selection::robust_box(scene.gaussians(), &scene.manifest().frame, &own),
        });
    }
    objects.sort_by(|a, b| b.share.total_cmp(&a.share).then(a.id.cmp(&b.id)));
    Ok(objects)
}

/// Returns the likeliest names of each object, at most `most`, in order of id. Objects without
/// embeddings have none.
///
/// # Errors
/// The text encoder cannot be loaded.
pub fn likeliest_names(scene: &Scene, grid: &Grid, most: usize) -> Result<Vec<Vec<NameScore>>> {
    if most == 0 {
        return Ok(vec![Vec::new(); grid.objects.len()]);
    }
    let vocabulary = scene.texts()?.vocabulary()?;
    let min_score = QueryConfig::default().min_score(Rule::Calibrated);
    let scores: Vec<Vec<f32>> = vocabulary
        .par_iter()
        .map(|(_, query)| {
            let evidence = evidence::evidence(grid, query);
            evidence.iter().map(|evidence| evidence.score).collect()
        })
        .collect();
    let of_object = |(place, object): (usize, &Object)| {
        let named = vocabulary.iter().zip(&scores);
        let mut names: Vec<(bool, NameScore)> = named
            .filter(|_| !object.embeddings.is_empty())
            .map(|((name, query), scores)| {
                let score = scores[place];
                let is_detected = matches!(query.source, Source::Detector(_)) && score >= min_score;
                let name = name.clone();
                (is_detected, NameScore { name, score })
            })
            .collect();
        names.sort_by(|a, b| b.1.score.total_cmp(&a.1.score));
        // Every object looks like some class of the encoder, but the detector finds only what it
        // knows, so its best name is listed first.
        if let Some(first) = names.iter().position(|(is_detected, _)| *is_detected) {
            names[..=first].rotate_right(1);
        }
        names.into_iter().map(|row| row.1).take(most).collect()
    };
    Ok(grid.objects.iter().enumerate().map(of_object).collect())
}
