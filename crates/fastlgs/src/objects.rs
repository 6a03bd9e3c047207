//! From masks to objects, for `train`: Algorithm 1 before training, the views' consensus after it, or those of an earlier run.

use crate::error::{Context, bail};
use crate::{Result, Run, eyes, masks};
use fastlgs_core::mask_list::{Atoms, Table};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder, fs};
use fastlgs_grid::mapping::{self, Mask, PaperConfig};
use fastlgs_grid::objects::{self as chosen, Chosen};
use fastlgs_grid::sightings::{Sighting, Sightings};
use fastlgs_grid::support::support;
use fastlgs_grid::{Grid, codes, consensus, election, evidence, field, overlaps};
use fastlgs_raster::density::State;
use fastlgs_raster::{View, lift};
use fastlgs_vision::photo_quality::{self, Impression};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Constants of global mapping.
pub struct Config {
    /// When a set that masks elected is an object.
    pub objects: chosen::Config,
    /// Whether the scene was trained with the 2-D Mip filter, which changes what Gaussians weigh.
    pub antialias: bool,
}

/// Views in which an object is embedded: those that show most of it.
const EMBEDDED_VIEWS: usize = 3;

/// Algorithm 1 of the paper over the masks that preprocessing left; writes the object maps.
pub fn by_algorithm_1(folder: &SceneFolder, training: &[Camera], config: &PaperConfig, run: &Run) -> Result<Grid> {
    let masks = masks::evidence(folder, training, run)?;
    let pairs = evidence::load_pairs(folder, &masks)?;
    let manifest = folder.manifest()?;
    // By kinds of things: by single things the masks of fox fall into twice as many objects (theta 0.6 to 0.8: oracle 0.45, 0.45, 0.43; by kinds 0.48).
    let mut compared = masks.clone();
    compared.iter_mut().for_each(|mask| mask.embedding = eyes::for_words(&manifest, std::mem::take(&mut mask.embedding)));
    let mapping::Mapped { object_of, count, comparisons } = mapping::paper(&compared, &pairs, config)?;
    tracing::debug!(masks = masks.len(), count, comparisons, "Algorithm 1");
    begin_maps(folder)?;
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
    }
    let encoder = eyes::identity_of(&manifest);
    Ok(Grid { encoder, ..Grid::build(&masks, &object_of, codes::lattice(usize::from(count), run.seed)) })
}

/// What is there while object maps do not belong to the scene's table of objects.
fn unfinished(folder: &SceneFolder) -> PathBuf {
    folder.objects_path("unfinished").with_extension("txt")
}

/// Object maps are being written, and the table of these objects is not saved.
fn begin_maps(folder: &SceneFolder) -> Result<()> {
    let why = "These maps and grid.json are not of one training.\n";
    Ok(fs::write_atomic(&unfinished(folder), |file| std::io::Write::write_all(file, why.as_bytes()))?)
}

/// The table of the objects that the maps show is saved.
pub fn end_maps(folder: &SceneFolder) {
    let _ = std::fs::remove_file(unfinished(folder));
}

/// The objects that an earlier run found, whose maps must be there for all training views.
pub fn kept(folder: &SceneFolder, training: &[Camera]) -> Result<Grid> {
    let advice = || format!("{}: --mapping keep needs the objects of a trained scene; train it first", folder.root.display());
    let grid = Grid::load(folder).with_context(advice)?;
    eyes::check_version(&folder.manifest()?, &grid, folder)?;
    if unfinished(folder).is_file() {
        bail!("{}: a training that was broken off left object maps that are not those of grid.json; train it again", folder.root.display());
    }
    for camera in training {
        let map = folder.objects(&camera.name).with_context(advice)?;
        if (map.width, map.height) != (camera.width, camera.height) {
            let path = folder.objects_path(&camera.name);
            let (path, map, photo) = (path.display(), [map.width, map.height], [camera.width, camera.height]);
            bail!("{path}: it is {}x{}, the photo {}x{}; train the scene again", map[0], map[1], photo[0], photo[1]);
        }
        let highest = map.max();
        if highest > grid.highest() {
            let (path, count) = (folder.objects_path(&camera.name), grid.highest());
            bail!("{}: it shows object {highest} of {count}; train the scene again with --mapping global or paper", path.display());
        }
    }
    Ok(grid)
}

/// The frame of a camera without what depends on the viewing direction.
fn frame(scene: &Gaussians, camera: &Camera, antialias: bool) -> View {
    View { antialias: u32::from(antialias), solid: 1, ..View::new(camera, scene.len(), 0) }
}

/// Gives every Gaussian the objects of the views' object maps that most of its blending weight falls on, and the smallest one's code.
pub fn lift(scene: &mut Gaussians, folder: &SceneFolder, training: &[Camera], grid: &Grid, antialias: bool) -> Result<()> {
    let lists = grid.lists();
    let mut weights: Vec<BTreeMap<u16, f32>> = vec![Default::default(); scene.len()];
    for camera in training {
        for vote in lift::votes(scene, &frame(scene, camera, antialias), &folder.objects(&camera.name)?) {
            *weights[vote.gaussian as usize].entry(vote.label).or_default() += vote.weight;
        }
    }
    let most = |found: &BTreeMap<u16, f32>| {
        let mut sums: BTreeMap<Reverse<u16>, f32> = BTreeMap::new();
        for (id, weight) in found {
            lists[usize::from(*id)].iter().for_each(|object| *sums.entry(Reverse(*object)).or_default() += weight);
        }
        let all: f32 = found.values().sum();
        let objects: Vec<u16> = sums.into_iter().filter(|(_, sum)| 2.0 * sum > all).map(|(object, _)| object.0).collect();
        overlaps::standing_for(&objects, found.iter().map(|(id, weight)| (*id, *weight)), &lists)
    };
    scene.object_ids = weights.iter().map(most).collect();
    grid.set_codes(scene);
    Ok(())
}

/// What global mapping makes of masks, before its objects are embedded.
pub struct Mapped {
    /// The objects.
    pub chosen: Chosen,
    /// What was found, and what was not.
    pub summary: Summary,
}

/// Global mapping up to the objects: masks propose sets of Gaussians and elect some of them, and those that masks support become the objects, whose
/// numbers the Gaussians get. The folder needs masks and cameras.
pub fn map(scene: &mut Gaussians, folder: &SceneFolder, training: &[Camera], config: &Config, run: &Run) -> Result<Mapped> {
    // Photos may differ in size.
    let pixels = training.iter().map(|c| (c.width * c.height) as usize).sum::<usize>() / training.len();
    let clock = std::time::Instant::now();
    let told = |what: &str, count: usize| tracing::debug!(seconds = clock.elapsed().as_secs_f64(), count, "{what}");
    let (seen, tables) = sightings(scene, folder, training, config.antialias, run)?;
    let masks = tables.iter().map(|t| t.areas.len()).sum();
    let left_out: usize = tables.iter().map(|t| t.left_out).sum();
    if left_out > 0 {
        run.warn(&format!("{left_out} masks cut others into more pieces than can be numbered; they were left out"));
    }
    let sightings = Sightings::new(scene.len(), seen, &tables);
    let megabytes = (sightings.bytes() >> 20) as u32;
    told("sightings", sightings.len());
    let proposals = consensus::proposals(&sightings, config.objects.min_views);
    told("proposals", proposals.len());
    let elected = election::elected(proposals, config.objects.min_views);
    told("elected", elected.len());
    let support = support(&sightings, &elected);
    told("support", support.len());
    let sets = elected.len();
    let chosen = chosen::choose(&sightings, elected, support, pixels, &config.objects);
    told("objects", chosen.support.len());
    scene.object_ids.clone_from(&chosen.ids);
    let [few_views, unsupported, same] = chosen.dropped;
    let summary = Summary { masks, megabytes, sets, overlaps: chosen.overlaps.0.len(), few_views, unsupported, same };
    Ok(Mapped { chosen, summary })
}

/// Global mapping: the objects of [`map`], each embedded as the object maps show it that [`write_maps`] left.
pub fn by_consensus(
    scene: &mut Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    Mapped { chosen, summary }: Mapped,
    run: &Run,
) -> Result<(Grid, Summary)> {
    let lists = chosen.lists();
    let areas: Vec<&[(u32, u32)]> = chosen.support.iter().map(|s| s.areas.as_slice()).collect();
    let (found, of_found) = embed(folder, training, &chosen.layers(), &lists, &best_views(&areas), run)?;
    let mut grid = Grid::build(&found, &of_found, codes::lattice(chosen.support.len(), run.seed));
    for (object, (parent, support)) in grid.objects.iter_mut().zip(chosen.parents.iter().zip(&chosen.support)) {
        (object.parent, object.support, object.views) = (*parent, support.iou, support.areas.len());
    }
    (grid.overlaps, grid.shown, grid.encoder) = (chosen.overlaps, chosen.shown, eyes::identity_of(&folder.manifest()?));
    grid.set_codes(scene);
    Ok((grid, summary))
}

/// Writes the object map of each view, and tells of it.
pub fn write_maps(
    scene: &Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    mapped: &Mapped,
    antialias: bool,
    run: &Run,
    mut tell: impl FnMut(&Camera, &LabelMap) -> Result<()>,
) -> Result<()> {
    begin_maps(folder)?;
    render_maps(scene, training, &mapped.chosen.lists(), antialias, run, |camera, map| {
        map.save(&folder.objects_path(&camera.name))?;
        tell(camera, &map)
    })
}

/// Gives the object map of each view to `take`: at each pixel the id that stands for the objects there.
pub fn render_maps(
    scene: &Gaussians,
    training: &[Camera],
    lists: &[Vec<u16>],
    antialias: bool,
    run: &Run,
    mut take: impl FnMut(&Camera, LabelMap) -> Result<()>,
) -> Result<()> {
    let mut engine = fastlgs_raster::open_engine(run.device)?;
    engine.set_state(&State::of(scene))?;
    let work = run.work("objects", training.len() as u64);
    for camera in training {
        let shares = engine.render_ids(frame(scene, camera, antialias), &scene.object_ids)?;
        take(camera, field::ids(&shares, lists))?;
        work.advance()?;
    }
    Ok(())
}

/// Embeds every object as its best views show it.
fn embed(
    folder: &SceneFolder,
    training: &[Camera],
    layers: &[BTreeSet<u16>],
    lists: &[Vec<u16>],
    shown: &[Vec<usize>],
    run: &Run,
) -> Result<(Vec<Mask>, Vec<u16>)> {
    let encoder = eyes::encoder_of(folder, &folder.manifest()?)?;
    let work = run.work("embeddings", training.len() as u64);
    // All views at once: the masks of one are too few for many cores.
    let of_view = |(view, camera): (usize, &Camera)| -> Result<(Vec<Mask>, Impression)> {
        let map = folder.objects(&camera.name)?;
        let photo = folder.photo(&camera.name)?;
        let mut found = Vec::new();
        for layer in layers {
            let wanted: BTreeSet<u16> = layer.iter().copied().filter(|id| shown[usize::from(*id) - 1].contains(&view)).collect();
            if wanted.is_empty() {
                continue;
            }
            let on_layer: Vec<u16> = lists.iter().map(|list| list.iter().find(|id| wanted.contains(id)).copied().unwrap_or(0)).collect();
            let labels = map.labels.iter().map(|l| on_layer[usize::from(*l)]).collect();
            found.extend(masks::described(&camera.name, &photo, view, &LabelMap { labels, ..map }, encoder.as_ref())?);
        }
        work.advance()?;
        Ok((found, Impression::of(&photo)))
    };
    let (found, impressions): (Vec<Vec<Mask>>, Vec<Impression>) =
        training.par_iter().enumerate().map(of_view).collect::<Vec<_>>().into_iter().collect::<Result<Vec<_>>>()?.into_iter().unzip();
    let mut found = found.concat();
    let object_of = found.iter().map(|mask| mask.label).collect();
    let sharpness = photo_quality::weights(&impressions);
    found.iter_mut().for_each(|mask: &mut Mask| mask.area *= sharpness[mask.view]);
    Ok((found, object_of))
}

/// What global mapping found, and why sets are no objects.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Summary {
    /// Masks of all views.
    pub masks: usize,
    /// Memory that the pairs of Gaussians and masks' atoms took: what grows most.
    pub megabytes: u32,
    /// Sets of Gaussians that the masks elected.
    pub sets: usize,
    /// Ways in which objects overlap that no tree of them has.
    pub overlaps: usize,
    /// Sets of which too few views show enough pixels.
    pub few_views: usize,
    /// Sets that no masks support.
    pub unsupported: usize,
    /// Sets that are the same as another.
    pub same: usize,
}

/// Where the masks of a view end.
pub fn atoms(folder: &SceneFolder, camera: &Camera) -> Result<Atoms> {
    Ok(folder.masks(camera)?.atoms().without_gaps())
}

/// How much of each Gaussian falls on the atoms of each view's masks, and which masks these lie in.
fn sightings(
    scene: &Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    antialias: bool,
    run: &Run,
) -> Result<(Vec<Vec<Sighting>>, Vec<Table>)> {
    let (mut seen, mut tables) = (Vec::new(), Vec::new());
    let work = run.work("votes", training.len() as u64);
    for camera in training {
        let atoms = atoms(folder, camera)?;
        let votes = lift::votes(scene, &frame(scene, camera, antialias), &atoms.map);
        // Collected in place, they would keep the room of all that was summed up to them.
        let mut own: Vec<Sighting> = votes.into_iter().map(|vote| Sighting::new(vote.gaussian, vote.label, vote.weight)).collect();
        own.shrink_to_fit();
        seen.push(own);
        tables.push(atoms.table);
        work.advance()?;
    }
    Ok((seen, tables))
}

/// The views that show most of each object.
fn best_views(areas: &[&[(u32, u32)]]) -> Vec<Vec<usize>> {
    let best = |areas: &&[(u32, u32)]| {
        let mut areas = areas.to_vec();
        areas.sort_by_key(|&(area, view)| (std::cmp::Reverse(area), view));
        areas.into_iter().take(EMBEDDED_VIEWS).map(|a| a.1 as usize).collect()
    };
    areas.iter().map(best).collect()
}
