//! Trains Gaussians to end at the borders of masks.
//!
//! Blurred photos, or neighbours of one colour, do not show where an object ends; masks do. Early
//! in training, the objects of the current Gaussians are found. From then on, every view also has a
//! target image of object codes, made from its masks. The code of an object is far from those of
//! its neighbours. After training, the objects are found again.

use crate::error::Context;
use crate::progress::{Message, Sink};
use crate::{Result, Run, objects};
use fastlgs_core::{Gaussians, LabelMap, SceneFolder, fs, image_io};
use fastlgs_raster::{Trainer, pack};
use glam::Vec3;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Share of the iterations after which masks guide training. Density control is then still active,
/// so that borders get the Gaussians that they need.
const MASKS_FROM: f32 = 0.15;

/// Returns the iteration after which masks guide training. `Trainer::run` reports this iteration.
pub fn begin_at(iterations: u32) -> u32 {
    ((iterations as f32 * MASKS_FROM) as u32).max(1)
}

/// Returns the path of a file of the mask targets. They lie beside the checkpoints, so that an
/// interrupted run can continue.
fn target_path(folder: &SceneFolder, name: &str) -> PathBuf {
    folder.root.join("checkpoints/borders").join(name)
}

/// Finds the objects of the current Gaussians, and sets the mask targets of all views from now on.
pub fn begin(
    trainer: &mut Trainer,
    folder: &SceneFolder,
    config: objects::MappingConfig,
    run: &Run,
) -> Result<()> {
    let run = Run {
        progress: &MutedSink(run.progress),
        ..*run
    };
    trainer.couple(|engine, scene, cameras| {
        let mut mapper = objects::Mapper {
            folder,
            cameras,
            config,
            engine,
            run: &run,
        };
        write_targets(&mut mapper, scene)
    })?;
    resume_targets(trainer, folder)
}

/// Progress sink that drops all messages, but can cancel. The stages of finding objects, and their
/// warnings, are reported after training.
struct MutedSink<'a>(&'a dyn Sink);

impl Sink for MutedSink<'_> {
    fn on_message(&self, _: Message<'_>) {}

    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}

/// Sets the mask targets that [`begin`] wrote.
pub fn resume_targets(trainer: &mut Trainer, folder: &SceneFolder) -> Result<()> {
    let codes: Vec<[u8; 3]> = fs::read_json(&target_path(folder, "codes.json"))?;
    let (folder, names) = (
        folder.clone(),
        trainer
            .cameras()
            .into_iter()
            .map(|camera| camera.name)
            .collect::<Vec<_>>(),
    );
    let read = move |id: usize| packed_codes(&folder, &names[id], &codes);
    trainer.set_codes(move |id| {
        read(id).map_err(|error| fastlgs_raster::Error::Picture(Box::new(error)))
    });
    Ok(())
}

/// Returns the packed code of each pixel of a view. Pixels without an object, and ignored pixels,
/// are packed as pixels that do not count.
fn packed_codes(folder: &SceneFolder, name: &str, codes: &[[u8; 3]]) -> Result<Vec<u32>> {
    let map = LabelMap::load(&target_path(folder, &format!("{name}.png")))?;
    let ignored = Some(folder.ignore_path(name))
        .filter(|path| path.is_file())
        .map(|path| image_io::load_gray(&path))
        .transpose()?;
    let counts = |k: usize| ignored.as_ref().is_none_or(|mask| mask.as_raw()[k] >= 128);
    let code = |id: u16| codes.get(usize::from(id)).copied().unwrap_or_default();
    Ok(map
        .labels
        .iter()
        .enumerate()
        .map(|(k, id)| pack(code(*id), *id > 0 && counts(k)))
        .collect())
}

/// Finds the objects, writes the mask targets of all views, and sets the feature of every Gaussian
/// to the code of its object.
fn write_targets(mapper: &mut objects::Mapper, scene: &mut Gaussians) -> Result<()> {
    let folder = mapper.folder;
    let lists = mapper.map(scene)?.chosen.lists();
    let mut adjacency = Adjacency::default();
    mapper.render_maps(scene, &lists, |camera, shown| {
        let map = objects_of_atoms(&shown, &objects::atoms(folder, camera)?.map);
        adjacency.add(&map);
        Ok(map.save(&target_path(folder, &format!("{}.png", camera.name)))?)
    })?;
    let codes = adjacency.codes(lists.len());
    fs::write_json(&target_path(folder, "codes.json"), &codes)
        .context("the object codes cannot be written")?;
    scene.features = scene
        .object_ids
        .iter()
        .map(|id| Vec3::from(codes[usize::from(*id)].map(f32::from)) / 255.0)
        .collect();
    Ok(())
}

/// Assigns each atom of a view the object that covers more than half of its pixels; 0 if there is
/// none.
fn objects_of_atoms(shown: &LabelMap, atoms: &LabelMap) -> LabelMap {
    let mut counts: Vec<BTreeMap<u16, u32>> = vec![BTreeMap::new(); usize::from(atoms.max()) + 1];
    for (atom, id) in atoms.labels.iter().zip(&shown.labels) {
        *counts[usize::from(*atom)].entry(*id).or_default() += 1;
    }
    let most = |counts: &BTreeMap<u16, u32>| {
        let all: u32 = counts.values().sum();
        counts
            .iter()
            .find(|(_, count)| 2 * **count > all)
            .map_or(0, |(id, _)| *id)
    };
    let mut of_atom: Vec<u16> = counts.iter().map(most).collect();
    // Atom 0 holds the pixels outside of all masks.
    of_atom[0] = 0;
    LabelMap {
        labels: atoms
            .labels
            .iter()
            .map(|atom| of_atom[usize::from(*atom)])
            .collect(),
        ..*atoms
    }
}

/// Number of adjacent pixels of each pair of objects, summed over all views.
#[derive(Default)]
struct Adjacency(BTreeMap<(u16, u16), u32>);

impl Adjacency {
    fn add(&mut self, map: &LabelMap) {
        let width = map.width as usize;
        for (k, id) in map.labels.iter().enumerate() {
            let right = (k + 1) % width > 0;
            for other in [
                right.then(|| map.labels[k + 1]),
                map.labels.get(k + width).copied(),
            ]
            .into_iter()
            .flatten()
            {
                if *id != other && *id > 0 && other > 0 {
                    *self.0.entry((*id, other)).or_default() += 1;
                    *self.0.entry((other, *id)).or_default() += 1;
                }
            }
        }
    }

    /// Returns the codes of `count` ids, 0 included, as in map colouring. Each code is the corner
    /// of the feature cube that is farthest from the codes of adjacent objects. Hundreds of
    /// different codes would be too close together to separate similar neighbours.
    fn codes(&self, count: usize) -> Vec<[u8; 3]> {
        let mut corners: Vec<u32> = Vec::with_capacity(count);
        for id in 0..count as u16 {
            let near = self
                .0
                .range((id, 0)..=(id, u16::MAX))
                .filter(|((_, other), _)| *other < id);
            let mut alike = [0u64; 8];
            for ((_, other), pixels) in near {
                for (corner, sum) in (0u32..).zip(&mut alike) {
                    *sum += u64::from(*pixels)
                        * u64::from((!(corner ^ corners[usize::from(*other)]) & 7).count_ones());
                }
            }
            // Starting at `id` also spreads the codes of objects without neighbours.
            corners.push(
                (0..8)
                    .map(|k| (k + u32::from(id)) % 8)
                    .min_by_key(|corner| alike[*corner as usize])
                    .unwrap_or_default(),
            );
        }
        corners
            .into_iter()
            .map(|corner| std::array::from_fn(|axis| if corner >> axis & 1 == 1 { 255 } else { 0 }))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_atom_gets_the_object_of_most_of_its_pixels() {
        let map = |labels: &[u16]| LabelMap {
            labels: labels.to_vec(),
            ..LabelMap::new(4, 2)
        };
        // Atom 1 is mostly object 5, atom 2 half 5 and half 6, atom 3 shows no object.
        let atoms = map(&[1, 1, 1, 2, 2, 3, 3, 0]);
        let object_map = map(&[5, 5, 6, 5, 6, 0, 0, 6]);
        assert_eq!(
            objects_of_atoms(&object_map, &atoms).labels,
            [5, 5, 5, 0, 0, 0, 0, 0]
        );
    }

    #[test]
    fn neighbours_have_codes_that_are_far_apart() {
        let labels = (0..16 * 16)
            .map(|k| 1 + (k % 16 / 4 + k / 64 * 4) as u16)
            .collect();
        let map = LabelMap {
            labels,
            ..LabelMap::new(16, 16)
        };
        let mut beside = Adjacency::default();
        beside.add(&map);
        assert_eq!(beside.0[&(1, 2)], 4);
        let codes = beside.codes(17);
        for (id, other) in beside.0.keys() {
            let differ = codes[usize::from(*id)]
                .iter()
                .zip(&codes[usize::from(*other)])
                .filter(|(a, b)| a != b)
                .count();
            assert!(differ >= 2, "{id} and {other}: {codes:?}");
        }
    }
}
