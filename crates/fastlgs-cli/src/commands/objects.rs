//! From masks to objects, for `train`: Algorithm 1 before training, or the views' consensus after it.

use crate::{eyes, ui};
use anyhow::{Result, bail};
use fastlgs_core::color::lab;
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder};
use fastlgs_grid::mapping::{self, Mask, PaperConfig};
use fastlgs_grid::query::{self, Decision};
use fastlgs_grid::whole::{self, Look};
use fastlgs_grid::{Grid, consensus, evidence};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, View, lift};
use fastlgs_vision::{Conse, Encoder, exposure, histogram, segmenter};
use image::RgbImage;
use std::collections::BTreeMap;

/// Objects of a scene with the object map of each training view.
pub struct Objects {
    pub grid: Grid,
    pub maps: Vec<LabelMap>,
}

/// Constants of global mapping.
pub struct Config {
    pub consensus: consensus::Config,
    /// Likeness from which touching regions are one object.
    pub likeness: f32,
}

/// Neighbours of each Gaussian in the consensus graph.
const NEIGHBOURS: usize = 10;
/// Longer side of the photos whose meaning is taken: the encoder's objects fill some cells there.
const MEANING_SIDE: u32 = 480;
/// Views in which an object is embedded: those that show most of it.
const EMBEDDED_VIEWS: usize = 10;
/// Smallest part of a photo, in pixels, that is worth embedding.
const MIN_PIXELS: usize = 60;

/// Algorithm 1 of the paper over the masks that preprocessing left; writes the object maps.
pub fn by_algorithm_1(folder: &SceneFolder, training: &[Camera], config: &PaperConfig, seed: u64) -> Result<Objects> {
    let (masks, pairs) = evidence::load(folder)?;
    let (object_of, count) = mapping::paper(&masks, &pairs, config);
    let mut maps = Vec::new();
    for (view, camera) in training.iter().enumerate() {
        let labels = whole_masks(folder, camera)?;
        let mut table = vec![0u16; usize::from(labels.max()) + 1];
        for (mask, object) in masks.iter().zip(&object_of).filter(|(m, _)| m.view == view) {
            if let Some(entry) = table.get_mut(usize::from(mask.label)) {
                *entry = *object;
            }
        }
        let map = LabelMap { labels: labels.labels.iter().map(|l| table[usize::from(*l)]).collect(), ..labels };
        map.save(&folder.objects_path(&camera.name))?;
        maps.push(map);
    }
    Ok(Objects { grid: Grid::build(&masks, &object_of, count, seed), maps })
}

/// Gives every Gaussian the object that most of its blending weight falls on, and that object's code.
pub fn lift(scene: &mut Gaussians, training: &[Camera], maps: &[LabelMap], grid: &Grid) {
    let mut weights: Vec<BTreeMap<u16, f32>> = vec![Default::default(); scene.len()];
    for (camera, map) in training.iter().zip(maps) {
        for vote in lift::votes(scene, camera, map) {
            *weights[vote.gaussian as usize].entry(vote.label).or_default() += vote.weight;
        }
    }
    let most = |w: &BTreeMap<u16, f32>| w.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0))).map_or(0, |(id, _)| *id);
    scene.object_ids = weights.iter().map(most).collect();
    grid.set_codes(scene);
}

/// Global mapping: the views vote over the trained Gaussians which of them form regions, regions of like meaning become
/// objects where the segmenter knows none, and the objects are rendered into every training view and embedded from
/// those clean masks.
pub fn by_consensus(
    scene: &mut Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    config: &Config,
    common: &ui::Common,
) -> Result<Grid> {
    let clock = std::time::Instant::now();
    let bar = ui::bar(common, training.len() as u64, "votes");
    let mut seen: Vec<consensus::Seen> = vec![Vec::new(); scene.len()];
    for (view, camera) in training.iter().enumerate() {
        for vote in lift::votes(scene, camera, &whole_masks(folder, camera)?) {
            seen[vote.gaussian as usize].push(((view as u16, vote.label), vote.weight));
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    tracing::debug!(seconds = clock.elapsed().as_secs_f64(), "votes");
    let pixels = (training[0].width * training[0].height) as usize;
    let regions = consensus::regions(seen, &lift::neighbours(scene, NEIGHBOURS), pixels, &config.consensus);
    tracing::debug!(seconds = clock.elapsed().as_secs_f64(), regions = regions.seen.len(), "consensus");

    let manifest = folder.manifest()?;
    let encoder = eyes::encoder_of(folder, &manifest)?;
    let mut engine = fastlgs_raster::open_engine(&common.device)?;
    let mut paint = |scene: &mut Gaussians, count: u16| -> Result<Vec<LabelMap>> {
        let codes = Grid::build(&[], &[], count, common.seed);
        codes.set_codes(scene);
        engine.set_state(&State::of(scene))?;
        let map = |camera: &Camera| {
            let frame = engine.render(View::new(camera, scene.len(), 0), Channels::Feature)?;
            let labels = query::restore_objects(&codes, frame.channels(3, 6), Decision::Nearest);
            Ok(LabelMap { width: camera.width, height: camera.height, labels })
        };
        training.iter().map(map).collect()
    };
    scene.object_ids = regions.of.clone();
    let mut count = regions.seen.len() as u16;
    if manifest.segmenter == "offline" {
        let maps = paint(scene, count)?;
        let looks = looks(folder, training, &maps, count, &Conse::load()?, common)?;
        let (object, objects) = whole::join(&regions, looks, config.likeness);
        scene.object_ids = regions.of.iter().map(|r| if *r > 0 { object[usize::from(*r) - 1] } else { 0 }).collect();
        count = objects;
        tracing::debug!(seconds = clock.elapsed().as_secs_f64(), objects, "whole objects");
    }
    let maps = paint(scene, count)?;
    let bar = ui::bar(common, training.len() as u64, "embeddings");
    let chosen = best_views(&maps, count);
    let (mut masks, mut object_of) = (Vec::new(), Vec::new());
    for (view, (camera, mut map)) in training.iter().zip(maps).enumerate() {
        map.save(&folder.objects_path(&camera.name))?;
        map.labels.iter_mut().filter(|l| **l > 0 && !chosen[usize::from(**l) - 1].contains(&view)).for_each(|l| *l = 0);
        let found = masks_of(&camera.name, &folder.photo(&camera.name)?, view, &map, encoder.as_ref())?;
        object_of.extend(found.iter().map(|m| m.label));
        masks.extend(found);
        bar.inc(1);
    }
    bar.finish_and_clear();
    tracing::debug!(seconds = clock.elapsed().as_secs_f64(), "embeddings");
    Ok(Grid::build(&masks, &object_of, count, common.seed))
}

/// The views that show most of each object.
fn best_views(maps: &[LabelMap], count: u16) -> Vec<Vec<usize>> {
    let mut seen: Vec<Vec<(usize, usize)>> = vec![Vec::new(); usize::from(count)];
    for (view, map) in maps.iter().enumerate() {
        for (label, area) in map.areas().into_iter().enumerate().skip(1).filter(|a| a.1 >= MIN_PIXELS) {
            seen[label - 1].push((area, view));
        }
    }
    for views in &mut seen {
        views.sort_by_key(|&(area, view)| (std::cmp::Reverse(area), view));
        views.truncate(EMBEDDED_VIEWS);
    }
    seen.into_iter().map(|views| views.into_iter().map(|v| v.1).collect()).collect()
}

/// Embedding and colour distribution of every mask of a photo, by label.
pub fn masks_of(name: &str, photo: &RgbImage, view: usize, map: &LabelMap, encoder: &dyn Encoder) -> Result<Vec<Mask>> {
    let embeddings = encoder.embed_masks(name, photo, map)?;
    let histograms = histogram::histograms(photo, map);
    let areas = map.areas();
    let masks = embeddings.into_iter().zip(histograms).enumerate().map(|(k, (embedding, histogram))| {
        let area = areas[k + 1] as f32 / map.labels.len() as f32;
        Mask { view, label: k as u16 + 1, area, embedding, histogram }
    });
    Ok(masks.filter(|m| m.area > 0.0).collect())
}

/// Colour and meaning of each region over all pixels of all views.
fn looks(
    folder: &SceneFolder,
    training: &[Camera],
    maps: &[LabelMap],
    count: u16,
    encoder: &Conse,
    common: &ui::Common,
) -> Result<Vec<Look>> {
    let bar = ui::bar(common, training.len() as u64, "meanings");
    let mut looks = vec![Look::default(); usize::from(count)];
    for (camera, map) in training.iter().zip(maps) {
        let photo = exposure::lifted(&folder.photo(&camera.name)?);
        let dense = encoder.dense(&segmenter::at_side(&photo, MEANING_SIDE))?;
        // How many pixels of a region each cell holds.
        let mut shares: BTreeMap<(u16, usize), f32> = BTreeMap::new();
        for ((p, label), pixel) in map.labels.iter().enumerate().zip(photo.pixels()).filter(|((_, l), _)| **l > 0) {
            let (x, y) = (p % map.width as usize, p / map.width as usize);
            let cell = y * dense.rows / map.height as usize * dense.columns + x * dense.columns / map.width as usize;
            *shares.entry((*label, cell)).or_default() += 1.0;
            let look = &mut looks[usize::from(*label) - 1];
            look.pixels += 1.0;
            look.color.iter_mut().zip(lab(pixel.0)).for_each(|(sum, v)| *sum += v);
        }
        for ((label, cell), share) in shares {
            let sum = &mut looks[usize::from(label) - 1].meaning;
            sum.resize(dense.channels, 0.0);
            sum.iter_mut().zip(&dense.values[cell * dense.channels..]).for_each(|(s, v)| *s += share * v);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(looks)
}

/// The segmenter's masks of a view, which must fit its camera.
fn whole_masks(folder: &SceneFolder, camera: &Camera) -> Result<LabelMap> {
    let path = folder.masks_path("whole", &camera.name);
    let map = LabelMap::load(&path)?;
    if (map.width, map.height) != (camera.width, camera.height) {
        bail!("{}: it does not fit the view's camera; run 'fastlgs preprocess' again", path.display());
    }
    Ok(map)
}
