//! From masks to objects, for `train`: Algorithm 1 before training, or the views' consensus after it.

use crate::ui;
use anyhow::{Result, bail};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder};
use fastlgs_grid::mapping::{self, Mask, PaperConfig};
use fastlgs_grid::query::{self, Decision};
use fastlgs_grid::{Grid, consensus, evidence};
use fastlgs_raster::{View, lift};
use fastlgs_vision::{Conse, Encoder, histogram};

/// Objects of a scene with the object map of each training view.
pub struct Objects {
    pub grid: Grid,
    pub maps: Vec<LabelMap>,
}

/// Neighbours of each Gaussian in the consensus graph.
const NEIGHBOURS: usize = 10;
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
    let mut weights: Vec<std::collections::BTreeMap<u16, f32>> = vec![Default::default(); scene.len()];
    for (camera, map) in training.iter().zip(maps) {
        for vote in lift::votes(scene, camera, map) {
            *weights[vote.gaussian as usize].entry(vote.label).or_default() += vote.weight;
        }
    }
    let most =
        |w: &std::collections::BTreeMap<u16, f32>| w.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0))).map_or(0, |(id, _)| *id);
    scene.object_ids = weights.iter().map(most).collect();
    set_codes(scene, grid);
}

fn set_codes(scene: &mut Gaussians, grid: &Grid) {
    let code = |id: &u16| grid.objects.get(usize::from(*id).wrapping_sub(1)).map_or(glam::Vec3::ZERO, |o| o.code);
    scene.features = scene.object_ids.iter().map(code).collect();
}

/// Global mapping: the views vote over the trained Gaussians which of them form objects; the objects are then rendered
/// into every training view and embedded from those clean masks.
pub fn by_consensus(
    scene: &mut Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    config: &consensus::Config,
    common: &ui::Common,
) -> Result<Grid> {
    let bar = ui::bar(common, 2 * training.len() as u64, "objects");
    let mut seen: Vec<consensus::Seen> = vec![Vec::new(); scene.len()];
    for (view, camera) in training.iter().enumerate() {
        for vote in lift::votes(scene, camera, &whole_masks(folder, camera)?) {
            seen[vote.gaussian as usize].push(((view as u16, vote.label), vote.weight));
        }
        bar.inc(1);
    }
    let pixels = (training[0].width * training[0].height) as usize;
    let (ids, count) = consensus::objects(seen, &lift::neighbours(scene, NEIGHBOURS), pixels, config);
    scene.object_ids = ids;
    let empty = Grid::build(&[], &[], count, common.seed);
    set_codes(scene, &empty);

    let encoder = Conse::load()?;
    let mut engine = fastlgs_raster::open_engine(&common.device)?;
    let params = scene.to_channels();
    let zeros = vec![0.0; params.len()];
    engine.set_state(&params, &zeros, &zeros)?;
    let (mut masks, mut object_of) = (Vec::new(), Vec::new());
    for (view, camera) in training.iter().enumerate() {
        let frame = engine.render(View::new(camera, scene.len()))?;
        let labels = query::restore_objects(&empty, frame.channels(3, 6), Decision::Nearest);
        let mut map = LabelMap { width: camera.width, height: camera.height, labels };
        map.save(&folder.objects_path(&camera.name))?;
        let areas = map.areas();
        map.labels.iter_mut().filter(|l| areas[usize::from(**l)] < MIN_PIXELS).for_each(|l| *l = 0);
        let photo = folder.photo(&camera.name)?;
        let embeddings = encoder.embed_masks(&photo, &map)?;
        let histograms = histogram::histograms(&photo, &map);
        for (k, (embedding, histogram)) in embeddings.into_iter().zip(histograms).enumerate() {
            let label = k as u16 + 1;
            let area = areas[usize::from(label)] as f32 / pixels as f32;
            if area > 0.0 {
                masks.push(Mask { view, label, area, embedding, histogram });
                object_of.push(label);
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(Grid::build(&masks, &object_of, count, common.seed))
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
