//! Measures the calibration of an encoder on generated scenes and on labelled scenes.

use crate::absent::{ABSENT, COLORS};
use crate::calibrations::{self, CalibrationFile, Calibrations, calibration_path};
use crate::error::{Context, bail};
use crate::eval::best_object;
use crate::model_choice::{EncoderKind, ModelChoice};
use crate::{Result, Run, Scene, masks};
use fastlgs_core::labels::LabelledView;
use fastlgs_core::{LabelMap, fs};
use fastlgs_grid::calibration::{Calibration, Samples};
use fastlgs_grid::grid::Object;
use fastlgs_grid::mapping::Mask;
use fastlgs_grid::relevancy::{CANONICAL, TextQuery};
use fastlgs_grid::{Grid, evidence, query};
use fastlgs_synth::{Kind, SceneObject, World};
use fastlgs_vision::crops::Background;
use fastlgs_vision::{ClipImage, models};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

/// Report of a calibration.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CalibrationReport {
    /// Best background around the masks in crops.
    pub background: Background,
    /// By background: how far the cosine of an object with its name exceeds the mean of the other
    /// objects, in standard deviations of the latter.
    pub separation: BTreeMap<Background, f32>,
    /// Calibration of texts.
    pub texts: Calibration,
    /// Whether generated scenes and real rooms agree about absent names. Otherwise the calibration
    /// of real rooms is kept, with the measured log-odds per unit of margin.
    pub agrees: bool,
    /// Calibration of pictures.
    pub pictures: Calibration,
    /// Number of objects in the generated scenes.
    pub things: usize,
    /// Number of absent names.
    pub absent: usize,
    /// File that stores the calibration.
    pub kept: PathBuf,
    /// Duration in seconds.
    pub seconds: f64,
}

/// Seeds of the generated tables.
const TABLES: [u64; 3] = [1, 2, 3];
/// Number of photos of each generated scene.
const CALIBRATION_VIEWS: usize = 12;
/// Width and height of these photos in pixels.
const CALIBRATION_SIZE: (u32, u32) = (480, 360);
/// Least share of a photo that a mask must cover to be embedded.
const LEAST_AREA: f32 = 0.0005;

/// A generated scene: its true objects, and their embeddings.
struct GeneratedScene {
    objects_and_parts: Vec<SceneObject>,
    grid: Grid,
}

/// Measures the calibration of CLIP's towers on generated scenes, checks it against that of real
/// rooms, and writes it beside the image tower.
///
/// # Errors
/// Towers that cannot be loaded or that distinguish no objects, or a folder that cannot be written.
pub fn calibrate(choice: &ModelChoice, run: &Run) -> Result<CalibrationReport> {
    let clock = Instant::now();
    if choice.encoder != EncoderKind::Clip {
        bail!(
            "only CLIP can be calibrated: the offline encoder is calibrated already, and imported embeddings cannot be; set clip, or clip_image and clip_text, to choose the towers"
        );
    }
    let image_tower = choice.clip_files()?[0].clone();
    let scenes_by_background = embedded_scenes(choice, run)?;
    let texts = choice.text_encoder()?;
    let canonical = texts.embed(&CANONICAL)?;
    let real_rooms = Calibrations::of_tower(&choice.clip_files()?[1]);
    let anything = real_rooms.texts.anything;
    let query = |text: &str| -> Result<TextQuery> {
        let anything = anything + texts.baseline_shift(text);
        Ok(TextQuery {
            canonical: canonical.clone(),
            min_canonical: anything,
            ..TextQuery::new(texts.embed(&[text])?, real_rooms.texts)
        })
    };
    let scenes = scenes_by_background[0].iter();
    let objects: Vec<_> = scenes.flat_map(|scene| &scene.objects_and_parts).collect();
    let absent = absent_where(|name: &str| objects.iter().any(|o| o.name.contains(name)));
    let (mut calibrations, mut separation) = (BTreeMap::new(), BTreeMap::new());
    for (background, known) in Background::ALL.into_iter().zip(&scenes_by_background) {
        let named = by_names(known, &absent, query)?;
        let texts = Calibration::measured(&named, anything);
        let pictures = Calibration::measured(&by_examples(known), anything);
        if let (Some(texts), Some(pictures)) = (texts, pictures) {
            let measured = Calibrations {
                texts: texts.checked_against(&real_rooms.texts),
                pictures: pictures.checked_against(&real_rooms.pictures),
            };
            calibrations.insert(background, measured);
            separation.insert(background, named.separation());
        }
    }
    // `max_by` returns the last of equal values; in reverse order that is grey.
    let best = separation.iter().rev().max_by(|a, b| a.1.total_cmp(b.1));
    let (background, _) = best.with_context(|| {
        format!(
            "{}: the encoder cannot distinguish the generated objects by their names; check that it is an image tower of CLIP",
            image_tower.display()
        )
    })?;
    let (background, Calibrations { texts, pictures }) = (*background, calibrations[background]);
    if !texts.measured {
        run.warn("in the generated scenes, absent names do not come as near as in real rooms; only the log-odds per unit of margin and the background of crops are measured");
    }
    let kept = calibration_path(&image_tower);
    let file = CalibrationFile {
        sha256: calibrations::tower_hashes(&choice.files()?),
        background,
        calibrations,
    };
    fs::write_json(&kept, &file)?;
    Ok(CalibrationReport {
        background,
        separation,
        agrees: texts.measured,
        texts,
        pictures,
        things: objects.len(),
        absent: absent.len(),
        kept,
        seconds: clock.elapsed().as_secs_f64(),
    })
}

/// Embeds the generated scenes, once for each background of the crops.
fn embedded_scenes(choice: &ModelChoice, run: &Run) -> Result<Vec<Vec<GeneratedScene>>> {
    let tower = choice.clip_image()?;
    let encoders = Background::ALL.map(|background| tower.clone().with_background(background));
    let pictures = models::pictures_dir();
    let mut worlds = TABLES
        .iter()
        .map(|seed| Kind::Table.world(&pictures, CALIBRATION_VIEWS, CALIBRATION_SIZE, *seed))
        .collect::<Result<Vec<_>, _>>()?;
    // The room needs pictures that may not be installed; the tables do not.
    worlds.extend(
        Kind::Room
            .world(&pictures, CALIBRATION_VIEWS, CALIBRATION_SIZE, 0)
            .ok(),
    );
    let work = run.work("calibrate", (worlds.len() * CALIBRATION_VIEWS) as u64);
    let mut scenes: Vec<Vec<GeneratedScene>> = Background::ALL.map(|_| Vec::new()).into();
    for world in worlds {
        let embedded = embed_world(&world, &encoders, || work.advance())?;
        for (scenes, scene) in scenes.iter_mut().zip(embedded) {
            scenes.push(scene);
        }
    }
    Ok(scenes)
}

/// Renders a generated scene and embeds its objects by their exact masks, once for each encoder.
fn embed_world(
    world: &World,
    encoders: &[ClipImage],
    advance: impl Fn() -> Result<()>,
) -> Result<Vec<GeneratedScene>> {
    let things = world.objects.clone();
    let chain = |id: u16| {
        std::iter::successors(Some(id).filter(|id| *id > 0), |id| {
            Some(things[usize::from(*id) - 1].parent).filter(|p| *p > 0)
        })
    };
    let depth = |id: u16| chain(id).count();
    let depths = (1..=things.len() as u16).map(depth).max().unwrap_or(0);
    let mut found: Vec<Vec<Mask>> = vec![Vec::new(); encoders.len()];
    for (index, camera) in world.cameras.iter().enumerate() {
        let view = world.render(index, 2);
        for layer in 1..=depths {
            let labels = view
                .instances
                .labels
                .iter()
                .map(|id| chain(*id).find(|a| depth(*a) == layer).unwrap_or(0))
                .collect();
            let map = LabelMap {
                labels,
                ..view.instances
            };
            for (encoder, found) in encoders.iter().zip(&mut found) {
                let masks = masks::descriptors(&camera.name, &view.photo, index, &map, encoder)?;
                found.extend(masks.into_iter().filter(|m| m.area >= LEAST_AREA));
            }
        }
        advance()?;
    }
    let known = |found: Vec<Mask>| {
        let object_of: Vec<u16> = found.iter().map(|m| m.label).collect();
        let mut grid = Grid::build(&found, &object_of, vec![Vec3::ZERO; things.len()]);
        grid.objects
            .iter_mut()
            .zip(&things)
            .for_each(|(object, thing)| object.parent = thing.parent);
        GeneratedScene {
            objects_and_parts: things.clone(),
            grid,
        }
    };
    Ok(found.into_iter().map(known).collect())
}

impl GeneratedScene {
    /// Returns the objects that have embeddings, with their names.
    fn objects(&self) -> impl Iterator<Item = (&Object, &str)> {
        let named = self
            .grid
            .objects
            .iter()
            .zip(self.objects_and_parts.iter().map(|t| t.name.as_str()));
        named.filter(|(object, _)| !object.embeddings.is_empty())
    }

    /// Returns the objects that neither contain object `of` nor are part of it.
    fn others(&self, of: u16) -> impl Iterator<Item = &Object> {
        let related = self.grid.related(of);
        self.objects()
            .map(|o| o.0)
            .filter(move |o| !related[usize::from(o.id) - 1])
    }
}

/// Returns samples of a labelled scene. `fastlgs-bench names` calibrates each scene with the
/// samples of the other scenes.
///
/// # Errors
/// Labels of views that the scene lacks, or a failing device.
pub fn samples_of(scene: &mut Scene, views: &[LabelledView]) -> Result<Samples> {
    scene.ignore_taught_names();
    let grid = scene.grid()?;
    let seen = || grid.objects.iter().filter(|o| !o.embeddings.is_empty());
    let mut samples = Samples::default();
    for view in views {
        let camera =
            scene.cameras()[scene.folder().view_index(scene.cameras(), &view.name)?].clone();
        let field = scene.field(&camera, None)?;
        for label in &view.labels {
            let (iou, _, id) = best_object(
                &grid,
                &field,
                &view.mask(label, camera.width, camera.height),
            );
            let Some(own) = seen().find(|o| o.id == id && iou >= MIN_LABEL_IOU) else {
                continue;
            };
            let query = scene.text_query(&label.category)?;
            let related = grid.related(id);
            add_sample(
                &mut samples,
                &query,
                own,
                seen().filter(|o| !related[usize::from(o.id) - 1]),
            );
        }
    }
    let there = |name: &str| {
        views
            .iter()
            .flat_map(|v| &v.labels)
            .any(|l| l.category.contains(name))
    };
    for text in absent_where(there) {
        samples
            .absent
            .extend(query::best(&grid, &scene.text_query(&text)?));
    }
    Ok(samples)
}

/// Returns the absent names for which `is_present` is false, each alone and with a colour in front.
fn absent_where(is_present: impl Fn(&str) -> bool) -> Vec<String> {
    let absent = ABSENT
        .into_iter()
        .filter(|name| !is_present(name))
        .zip(COLORS.into_iter().cycle());
    absent
        .flat_map(|(name, color)| [name.to_owned(), format!("{color} {name}")])
        .collect()
}

/// Least IoU of an object with a label to count as the labelled object.
const MIN_LABEL_IOU: f64 = 0.5;

/// Adds a sample: the margins of a query at its target and at other objects.
fn add_sample<'a>(
    samples: &mut Samples,
    query: &TextQuery,
    own: &Object,
    others: impl Iterator<Item = &'a Object>,
) {
    if let Some(margin) = evidence::margin(own, query) {
        samples.add_name(
            margin,
            &others
                .filter_map(|other| evidence::margin(other, query))
                .collect::<Vec<_>>(),
        );
    }
}

/// Returns samples of texts. Names of objects are compared with all objects of their scene, and
/// absent names with all scenes.
fn by_names(
    known: &[GeneratedScene],
    absent: &[String],
    query: impl Fn(&str) -> Result<TextQuery>,
) -> Result<Samples> {
    let mut samples = Samples::default();
    for scene in known {
        for (object, name) in scene.objects() {
            add_sample(&mut samples, &query(name)?, object, scene.others(object.id));
        }
    }
    for name in absent {
        let query = query(name)?;
        samples.absent.extend(
            known
                .iter()
                .filter_map(|scene| query::best(&scene.grid, &query)),
        );
    }
    Ok(samples)
}

/// Returns samples of pictures: one view of each object, compared with its other views and with
/// other objects. Absent samples are all views of an object, compared with scenes that lack it.
fn by_examples<'a>(known: &'a [GeneratedScene]) -> Samples {
    let mut samples = Samples::default();
    let first_view_query = |object: &Object| {
        TextQuery::of_examples(vec![object.embeddings[0].clone()], Calibration::CLIP)
    };
    // A taught name also keeps all embeddings of its object.
    let all_views_query =
        |object: &Object| TextQuery::of_examples(object.embeddings.clone(), Calibration::CLIP);
    let objects_with_many_views = |scene: &'a GeneratedScene| {
        scene
            .objects()
            .filter(|(object, _)| object.embeddings.len() > 1)
    };
    for scene in known {
        for (object, _) in objects_with_many_views(scene) {
            let query = first_view_query(object);
            let rest = Object {
                embeddings: object.embeddings[1..].to_vec(),
                areas: object.areas[1..].to_vec(),
                ..object.clone()
            };
            add_sample(&mut samples, &query, &rest, scene.others(object.id));
        }
    }
    for scene in known {
        for (object, name) in objects_with_many_views(scene) {
            let lack =
                |other: &&GeneratedScene| other.objects_and_parts.iter().all(|t| t.name != name);
            let best = known
                .iter()
                .filter(lack)
                .filter_map(|other| query::best(&other.grid, &all_views_query(object)));
            samples.absent.extend(best);
        }
    }
    samples
}
