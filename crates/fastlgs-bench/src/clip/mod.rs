//! `fastlgs-bench clip`: calibration and accuracy of text queries with real CLIP embeddings.
//!
//! The folder holds `texts.json` (names, and which of them are canonical, absent, present and
//! furniture), `texts.npy` (one row a name), and for each room `ROOM.npy` (one row an object) with
//! `ROOM.views.npy` (number of views of each object). Pairs of pictures and captions may lie beside
//! them as `NAME.images.npy` and `NAME.texts.npy`.

mod features;

use anyhow::{Result, bail};
use fastlgs::calibrations::Calibrations;
use fastlgs_core::metrics;
use fastlgs_grid::calibration::{Best, Calibration, Samples};
use fastlgs_grid::query::{self, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use fastlgs_grid::{Object, evidence};
use features::{Names, Room, embeddings, load_rooms, stems};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench clip ../shared/data/clip --json clip.json")]
pub struct Args {
    /// Folder of texts.json, texts.npy, and ROOM.npy with ROOM.views.npy for each room.
    pub folder: PathBuf,
}

/// Shares of (room, name) pairs that are found, by group of names.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Found {
    /// Names that are in every room.
    present: f64,
    /// Names that are in most rooms.
    furniture: f64,
    /// Names that are in no room.
    #[serde(skip_serializing_if = "Option::is_none")]
    absent: Option<f64>,
}

/// One room with default settings.
#[derive(Debug, Serialize)]
struct RoomRow {
    room: String,
    objects: usize,
    /// Shares with the calibration of the program.
    default: Found,
    /// Shares with a calibration from the other rooms.
    left_out: Option<Found>,
}

/// AUROC of the scores of a group against those of absent names.
#[derive(Debug, Serialize)]
struct Auroc {
    present: f64,
    furniture: f64,
}

/// Calibration from pairs of pictures and captions, without canonical phrases.
#[derive(Debug, Serialize)]
struct PairRow {
    name: String,
    pairs: usize,
    calibration: Option<Calibration>,
}

/// The figures of this bench.
#[derive(Debug, Serialize)]
pub struct Report {
    /// With default settings.
    default: Found,
    /// At thresholds that the given share of absent names pass.
    at: BTreeMap<String, Found>,
    auroc: Auroc,
    /// With default settings and a calibration from the other rooms. None with a single room.
    left_out: Option<Found>,
    /// Calibrations of texts and pictures, measured in all rooms.
    calibrations: BTreeMap<String, Option<Calibration>>,
    /// Increase of the best margin of absent names between rooms, when the number of objects grows
    /// by a factor of e, in log-odds of the program's calibration.
    growth_between_rooms: BTreeMap<String, f64>,
    /// Slope of a text's cosine on the canonical cosine, over the objects of a room.
    canonical_slope: f64,
    rooms: Vec<RoomRow>,
    pairs: Vec<PairRow>,
}

/// Accepted shares of absent names in the table.
const RATES: [f64; 3] = [0.05, 0.07, 0.20];

pub fn run(args: &Args) -> Result<Report> {
    let names = Names::load(&args.folder)?;
    let rooms = load_rooms(&args.folder, names.rows[0].len())?;
    let Calibrations { texts, pictures } = Calibrations::CLIP;
    let measured = |rooms: &[&Room]| Calibration::measured(&samples(rooms, &names), texts.anything);
    let text_samples = samples(&rooms.iter().collect::<Vec<_>>(), &names);
    let picture_samples = picture_samples(&rooms, &names);
    let rows: Vec<RoomRow> = rooms
        .iter()
        .map(|room| {
            let others: Vec<&Room> = rooms
                .iter()
                .filter(|other| other.name != room.name)
                .collect();
            RoomRow {
                room: room.name.clone(),
                objects: room.grid.objects.len(),
                default: names.found(room, texts),
                left_out: measured(&others).map(|calibration| names.found(room, calibration)),
            }
        })
        .collect();
    let scores = |group: &[String]| -> Vec<f64> {
        rooms
            .iter()
            .flat_map(|room| group.iter().map(|name| names.score(room, name, texts)))
            .collect()
    };
    let [present, furniture, absent] = [
        &names.groups.present,
        &names.groups.furniture,
        &names.groups.absent,
    ]
    .map(|g| scores(g));
    let at = RATES.map(|rate| {
        let threshold = quantile(&absent, 1.0 - rate);
        let found = Found {
            present: share_above(&present, threshold),
            furniture: share_above(&furniture, threshold),
            absent: None,
        };
        (format!("{rate:.2}"), found)
    });
    Ok(Report {
        default: mean(rows.iter().map(|row| row.default)),
        at: at.into(),
        auroc: Auroc {
            present: metrics::auroc(&present, &absent),
            furniture: metrics::auroc(&furniture, &absent),
        },
        left_out: rows
            .iter()
            .map(|row| row.left_out)
            .collect::<Option<Vec<_>>>()
            .map(|found| mean(found.into_iter())),
        calibrations: BTreeMap::from([
            (
                "texts".to_owned(),
                Calibration::measured(&text_samples, texts.anything),
            ),
            (
                "pictures".to_owned(),
                Calibration::measured(&picture_samples, pictures.anything),
            ),
        ]),
        growth_between_rooms: BTreeMap::from([
            ("texts".to_owned(), growth(&text_samples.absent, texts)),
            (
                "pictures".to_owned(),
                growth(&picture_samples.absent, pictures),
            ),
        ]),
        canonical_slope: names.canonical_slope(&rooms),
        rooms: rows,
        pairs: pairs(&args.folder)?,
    })
}

/// Returns the mean over rooms. Each room has the same number of names.
fn mean(found: impl ExactSizeIterator<Item = Found>) -> Found {
    let n = found.len() as f64;
    found.fold(Found::default(), |sum, room| Found {
        present: sum.present + room.present / n,
        furniture: sum.furniture + room.furniture / n,
        absent: Some(sum.absent.unwrap_or(0.0) + room.absent.unwrap_or(0.0) / n),
    })
}

/// Returns the value that a share of the values does not exceed, interpolated linearly.
fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = share * (sorted.len() - 1) as f64;
    let (low, high) = (
        sorted[place.floor() as usize],
        sorted[place.ceil() as usize],
    );
    low + place.fract() * (high - low)
}

/// Returns the slope of the best margins over the logarithm of the number of objects, in log-odds.
fn growth(best: &[Best], calibration: Calibration) -> f64 {
    let points = best
        .iter()
        .map(|b| ((b.objects as f64).ln(), f64::from(b.margin)));
    let n = best.len() as f64;
    let [x, y] = points
        .clone()
        .fold([0.0, 0.0], |sum, p| [sum[0] + p.0 / n, sum[1] + p.1 / n]);
    let covariance: f64 = points.clone().map(|p| (p.0 - x) * (p.1 - y)).sum();
    let variance: f64 = points.map(|p| (p.0 - x).powi(2)).sum();
    f64::from(calibration.temperature) * covariance / variance
}

fn share_above(values: &[f64], threshold: f64) -> f64 {
    values.iter().filter(|v| **v > threshold).count() as f64 / values.len() as f64
}

impl Names {
    /// Returns the score of the best object of a room.
    fn score(&self, room: &Room, name: &str, calibration: Calibration) -> f64 {
        f64::from(query::best_score(&query::rank(
            &room.grid,
            &self.query(name, calibration),
        )))
    }

    /// Returns the shares of names that default settings find in a room.
    fn found(&self, room: &Room, calibration: Calibration) -> Found {
        let share = |group: &[String]| {
            let found = |name: &&String| {
                let query = self.query(name, calibration);
                let ranked = query::rank(&room.grid, &query);
                !query::select(&room.grid, &ranked, &query, &QueryConfig::default()).is_empty()
            };
            group.iter().filter(found).count() as f64 / group.len() as f64
        };
        Found {
            present: share(&self.groups.present),
            furniture: share(&self.groups.furniture),
            absent: Some(share(&self.groups.absent)),
        }
    }

    /// Returns the slope of the cosines of absent names on the canonical cosine, over the objects
    /// of each room.
    fn canonical_slope(&self, rooms: &[Room]) -> f64 {
        let (mut covariance, mut variance) = (0.0, 0.0);
        for room in rooms {
            let objects = &room.grid.objects;
            for name in &self.groups.absent {
                let query = self.query(name, Calibrations::CLIP.texts);
                let centred = |of: &dyn Fn(&[f32]) -> f32| -> Vec<f64> {
                    let values: Vec<f64> = objects
                        .iter()
                        .map(|o| f64::from(of(&o.embeddings[0])))
                        .collect();
                    let mean = values.iter().sum::<f64>() / values.len() as f64;
                    values.iter().map(|v| v - mean).collect()
                };
                let cosines = centred(&|e| query.cosine(e));
                let canonical = centred(&|e| query.canonical(e));
                covariance += cosines
                    .iter()
                    .zip(&canonical)
                    .map(|(a, b)| a * b)
                    .sum::<f64>();
                variance += canonical.iter().map(|c| c * c).sum::<f64>();
            }
        }
        covariance / variance
    }
}

/// Returns samples of rooms. The object with the largest margin counts as the object of a present
/// name.
fn samples(rooms: &[&Room], names: &Names) -> Samples {
    let mut samples = Samples::default();
    let calibration = Calibrations::CLIP.texts;
    for room in rooms {
        for name in names.groups.present.iter().chain(&names.groups.furniture) {
            let query = names.query(name, calibration);
            let margins = room.grid.objects.iter();
            let mut margins: Vec<f32> = margins
                .filter_map(|object| evidence::margin(object, &query))
                .collect();
            margins.sort_by(|a, b| b.total_cmp(a));
            samples.add_name(margins[0], &margins[1..]);
        }
        for name in &names.groups.absent {
            samples
                .absent
                .extend(query::best(&room.grid, &names.query(name, calibration)));
        }
    }
    samples
}

/// Returns samples of pictures. The nearest object of a room stands for another view of an object,
/// because rooms hold objects in fragments and one embedding for each. Absent samples are the
/// objects of other rooms, unless both rooms have an object with the same likeliest name.
fn picture_samples(rooms: &[Room], names: &Names) -> Samples {
    let mut samples = Samples::default();
    let pictures = Calibrations::CLIP.pictures;
    let query = |object: &Object| TextQuery::of_examples(object.embeddings.clone(), pictures);
    let name_of = |object: &Object| names.likeliest(&object.embeddings[0]);
    for room in rooms {
        let objects = &room.grid.objects;
        for object in objects {
            let others = objects.iter().filter(|other| other.id != object.id);
            let query = query(object);
            let mut margins: Vec<f32> = others
                .filter_map(|other| evidence::margin(other, &query))
                .collect();
            margins.sort_by(|a, b| b.total_cmp(a));
            samples.add_name(margins[0], &margins[1..]);
        }
        for other in rooms.iter().filter(|other| other.name != room.name) {
            let there: Vec<usize> = other.grid.objects.iter().map(name_of).collect();
            let absent = objects
                .iter()
                .filter(|object| !there.contains(&name_of(object)));
            samples
                .absent
                .extend(absent.filter_map(|o| query::best(&other.grid, &query(o))));
        }
    }
    samples
}

impl Names {
    /// Returns the row of the name that is nearest to an embedding. Canonical phrases do not count.
    fn likeliest(&self, embedding: &[f32]) -> usize {
        let cosine = |row: &[f32]| row.iter().zip(embedding).map(|(a, b)| a * b).sum::<f32>();
        let named = self.groups.texts.iter().zip(&self.rows).enumerate();
        let named = named.filter(|(_, (name, _))| !self.groups.canonical.contains(name));
        named
            .map(|(place, (_, row))| (place, cosine(row)))
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(0, |best| best.0)
    }
}

/// Measures pairs of pictures and captions. All pictures form one scene. A caption is a present
/// name in it, and an absent name if its own picture is left out.
fn pairs(folder: &Path) -> Result<Vec<PairRow>> {
    let mut rows = Vec::new();
    for name in stems(folder, ".images.npy")? {
        let images = embeddings(&folder.join(format!("{name}.images.npy")))?;
        let path = folder.join(format!("{name}.texts.npy"));
        let captions = embeddings(&path)?;
        if images.len() != captions.len() || images[0].len() != captions[0].len() {
            bail!(
                "{}: row i must belong to row i of {name}.images.npy; rows and dimensions of both files must be equal",
                path.display()
            );
        }
        let cosine = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
        let mut samples = Samples::default();
        for (own, caption) in images.iter().zip(&captions) {
            // A picture with several captions repeats.
            let mut others: Vec<&Vec<f32>> = images
                .iter()
                .filter(|image| cosine(image, own) < REPEATED)
                .collect();
            others.dedup_by(|a, b| cosine(a, b) >= REPEATED);
            let others: Vec<f32> = others.iter().map(|image| cosine(image, caption)).collect();
            samples.add_name(cosine(own, caption), &others);
            samples.absent.extend(query::best_of(&others));
        }
        rows.push(PairRow {
            name,
            pairs: images.len(),
            calibration: Calibration::measured(&samples, 0.0),
        });
    }
    Ok(rows)
}

/// Cosine from which two pictures are the same.
const REPEATED: f32 = 0.9999;
