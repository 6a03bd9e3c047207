//! The object table: codes and embeddings of all objects.

use crate::Result;
use crate::mapping::Mask;
use crate::overlaps::Overlaps;
use fastlgs_core::scene_folder::{embedding_encoder, parse_tensors, save_embeddings};
use fastlgs_core::{Error, Gaussians, SceneFolder, fs};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// One object.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Object id, 1..=K.
    pub id: u16,
    /// Smallest object that contains it; 0 for none.
    pub parent: u16,
    /// Mean IoU with the best mask of each view, 0 to 1; 1 if the masks themselves define the
    /// objects.
    pub support: f32,
    /// Code in (0, 1)^3.
    pub code: Vec3,
    /// Embeddings of its masks. The part that is compared with texts is L2-normalised.
    pub embeddings: Vec<Vec<f32>>,
    /// For each embedding: area of its mask as a share of the photo.
    pub areas: Vec<f32>,
    /// Number of views that show it.
    pub views: usize,
    /// Votes of the detector by class, 0 to 1: the mean over its views. `None` without detector.
    pub detected: Option<BTreeMap<String, f32>>,
}

/// All objects of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Grid {
    /// Objects in ascending order of id.
    pub objects: Vec<Object>,
    /// Object lists for the ids above those of the objects.
    pub overlaps: Overlaps,
    /// For each id, 0 included: area of its Gaussians summed over all views, in units of a view's
    /// area. Empty if unknown.
    pub id_areas: Vec<f32>,
    /// Identity of the encoder of the embeddings; empty if unknown.
    pub encoder: String,
}

#[derive(Serialize, Deserialize)]
struct Row {
    id: u16,
    #[serde(default)]
    parent: u16,
    #[serde(default = "full")]
    support: f32,
    code: [f32; 3],
    views: usize,
    /// Index of the first of its `count` rows in the embedding table.
    first: usize,
    count: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    detected: Option<BTreeMap<String, f32>>,
}

/// An object is a part of another one if more than this share of its area lies in the other one.
pub const PART: f32 = 0.7;

/// Support of objects in files without this field.
fn full() -> f32 {
    1.0
}

impl Grid {
    /// Collects the masks of each object. `object_of`: object id of each mask; `codes`: one for
    /// each object.
    pub fn build(masks: &[Mask], object_of: &[u16], codes: Vec<Vec3>) -> Self {
        let objects = (1u16..)
            .zip(codes)
            .map(|(id, code)| {
                let own: Vec<&Mask> = masks
                    .iter()
                    .zip(object_of)
                    .filter(|(_, o)| **o == id)
                    .map(|(m, _)| m)
                    .collect();
                let views = own
                    .iter()
                    .map(|m| m.view)
                    .collect::<std::collections::BTreeSet<_>>()
                    .len();
                let seen: Vec<&Mask> = own
                    .into_iter()
                    .filter(|m| m.embedding.iter().any(|v| *v != 0.0))
                    .collect();
                Object {
                    id,
                    parent: 0,
                    support: 1.0,
                    code,
                    embeddings: seen.iter().map(|m| m.embedding.clone()).collect(),
                    areas: seen.iter().map(|m| m.area).collect(),
                    views,
                    detected: None,
                }
            })
            .collect();
        Self {
            objects,
            ..Self::default()
        }
    }

    /// Returns whether the detector voted for objects.
    pub fn has_detections(&self) -> bool {
        self.objects.iter().any(|object| object.detected.is_some())
    }

    /// Iterates over the objects of an id, smallest first: an object and its ancestors, or the
    /// members of an overlap list.
    pub fn chain(&self, id: u16) -> impl Iterator<Item = u16> {
        let known = |id: &u16| (1..=self.objects.len()).contains(&usize::from(*id));
        let list = usize::from(id)
            .checked_sub(self.objects.len() + 1)
            .and_then(|k| self.overlaps.0.get(k));
        // The length limit ends cycles of parents in damaged files.
        let up = move |id: &u16| Some(self.objects[usize::from(*id) - 1].parent).filter(known);
        list.into_iter()
            .flatten()
            .copied()
            .chain(std::iter::successors(Some(id).filter(known), up).take(self.objects.len()))
    }

    /// Returns [`Self::chain`] for each id of Gaussians, 0 included.
    pub fn lists(&self) -> Vec<Vec<u16>> {
        (0..=self.highest())
            .map(|id| self.chain(id).collect())
            .collect()
    }

    /// Returns the highest id that a Gaussian can have.
    pub fn highest(&self) -> u16 {
        (self.objects.len() + self.overlaps.0.len()) as u16
    }

    /// Returns for each id the area of its Gaussians summed over all views, in units of a view's
    /// area.
    pub fn surface(&self) -> Vec<f32> {
        if self.id_areas.len() == usize::from(self.highest()) + 1 {
            return self.id_areas.clone();
        }
        // Without measured areas: mean mask area times number of views, minus the same of the
        // parts.
        let seen = |object: &Object| {
            object.areas.iter().sum::<f32>() / object.areas.len().max(1) as f32
                * object.views as f32
        };
        let mut own: Vec<f32> = std::iter::once(0.0)
            .chain(self.objects.iter().map(seen))
            .collect();
        for object in self.objects.iter().filter(|o| o.parent > 0) {
            if let Some(above) = own.get_mut(usize::from(object.parent)) {
                *above -= seen(object);
            }
        }
        own.resize(usize::from(self.highest()) + 1, 0.0);
        own.into_iter().map(|share| share.max(0.0)).collect()
    }

    /// Returns for each object its share of the scene's surface, 0 to 1. Objects overlap, so the
    /// sum may exceed 1.
    pub fn shares(&self) -> Vec<f32> {
        let surface = self.surface();
        let total = surface.iter().skip(1).sum::<f32>().max(f32::MIN_POSITIVE);
        self.common(&[])
            .into_iter()
            .map(|[shown, _]| shown / total)
            .collect()
    }

    /// Returns for each object its area, and the area that it shares with `targets`.
    fn common(&self, targets: &[u16]) -> Vec<[f32; 2]> {
        let mut sums = vec![[0.0f32; 2]; self.objects.len()];
        for (list, shown) in self.lists().iter().zip(self.surface()) {
            let common = list.iter().any(|id| targets.contains(id));
            list.iter().for_each(|id| {
                let [all, shared] = &mut sums[usize::from(*id) - 1];
                *all += shown;
                *shared += if common { shown } else { 0.0 };
            });
        }
        sums
    }

    /// Returns for each object whether it is one of `targets` or a part of them: more than [`PART`]
    /// of it lies in them.
    pub fn parts(&self, targets: &[u16]) -> Vec<bool> {
        let in_chain = |id: u16| self.chain(id).any(|above| targets.contains(&above));
        let is_part = |([all, common], object): ([f32; 2], &Object)| {
            targets.contains(&object.id)
                || if all > 0.0 {
                    common > PART * all
                } else {
                    in_chain(object.id)
                }
        };
        self.common(targets)
            .into_iter()
            .zip(&self.objects)
            .map(is_part)
            .collect()
    }

    /// Returns for each object whether it overlaps this one: more than half of the smaller lies in
    /// both.
    pub fn related(&self, id: u16) -> Vec<bool> {
        let sums = self.common(&[id]);
        let own = usize::from(id)
            .checked_sub(1)
            .and_then(|k| sums.get(k))
            .map_or(0.0, |sum| sum[0]);
        let in_chain =
            |other: u16| self.chain(id).any(|a| a == other) || self.chain(other).any(|a| a == id);
        let is_related = |([all, common], object): (&[f32; 2], &Object)| {
            if all.min(own) > 0.0 {
                2.0 * common > all.min(own)
            } else {
                in_chain(object.id)
            }
        };
        sums.iter().zip(&self.objects).map(is_related).collect()
    }

    /// Returns for each id of Gaussians whether it belongs to one of `targets`.
    pub fn members(&self, targets: &[u16]) -> Vec<bool> {
        let inside = |id: u16| self.chain(id).any(|above| targets.contains(&above));
        (0..=self.highest()).map(inside).collect()
    }

    /// Returns the table without some objects, and the new id of each old id; 0 for removed ones.
    /// `gone` says for each object whether it is removed.
    pub fn without(&self, gone: &[bool]) -> (Self, Vec<u16>) {
        let mut left = 0;
        let number = |gone: &bool| {
            left += u16::from(!gone);
            if *gone { 0 } else { left }
        };
        let numbers: Vec<u16> = gone.iter().map(number).collect();
        let new = |id: u16| {
            usize::from(id)
                .checked_sub(1)
                .and_then(|k| numbers.get(k))
                .copied()
                .unwrap_or(0)
        };
        // The smallest remaining object that contains it.
        let parent = |o: &Object| {
            self.chain(o.id)
                .skip(1)
                .map(new)
                .find(|above| *above > 0)
                .unwrap_or(0)
        };
        let renumbered = |o: &Object| Object {
            id: new(o.id),
            parent: parent(o),
            ..o.clone()
        };
        let objects: Vec<Object> = self
            .objects
            .iter()
            .filter(|o| new(o.id) > 0)
            .map(renumbered)
            .collect();
        let parents: Vec<u16> = objects.iter().map(|o| o.parent).collect();
        let lists: Vec<Vec<u16>> = self
            .lists()
            .iter()
            .map(|list| {
                list.iter()
                    .map(|id| new(*id))
                    .filter(|id| *id > 0)
                    .collect()
            })
            .collect();
        let surface = self.surface();
        let (overlaps, ids) = Overlaps::of(&lists, &parents, &surface, 1.0);
        let shown = overlaps.sums(objects.len(), &ids, &surface);
        (
            Self {
                objects,
                overlaps,
                id_areas: shown,
                encoder: self.encoder.clone(),
            },
            ids,
        )
    }

    /// Returns the code of an object, or of the smallest object in the list of this id; zero for
    /// none.
    pub fn code_of(&self, id: u16) -> Vec3 {
        self.chain(id)
            .next()
            .map_or(Vec3::ZERO, |id| self.objects[usize::from(id) - 1].code)
    }

    /// Sets the feature of each Gaussian to the code of its object.
    pub fn set_codes(&self, scene: &mut Gaussians) {
        scene.features = scene
            .object_ids
            .iter()
            .map(|id| self.code_of(*id))
            .collect();
    }

    /// Writes `grid.safetensors`, then `grid.json`.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn save(&self, folder: &SceneFolder) -> Result<()> {
        let dimension = self
            .objects
            .iter()
            .flat_map(|o| &o.embeddings)
            .map(Vec::len)
            .next()
            .unwrap_or(0);
        let (mut embeddings, mut areas, mut rows) = (Vec::new(), Vec::new(), Vec::new());
        for o in &self.objects {
            rows.push(Row {
                id: o.id,
                parent: o.parent,
                support: o.support,
                code: o.code.to_array(),
                views: o.views,
                first: areas.len(),
                count: o.areas.len(),
                detected: o.detected.clone(),
            });
            embeddings.extend(o.embeddings.iter().flatten().copied());
            areas.extend(&o.areas);
        }
        let n = areas.len();
        // A 0 ends each list.
        let overlaps: Vec<f32> = self
            .overlaps
            .0
            .iter()
            .flat_map(|list| list.iter().chain(&[0]))
            .map(|id| f32::from(*id))
            .collect();
        let tensors = [
            ("embeddings", vec![n, dimension], embeddings.as_slice()),
            ("areas", vec![n], &areas),
            ("overlaps", vec![overlaps.len()], &overlaps),
            ("shown", vec![self.id_areas.len()], &self.id_areas),
        ];
        save_embeddings(
            &folder.root.join("grid.safetensors"),
            &tensors,
            &self.encoder,
        )?;
        Ok(fs::write_json(&folder.root.join("grid.json"), &rows)?)
    }

    /// Reads the files of [`Self::save`].
    ///
    /// # Errors
    /// A file is missing or damaged.
    pub fn load(folder: &SceneFolder) -> Result<Self> {
        let file = |name: &str| fs::read(&folder.root.join(name));
        Self::parse(
            &folder.root,
            &file("grid.json")?,
            &file("grid.safetensors")?,
        )
    }

    /// Parses the contents of `grid.json` (`rows`) and `grid.safetensors` (`tensors`). Errors name
    /// them as files of the folder `root`.
    ///
    /// # Errors
    /// A file is damaged.
    pub fn parse(root: &Path, rows: &[u8], tensors: &[u8]) -> Result<Self> {
        let rows: Vec<Row> = serde_json::from_slice(rows).map_err(|e| {
            Error::format(
                root.join("grid.json"),
                format!("not the expected JSON: {e}"),
            )
        })?;
        let path = root.join("grid.safetensors");
        let encoder = embedding_encoder(&path, tensors)?;
        let tensors = parse_tensors(&path, tensors)?;
        let get = |name: &str| {
            tensors.get(name).ok_or_else(|| {
                Error::format(
                    &path,
                    format!("tensor '{name}' is missing; run 'fastlgs train' again"),
                )
            })
        };
        let (embeddings, areas) = (get("embeddings")?, get("areas")?);
        let dimension = embeddings.0.get(1).copied().unwrap_or(0);
        let objects = rows
            .into_iter()
            .map(|r| {
                let range = r.first..r.first.saturating_add(r.count);
                if range.end > areas.1.len()
                    || range.end.saturating_mul(dimension) > embeddings.1.len()
                {
                    return Err(Error::format(
                        &path,
                        "it does not fit grid.json; run 'fastlgs train' again",
                    ));
                }
                let own = &embeddings.1[range.start * dimension..range.end * dimension];
                Ok(Object {
                    id: r.id,
                    parent: r.parent,
                    support: r.support,
                    code: Vec3::from(r.code),
                    embeddings: own
                        .chunks_exact(dimension.max(1))
                        .map(<[f32]>::to_vec)
                        .collect(),
                    areas: areas.1[range].to_vec(),
                    views: r.views,
                    detected: r.detected,
                })
            })
            .collect::<Result<Vec<_>, Error>>()?;
        // Files without the tensors `overlaps` and `shown` (the `id_areas`) are valid.
        let values = |name: &str| tensors.get(name).map_or(&[][..], |t| t.1.as_slice());
        let overlaps = parse_overlaps(values("overlaps"), objects.len());
        let id_areas = values("shown").to_vec();
        let areas_are_valid = id_areas.iter().all(|area| *area >= 0.0);
        let fits = |lists: &Overlaps| objects.len() + lists.0.len() <= usize::from(u16::MAX);
        let Some(overlaps) = overlaps.filter(|lists| areas_are_valid && fits(lists)) else {
            return Err(Error::format(
                &path,
                "its overlap lists do not fit the objects in grid.json; run 'fastlgs train' again",
            )
            .into());
        };
        let grid = Self {
            objects,
            overlaps,
            id_areas,
            encoder,
        };
        let mut numbered = grid.objects.iter().zip(1..=u16::MAX);
        if numbered.any(|(object, id)| object.id != id) {
            return Err(Error::format(
                root.join("grid.json"),
                "its object ids are not 1, 2, ...; run 'fastlgs train' again",
            )
            .into());
        }
        Ok(grid)
    }
}

/// Parses lists of object ids in descending order, each followed by 0. Returns `None` for other
/// content.
fn parse_overlaps(values: &[f32], objects: usize) -> Option<Overlaps> {
    let is_known = |id: &f32| id.fract() == 0.0 && (0.0..=objects as f32).contains(id);
    let is_list = |list: &[f32]| {
        list.len() > 1 && list.last() == Some(&0.0) && list.is_sorted_by(|a, b| a > b)
    };
    let mut lists = values.split_inclusive(|id| *id == 0.0);
    if !values.iter().all(is_known) || !lists.all(is_list) {
        return None;
    }
    let lists = values
        .split(|id| *id == 0.0)
        .filter(|list| !list.is_empty());
    let ids = lists.map(|list| list.iter().map(|id| *id as u16).collect());
    Some(Overlaps(ids.collect()))
}
