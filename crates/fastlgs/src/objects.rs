//! From masks to objects, for `train`: Algorithm 1 before training, the views' consensus after it, or those of an earlier run.

use crate::error::{Context, bail};
use crate::{Result, Run, eyes, masks};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder};
use fastlgs_grid::consensus::{self, Seen};
use fastlgs_grid::mapping::{self, Mask, PaperConfig};
use fastlgs_grid::tree::{self, Chosen, Tree};
use fastlgs_grid::{Grid, codes, evidence};
use fastlgs_raster::density::State;
use fastlgs_raster::{View, lift};
use fastlgs_vision::Level;
use fastlgs_vision::photo_quality::{self, Impression};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Constants of global mapping.
pub struct Config {
    /// When Gaussians form a region.
    pub consensus: consensus::Config,
    /// When a node of the tree is an object.
    pub objects: tree::Config,
}

/// Neighbours of each Gaussian in the consensus graph.
const NEIGHBOURS: usize = 10;
/// Views in which an object is embedded: those that show most of it.
const EMBEDDED_VIEWS: usize = 5;

/// Algorithm 1 of the paper over the masks that preprocessing left; writes the object maps.
pub fn by_algorithm_1(folder: &SceneFolder, training: &[Camera], config: &PaperConfig, seed: u64) -> Result<Grid> {
    let (masks, pairs) = evidence::load(folder)?;
    let mapping::Mapped { object_of, count, comparisons } = mapping::paper(&masks, &pairs, config)?;
    tracing::debug!(masks = masks.len(), count, comparisons, "Algorithm 1");
    let mut contacts = BTreeSet::new();
    for (view, camera) in training.iter().enumerate() {
        let labels = masks::whole(folder, camera)?;
        let mut table = vec![0u16; usize::from(labels.max()) + 1];
        for (mask, object) in masks.iter().zip(&object_of).filter(|(m, _)| m.view == view) {
            if let Some(entry) = table.get_mut(usize::from(mask.label)) {
                *entry = *object;
            }
        }
        let map = LabelMap { labels: labels.labels.iter().map(|l| table[usize::from(*l)]).collect(), ..labels };
        map.save(&folder.objects_path(&camera.name))?;
        contacts.extend(map.contacts());
    }
    Ok(Grid::build(&masks, &object_of, codes::separated(usize::from(count), &contacts, seed)))
}

/// The objects that an earlier run found, whose maps must be there for all training views.
pub fn kept(folder: &SceneFolder, training: &[Camera]) -> Result<Grid> {
    let advice = || format!("{}: --mapping keep needs the objects of a trained scene; train it first", folder.root.display());
    let grid = Grid::load(folder).with_context(advice)?;
    for camera in training {
        let highest = folder.objects(&camera.name).with_context(advice)?.max();
        if usize::from(highest) > grid.objects.len() {
            let (path, count) = (folder.objects_path(&camera.name), grid.objects.len());
            bail!("{}: it shows object {highest} of {count}; train the scene again with --mapping global or paper", path.display());
        }
    }
    Ok(grid)
}

/// Gives every Gaussian the object of the views' object maps that most of its blending weight falls on, and that object's code.
pub fn lift(scene: &mut Gaussians, folder: &SceneFolder, training: &[Camera], grid: &Grid) -> Result<()> {
    let mut weights: Vec<BTreeMap<u16, f32>> = vec![Default::default(); scene.len()];
    for camera in training {
        for vote in lift::votes(scene, camera, &folder.objects(&camera.name)?) {
            *weights[vote.gaussian as usize].entry(vote.label).or_default() += vote.weight;
        }
    }
    let most = |w: &BTreeMap<u16, f32>| w.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0))).map_or(0, |(id, _)| *id);
    scene.object_ids = weights.iter().map(most).collect();
    grid.set_codes(scene);
    Ok(())
}

/// Global mapping: the views vote over the trained Gaussians which of them form regions and parts of regions, a tree grows
/// over these, its nodes that masks support become the objects, and each is embedded as the views show it.
pub fn by_consensus(
    scene: &mut Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    config: &Config,
    run: &Run,
) -> Result<(Grid, Summary)> {
    let pixels = (training[0].width * training[0].height) as usize;
    let clock = std::time::Instant::now();
    let told = |what: &str, count: usize| tracing::debug!(seconds = clock.elapsed().as_secs_f64(), count, "{what}");
    let [whole, part] = votes(scene, folder, training, run)?;
    told("votes", training.len());
    let near = lift::neighbours(scene, NEIGHBOURS);
    let regions = consensus::regions(whole, &near, pixels, &config.consensus);
    told("regions", regions.seen.len());
    let inside: Vec<(u32, u32)> = near.into_iter().filter(|&(a, b)| regions.of[a as usize] == regions.of[b as usize]).collect();
    let parts = consensus::regions(part, &inside, pixels, &config.consensus);
    told("parts", parts.seen.len());
    let tree = Tree::grow(&regions, &parts);

    let mut engine = fastlgs_raster::open_engine(run.device)?;
    engine.set_state(&State::of(scene))?;
    let work = run.work("objects", training.len() as u64);
    for camera in training {
        let shares = engine.render_ids(View::new(camera, scene.len(), 0), &tree.of)?;
        shares.winners().save(&folder.objects_path(&camera.name))?;
        work.advance()?;
    }
    let load = |view: usize| -> Result<(LabelMap, Vec<LabelMap>)> {
        let camera = &training[view];
        let levels = Level::ALL.iter().filter_map(|level| masks::of_level(folder, camera, *level).transpose()).collect::<Result<_>>()?;
        Ok((folder.objects(&camera.name)?, levels))
    };
    let support = tree::support(&tree, training.len(), load)?;
    let chosen = tree::choose(&tree, &support, pixels, &config.objects);
    told("objects", chosen.nodes.len());
    scene.object_ids = tree.of.iter().map(|node| chosen.object(*node)).collect();

    let areas: Vec<&[(u32, usize)]> = chosen.nodes.iter().map(|n| support[*n].areas.as_slice()).collect();
    let (found, object_of) = embed(folder, training, &chosen, &best_views(&areas), run)?;
    told("embeddings", found.len());
    let mut grid = Grid::build(&found, &object_of, codes::lattice(chosen.nodes.len(), run.seed));
    for (object, (parent, node)) in grid.objects.iter_mut().zip(chosen.parents.iter().zip(&chosen.nodes)) {
        (object.parent, object.support, object.views) = (*parent, support[*node].iou, support[*node].areas.len());
    }
    grid.set_codes(scene);
    let [few_views, small, unsupported, same] = chosen.dropped;
    Ok((grid, Summary { regions: regions.seen.len(), parts: parts.seen.len(), few_views, small, unsupported, same }))
}

/// Embeds every object as its best views show it; also writes the object maps of all views.
fn embed(folder: &SceneFolder, training: &[Camera], chosen: &Chosen, shown: &[Vec<usize>], run: &Run) -> Result<(Vec<Mask>, Vec<u16>)> {
    let encoder = eyes::encoder_of(folder, &folder.manifest()?)?;
    let layers = chosen.layers();
    let work = run.work("embeddings", training.len() as u64);
    let (mut found, mut object_of, mut impressions) = (Vec::new(), Vec::new(), Vec::new());
    for (view, camera) in training.iter().enumerate() {
        let mut map = folder.objects(&camera.name)?;
        map.labels.iter_mut().for_each(|l| *l = chosen.object(*l));
        map.save(&folder.objects_path(&camera.name))?;
        let photo = folder.photo(&camera.name)?;
        for layer in &layers {
            let on_layer = chosen.ancestors_on(layer, |id| shown[usize::from(id) - 1].contains(&view));
            let labels = map.labels.iter().map(|l| on_layer[usize::from(*l)]).collect();
            let masks = masks::described(&camera.name, &photo, view, &LabelMap { labels, ..map }, encoder.as_ref())?;
            object_of.extend(masks.iter().map(|m| m.label));
            found.extend(masks);
        }
        impressions.push(Impression::of(&photo));
        work.advance()?;
    }
    let sharpness = photo_quality::weights(&impressions);
    found.iter_mut().for_each(|mask: &mut Mask| mask.area *= sharpness[mask.view]);
    Ok((found, object_of))
}

/// What global mapping found, and why nodes of the tree are no objects.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Summary {
    /// Regions of Gaussians that the views agree on.
    pub regions: usize,
    /// Parts of these.
    pub parts: usize,
    /// Nodes that too few views show.
    pub few_views: usize,
    /// Nodes that are too small.
    pub small: usize,
    /// Nodes that no masks support.
    pub unsupported: usize,
    /// Nodes that are the same as another.
    pub same: usize,
}

/// What each Gaussian sees of the whole masks and of the parts, in one pass over the views.
fn votes(scene: &Gaussians, folder: &SceneFolder, training: &[Camera], run: &Run) -> Result<[Vec<Seen>; 2]> {
    let mut seen = [vec![Seen::new(); scene.len()], vec![Seen::new(); scene.len()]];
    let work = run.work("votes", training.len() as u64);
    for (view, camera) in training.iter().enumerate() {
        let whole = masks::whole(folder, camera)?;
        let part = masks::of_level(folder, camera, Level::Part)?.unwrap_or_else(|| whole.clone());
        let (joint, pairs) = whole.joint(&part);
        for vote in lift::votes(scene, camera, &joint) {
            let (whole, part) = pairs[usize::from(vote.label)];
            for (seen, label) in seen.iter_mut().zip([whole, part]) {
                let own = &mut seen[vote.gaussian as usize];
                let key = (view as u16, label);
                match own.binary_search_by_key(&key, |s| s.0) {
                    Ok(place) => own[place].1 += vote.weight,
                    Err(place) => own.insert(place, (key, vote.weight)),
                }
            }
        }
        work.advance()?;
    }
    Ok(seen)
}

/// The views that show most of each object.
fn best_views(areas: &[&[(u32, usize)]]) -> Vec<Vec<usize>> {
    let best = |areas: &&[(u32, usize)]| {
        let mut areas = areas.to_vec();
        areas.sort_by_key(|&(area, view)| (std::cmp::Reverse(area), view));
        areas.into_iter().take(EMBEDDED_VIEWS).map(|a| a.1).collect()
    };
    areas.iter().map(best).collect()
}
