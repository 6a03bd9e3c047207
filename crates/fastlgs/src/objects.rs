//! Finds objects from masks for `train`, by global mapping, or loads the objects of an earlier run.

use crate::error::{Context, bail};
use crate::{Result, Run, detections, embedding_views, masks, model_choice};
use fastlgs_core::mask_list::{AtomTable, Atoms};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder, fs};
use fastlgs_grid::mapping::Mask;
use fastlgs_grid::objects::{self as chosen, Chosen};
use fastlgs_grid::observations::{Observation, Observations};
use fastlgs_grid::support::support;
use fastlgs_grid::{Grid, codes, consensus, election, field, overlaps};
use fastlgs_raster::density::State;
use fastlgs_raster::{Engine, View};
use fastlgs_sfm::photo_quality::{self, PhotoStats};
use fastlgs_vision::Encoder;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Options of global mapping.
#[derive(Clone)]
pub struct MappingConfig {
    /// Conditions under which an elected set is an object.
    pub objects: chosen::SelectionConfig,
    /// Whether the scene was trained with the 2-D Mip filter, which changes blending weights.
    pub antialias: bool,
}

/// Returns the path of a marker file. It exists while the object maps do not belong to the saved
/// object table.
fn unfinished(folder: &SceneFolder) -> PathBuf {
    folder.objects_path("unfinished").with_extension("txt")
}

/// Creates the marker file, before the object maps are written.
pub fn mark_maps_unfinished(folder: &SceneFolder) -> Result<()> {
    let why = "These object maps do not belong to grid.json; train the scene again.\n";
    Ok(fs::write_atomic(&unfinished(folder), |file| {
        std::io::Write::write_all(file, why.as_bytes())
    })?)
}

/// Removes the marker file, after the object table is saved.
pub fn mark_maps_finished(folder: &SceneFolder) {
    let _ = std::fs::remove_file(unfinished(folder));
}

/// Loads the objects of an earlier run.
///
/// # Errors
/// A training view has no object map, or a map does not belong to the object table or to its photo.
pub fn load_kept(folder: &SceneFolder, training: &[Camera]) -> Result<Grid> {
    let advice = || {
        format!(
            "{}: mapping 'keep' needs the objects of a trained scene; train it first",
            folder.root.display()
        )
    };
    let grid = Grid::load(folder).with_context(advice)?;
    model_choice::check_version(&folder.manifest()?, &grid, folder)?;
    if unfinished(folder).is_file() {
        bail!(
            "{}: an interrupted training left object maps that do not belong to grid.json; train the scene again",
            folder.root.display()
        );
    }
    for camera in training {
        let map = folder.objects(&camera.name).with_context(advice)?;
        if (map.width, map.height) != (camera.width, camera.height) {
            let path = folder.objects_path(&camera.name);
            let (path, map, photo) = (
                path.display(),
                [map.width, map.height],
                [camera.width, camera.height],
            );
            bail!(
                "{path}: this object map is {}x{}, but its photo is {}x{}; train the scene again",
                map[0],
                map[1],
                photo[0],
                photo[1]
            );
        }
        let highest = map.max();
        if highest > grid.highest() {
            let (path, count) = (folder.objects_path(&camera.name), grid.highest());
            bail!(
                "{}: this object map has id {highest}, but the highest id of the object table is {count}; train the scene again with mapping 'global' or 'paper'",
                path.display()
            );
        }
    }
    Ok(grid)
}

/// Result of global mapping, before the objects are embedded.
pub struct Mapped {
    /// The objects.
    pub chosen: Chosen,
    /// Number of masks, of objects, and of sets that did not become objects.
    pub summary: Summary,
}

/// Maps the masks of a scene folder onto Gaussians.
pub struct Mapper<'a> {
    /// Folder with the masks.
    pub folder: &'a SceneFolder,
    /// Cameras of the training views.
    pub cameras: &'a [Camera],
    /// Options.
    pub config: MappingConfig,
    /// The device. Its Gaussians are replaced.
    pub engine: &'a mut dyn Engine,
    /// Progress and warnings.
    pub run: &'a Run<'a>,
}

impl Mapper<'_> {
    /// Copies Gaussians to the device.
    pub fn load(&mut self, scene: &Gaussians) -> Result<()> {
        Ok(self.engine.set_state(&State::of(scene))?)
    }

    /// Returns the render settings of a camera for the loaded Gaussians, without view-dependent
    /// colour. Transparent objects are drawn as solid.
    fn view(&self, camera: &Camera) -> View {
        View::new(camera, self.engine.len(), 0)
            .with_antialias(self.config.antialias)
            .with_transparent_as_solid(true)
    }

    /// Assigns each Gaussian the objects that get more than half of its blending weight in the
    /// object maps of the views. Its feature is the code of the smallest of them.
    pub fn lift(&mut self, scene: &mut Gaussians, grid: &Grid) -> Result<()> {
        self.load(scene)?;
        let lists = grid.lists();
        let mut weights: Vec<BTreeMap<u16, f32>> = vec![Default::default(); scene.len()];
        for camera in self.cameras {
            let map = self.folder.objects(&camera.name)?;
            for vote in self.engine.votes(self.view(camera), &map)? {
                *weights[vote.gaussian as usize]
                    .entry(vote.label)
                    .or_default() += vote.weight;
            }
        }
        let majority_objects = |found: &BTreeMap<u16, f32>| {
            let mut sums: BTreeMap<Reverse<u16>, f32> = BTreeMap::new();
            for (id, weight) in found {
                lists[usize::from(*id)]
                    .iter()
                    .for_each(|object| *sums.entry(Reverse(*object)).or_default() += weight);
            }
            let all: f32 = found.values().sum();
            let objects: Vec<u16> = sums
                .into_iter()
                .filter(|(_, sum)| 2.0 * sum > all)
                .map(|(object, _)| object.0)
                .collect();
            overlaps::representative_id(
                &objects,
                found.iter().map(|(id, weight)| (*id, *weight)),
                &lists,
            )
        };
        scene.object_ids = weights.iter().map(majority_objects).collect();
        grid.set_codes(scene);
        Ok(())
    }

    /// Runs global mapping up to the objects. Masks propose sets of Gaussians and elect some of
    /// them. Those with enough support become objects, and the Gaussians get their ids. The folder
    /// needs masks and cameras.
    pub fn map(&mut self, scene: &mut Gaussians) -> Result<Mapped> {
        self.load(scene)?;
        // Mean number of pixels of a view; photos may differ in size.
        let pixels_of = |camera: &Camera| (camera.width * camera.height) as usize;
        let pixels = self.cameras.iter().map(pixels_of).sum::<usize>() / self.cameras.len();
        let clock = std::time::Instant::now();
        let log_step = |what: &str, count: usize| {
            tracing::debug!(seconds = clock.elapsed().as_secs_f64(), count, "{what}")
        };
        let (observations_by_view, tables) = self.observations()?;
        let config = &self.config.objects;
        let masks = tables.iter().map(|t| t.areas.len()).sum();
        let left_out: usize = tables.iter().map(|t| t.left_out).sum();
        if left_out > 0 {
            self.run.warn(&format!(
                "{left_out} masks were ignored, because a view can have at most 65,535 masks and atoms"
            ));
        }
        let observations = Observations::new(scene.len(), observations_by_view, &tables);
        let megabytes = (observations.bytes() >> 20) as u32;
        log_step("observations", observations.len());
        let proposals = consensus::proposals(&observations, config.min_views);
        log_step("proposals", proposals.len());
        let elected = election::elected(proposals, config.min_views);
        log_step("elected", elected.len());
        let support = support(&observations, &elected);
        log_step("support", support.len());
        let sets = elected.len();
        let chosen = chosen::choose(&observations, elected, support, pixels, config);
        log_step("objects", chosen.support.len());
        scene.object_ids.clone_from(&chosen.ids);
        let [few_views, unsupported, same] = chosen.dropped;
        let summary = Summary {
            masks,
            megabytes,
            sets,
            overlaps: chosen.overlaps.0.len(),
            few_views,
            unsupported,
            same,
        };
        Ok(Mapped { chosen, summary })
    }

    /// Writes the object map of each view, and passes it to `on_map`.
    pub fn write_maps(
        &mut self,
        scene: &Gaussians,
        mapped: &Mapped,
        mut on_map: impl FnMut(&Camera, &LabelMap) -> Result<()>,
    ) -> Result<()> {
        let folder = self.folder;
        mark_maps_unfinished(folder)?;
        self.render_maps(scene, &mapped.chosen.lists(), |camera, map| {
            map.save(&folder.objects_path(&camera.name))?;
            on_map(camera, &map)
        })
    }

    /// Renders the object map of each view, and passes it to `take`. Each pixel has the id that
    /// represents its objects; `lists` holds the objects of each id.
    pub fn render_maps(
        &mut self,
        scene: &Gaussians,
        lists: &[Vec<u16>],
        mut take: impl FnMut(&Camera, LabelMap) -> Result<()>,
    ) -> Result<()> {
        self.load(scene)?;
        let work = self.run.work("objects", self.cameras.len() as u64);
        for camera in self.cameras {
            let view = self.view(camera);
            let id_weights = self.engine.render_ids(view, &scene.object_ids)?;
            take(camera, field::ids(&id_weights, lists))?;
            work.advance()?;
        }
        Ok(())
    }

    /// Returns the observations of each view, and the table of the masks of each atom.
    fn observations(&mut self) -> Result<(Vec<Vec<Observation>>, Vec<AtomTable>)> {
        let (mut seen, mut tables) = (Vec::new(), Vec::new());
        let work = self.run.work("votes", self.cameras.len() as u64);
        for camera in self.cameras {
            let atoms = atoms(self.folder, camera)?;
            let votes = self.engine.votes(self.view(camera), &atoms.map)?;
            // A vector that is collected in place keeps the capacity of the unsummed votes.
            let mut own: Vec<Observation> = votes
                .into_iter()
                .map(|vote| Observation::new(vote.gaussian, vote.label, vote.weight))
                .collect();
            own.shrink_to_fit();
            seen.push(own);
            tables.push(atoms.table);
            work.advance()?;
        }
        Ok((seen, tables))
    }
}

/// Completes global mapping: embeds the objects of [`Mapper::map`] by the object maps that
/// [`Mapper::write_maps`] wrote, and gives the Gaussians their codes.
pub fn embed_objects(
    scene: &mut Gaussians,
    folder: &SceneFolder,
    training: &[Camera],
    Mapped { chosen, summary }: Mapped,
    run: &Run,
) -> Result<(Grid, Summary)> {
    let lists = chosen.lists();
    let embedding_views = embedding_views(scene, training, &chosen);
    let encoder = model_choice::encoder_of(folder, &folder.manifest()?)?;
    let found = embed(folder, training, &lists, &embedding_views, &*encoder, run)?;
    let object_of: Vec<u16> = found.iter().map(|mask| mask.label).collect();
    let mut grid = Grid::build(
        &found,
        &object_of,
        codes::lattice(chosen.support.len(), run.seed),
    );
    for (object, (parent, support)) in grid
        .objects
        .iter_mut()
        .zip(chosen.parents.iter().zip(&chosen.support))
    {
        (object.parent, object.support, object.views) = (*parent, support.iou, support.views.len());
    }
    if let Some(detector) = detections::detector_of(&folder.manifest()?)? {
        let votes = detections::votes(folder, training, &lists, &detector, run)?;
        for (object, votes) in grid.objects.iter_mut().zip(votes) {
            object.detected = Some(votes);
        }
    }
    (grid.overlaps, grid.id_areas, grid.encoder) = (
        chosen.overlaps,
        chosen.id_areas,
        model_choice::identity_of(&folder.manifest()?),
    );
    grid.set_codes(scene);
    Ok((grid, summary))
}

/// Embeds objects, and returns their masks; the label of a mask is its object's id.
/// `embedding_views` holds the indices of the views in which each object is embedded. `lists` holds
/// the objects of each id.
pub(crate) fn embed(
    folder: &SceneFolder,
    training: &[Camera],
    lists: &[Vec<u16>],
    embedding_views: &[Vec<usize>],
    encoder: &dyn Encoder,
    run: &Run,
) -> Result<Vec<Mask>> {
    // Objects that share Gaussians have no common map.
    let layers = overlaps::layers(lists, embedding_views.len());
    let work = run.work("embeddings", training.len() as u64);
    // Views are embedded in parallel, because one view has too few masks for many cores.
    let of_view = |(view, camera): (usize, &Camera)| -> Result<(Vec<Mask>, PhotoStats)> {
        let map = folder.objects(&camera.name)?;
        let photo = folder.photo(&camera.name)?;
        let mut found = Vec::new();
        for layer in &layers {
            let mut wanted = layer.clone();
            wanted.retain(|id| embedding_views[usize::from(*id) - 1].contains(&view));
            if !wanted.is_empty() {
                let map = map_of(&map, &wanted, lists);
                found.extend(masks::descriptors(
                    &camera.name,
                    &photo,
                    view,
                    &map,
                    encoder,
                )?);
            }
        }
        work.advance()?;
        Ok((found, PhotoStats::of(&photo)))
    };
    let (found, photo_stats): (Vec<Vec<Mask>>, Vec<PhotoStats>) = training
        .par_iter()
        .enumerate()
        .map(of_view)
        .collect::<Vec<_>>()
        .into_iter()
        .collect::<Result<Vec<_>>>()?
        .into_iter()
        .unzip();
    let mut found = found.concat();
    let sharpness = photo_quality::weights(&photo_stats);
    found
        .iter_mut()
        .for_each(|mask: &mut Mask| mask.area *= sharpness[mask.view]);
    Ok(found)
}

/// Returns the map of some objects that share no Gaussians, from the object map of a view. `lists`
/// holds the objects of each id.
fn map_of(map: &LabelMap, wanted: &BTreeSet<u16>, lists: &[Vec<u16>]) -> LabelMap {
    let object = |list: &Vec<u16>| list.iter().find(|id| wanted.contains(id)).copied();
    let of_id: Vec<u16> = lists.iter().map(|list| object(list).unwrap_or(0)).collect();
    LabelMap {
        labels: map
            .labels
            .iter()
            .map(|id| of_id[usize::from(*id)])
            .collect(),
        ..*map
    }
}

/// Summary of global mapping.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Summary {
    /// Number of masks in all views.
    pub masks: usize,
    /// Memory of the observations in MiB. It grows faster with the scene than all other data.
    pub megabytes: u32,
    /// Number of sets of Gaussians that the masks elected.
    pub sets: usize,
    /// Number of overlap lists that are not a chain of parents.
    pub overlaps: usize,
    /// Number of sets that too few views show with enough pixels.
    pub few_views: usize,
    /// Number of sets without enough support.
    pub unsupported: usize,
    /// Number of sets that nearly equal a better supported one.
    pub same: usize,
}

/// Returns the atoms of a view, with narrow gaps between masks closed.
pub fn atoms(folder: &SceneFolder, camera: &Camera) -> Result<Atoms> {
    Ok(folder.masks(camera)?.atoms().without_gaps())
}

/// Returns for each object the views in which it is embedded.
fn embedding_views(scene: &Gaussians, training: &[Camera], chosen: &Chosen) -> Vec<Vec<usize>> {
    let lists = chosen.lists();
    let mut own: Vec<Vec<usize>> = vec![Vec::new(); chosen.support.len()];
    for (i, id) in scene.object_ids.iter().enumerate() {
        for object in &lists[usize::from(*id)] {
            own[usize::from(*object) - 1].push(i);
        }
    }
    let objects = chosen.support.par_iter().zip(own);
    objects
        .map(|(support, own)| embedding_views::choose(&support.views, &own, scene, training))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use fastlgs_core::mask_list::{Mask as MaskOfView, RunLengths};
    use fastlgs_core::{Level, MaskList};
    use fastlgs_raster::CpuEngine;
    use glam::{Vec2, Vec3};

    /// Eight cameras around two balls of Gaussians. Each view has an exact mask of both.
    fn two_balls(folder: &SceneFolder) -> (Gaussians, Vec<Camera>) {
        let centres = [Vec3::new(-0.6, 0.0, 0.0), Vec3::new(0.6, 0.0, 0.0)];
        let mut scene = Gaussians::default();
        for k in 0..400 {
            let (turn, y) = (2.399_963 * k as f32, 1.0 - (2 * k + 1) as f32 / 400.0);
            let around = (1.0 - y * y).sqrt() * Vec2::from_angle(turn);
            let on_ball = 0.4 * Vec3::new(around.x, y, around.y);
            scene.push_sphere(centres[k % 2] + on_ball, 0.06, 0.95, [0.5; 3]);
        }
        let camera = |k: usize| {
            // From above, so that neither ball hides the other.
            let around = 2.0 * Vec2::from_angle(std::f32::consts::TAU * k as f32 / 8.0);
            let eye = Vec3::new(around.x, 3.0, around.y);
            Camera::look_at(&format!("{k}.png"), eye, Vec3::ZERO, Vec3::Y, 96, 72, 0.8)
        };
        let cameras: Vec<Camera> = (0..8).map(camera).collect();
        for camera in &cameras {
            let masks = centres.map(|centre| {
                let runs = RunLengths::from_fn(96, 72, |x, y| {
                    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                    let to_world = camera.world_to_camera.inverse();
                    let direction = to_world.transform_vector3(ray).normalize();
                    let offset = centre - camera.centre();
                    offset.cross(direction).length() < 0.45
                });
                MaskOfView::new(Level::Whole, runs)
            });
            let list = MaskList {
                masks: masks.into(),
                ..MaskList::new(96, 72)
            };
            list.save(&folder.masks_path(&camera.name)).unwrap();
        }
        (scene, cameras)
    }

    #[test]
    fn two_separate_masks_become_two_objects_and_their_maps_lift_back() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let (mut scene, cameras) = two_balls(&folder);
        let run = Run {
            seed: 0,
            device: "cpu",
            progress: &Silent,
        };
        let mut mapper = Mapper {
            folder: &folder,
            cameras: &cameras,
            config: MappingConfig {
                objects: chosen::SelectionConfig::default(),
                antialias: false,
            },
            engine: &mut CpuEngine::new(),
            run: &run,
        };
        let mapped = mapper.map(&mut scene).unwrap();
        assert_eq!(mapped.chosen.support.len(), 2);
        let supports: Vec<f32> = mapped.chosen.support.iter().map(|s| s.iou).collect();
        assert!(supports.iter().all(|iou| *iou > 0.6), "{supports:?}");
        let ids = scene.object_ids.clone();
        let assigned = |parity: usize| {
            let own = (parity..ids.len()).step_by(2).map(|k| ids[k]);
            own.filter(|id| *id > 0).collect::<Vec<u16>>()
        };
        // No camera sees the lower halves of the balls.
        let (lefts, rights) = (assigned(0), assigned(1));
        assert!(lefts.len() > 100 && rights.len() > 100);
        let (left, right) = (lefts[0], rights[0]);
        assert_ne!(left, right);
        assert!(lefts.iter().all(|id| *id == left) && rights.iter().all(|id| *id == right));

        let mut maps = 0;
        mapper
            .write_maps(&scene, &mapped, |_, map| {
                maps += 1;
                assert!(map.labels.contains(&left) && map.labels.contains(&right));
                Ok(())
            })
            .unwrap();
        assert_eq!(maps, cameras.len());
        // Interrupted before the object table is saved: the maps cannot be kept.
        assert!(unfinished(&folder).is_file());
        mark_maps_finished(&folder);
        assert!(!unfinished(&folder).is_file());

        let grid = Grid::build(&[], &[], codes::lattice(2, 0));
        scene.object_ids.fill(0);
        mapper.lift(&mut scene, &grid).unwrap();
        let pairs = scene.object_ids.iter().zip(&ids);
        let same = pairs.filter(|(a, b)| a == b).count();
        assert!(10 * same > 9 * ids.len(), "{same} of {}", ids.len());
    }
}
