//! The object table: for each object its code and the embeddings of all its views.

use crate::Result;
use crate::mapping::Mask;
use fastlgs_core::scene_folder::{parse_tensors, save_tensors};
use fastlgs_core::{Error, Gaussians, SceneFolder, fs};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// One object.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Number, 1..=K.
    pub id: u16,
    /// Object that contains it; 0 for none.
    pub parent: u16,
    /// Mean IoU with the best mask of each view; 1 where masks were taken as they are.
    pub support: f32,
    /// Code in (0, 1)^3.
    pub code: Vec3,
    /// Embeddings of its masks, each L2-normalised.
    pub embeddings: Vec<Vec<f32>>,
    /// Share of its photo that each of those masks covered.
    pub areas: Vec<f32>,
    /// Photos that show it.
    pub views: usize,
}

/// All objects of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Grid {
    /// In order of id.
    pub objects: Vec<Object>,
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
    /// Rows of the embedding table: first and number.
    first: usize,
    count: usize,
}

/// Support of objects in grids that earlier versions wrote.
fn full() -> f32 {
    1.0
}

impl Grid {
    /// Gathers the masks of each object; there are as many objects as `codes`.
    pub fn build(masks: &[Mask], object_of: &[u16], codes: Vec<Vec3>) -> Self {
        let objects = (1u16..)
            .zip(codes)
            .map(|(id, code)| {
                let own: Vec<&Mask> = masks.iter().zip(object_of).filter(|(_, o)| **o == id).map(|(m, _)| m).collect();
                let views = own.iter().map(|m| m.view).collect::<std::collections::BTreeSet<_>>().len();
                let seen: Vec<&Mask> = own.into_iter().filter(|m| m.embedding.iter().any(|v| *v != 0.0)).collect();
                Object {
                    id,
                    parent: 0,
                    support: 1.0,
                    code,
                    embeddings: seen.iter().map(|m| m.embedding.clone()).collect(),
                    areas: seen.iter().map(|m| m.area).collect(),
                    views,
                }
            })
            .collect();
        Self { objects }
    }

    /// The objects that contain an object, from small to large, itself first.
    pub fn chain(&self, id: u16) -> impl Iterator<Item = u16> {
        let known = |id: &u16| (1..=self.objects.len()).contains(&usize::from(*id));
        // A damaged file might go in circles: no chain is longer than there are objects.
        let up = move |id: &u16| Some(self.objects[usize::from(*id) - 1].parent).filter(known);
        std::iter::successors(Some(id).filter(known), up).take(self.objects.len())
    }

    /// Sums over each object and all that lies in it. What contains an object has a lower number.
    pub fn with_parts(&self, values: &[f32]) -> Vec<f32> {
        let mut sums = values.to_vec();
        for k in (0..sums.len()).rev() {
            // A damaged file might go in circles.
            if let Some(above) = usize::from(self.objects[k].parent).checked_sub(1).filter(|above| *above < k) {
                sums[above] += sums[k];
            }
        }
        sums
    }

    /// For each id 0..=K whether the object belongs to one of `targets`: is one, or lies inside one.
    pub fn members(&self, targets: &[u16]) -> Vec<bool> {
        let inside = |id: u16| self.chain(id).any(|above| targets.contains(&above));
        (0..=self.objects.len() as u16).map(inside).collect()
    }

    /// The grid without some objects and all that lies in them, and the new number of each old one 0..=K; 0 for those that are gone.
    pub fn without(&self, removed: &[u16]) -> (Self, Vec<u16>) {
        let gone = self.members(removed);
        let mut left = 0;
        let number = |gone: &bool| {
            left += u16::from(!gone);
            if *gone { 0 } else { left }
        };
        let ids: Vec<u16> = std::iter::once(0).chain(gone[1..].iter().map(number)).collect();
        let renumbered =
            |o: &Object| Object { id: ids[usize::from(o.id)], parent: ids.get(usize::from(o.parent)).copied().unwrap_or(0), ..o.clone() };
        let objects = self.objects.iter().filter(|o| ids[usize::from(o.id)] > 0).map(renumbered).collect();
        (Self { objects }, ids)
    }

    /// Code of an object; zero for object 0 and unknown ones.
    pub fn code_of(&self, id: u16) -> Vec3 {
        self.objects.get(usize::from(id).wrapping_sub(1)).map_or(Vec3::ZERO, |o| o.code)
    }

    /// Gives every Gaussian its object's code as feature.
    pub fn set_codes(&self, scene: &mut Gaussians) {
        scene.features = scene.object_ids.iter().map(|id| self.code_of(*id)).collect();
    }

    /// Writes `grid.safetensors` and then `grid.json`.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn save(&self, folder: &SceneFolder) -> Result<()> {
        let dimension = self.objects.iter().flat_map(|o| &o.embeddings).map(Vec::len).next().unwrap_or(0);
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
            });
            embeddings.extend(o.embeddings.iter().flatten().copied());
            areas.extend(&o.areas);
        }
        let n = areas.len();
        save_tensors(
            &folder.root.join("grid.safetensors"),
            &[("embeddings", vec![n, dimension], &embeddings), ("areas", vec![n], &areas)],
        )?;
        Ok(fs::write_json(&folder.root.join("grid.json"), &rows)?)
    }

    /// Reads what [`Self::save`] wrote.
    ///
    /// # Errors
    /// Missing or damaged files.
    pub fn load(folder: &SceneFolder) -> Result<Self> {
        let file = |name: &str| fs::read(&folder.root.join(name));
        Self::parse(&folder.root, &file("grid.json")?, &file("grid.safetensors")?)
    }

    /// As [`Self::load`], for files that are in memory; `root` is what errors call their folder.
    ///
    /// # Errors
    /// Damaged files.
    pub fn parse(root: &Path, rows: &[u8], tensors: &[u8]) -> Result<Self> {
        let rows: Vec<Row> =
            serde_json::from_slice(rows).map_err(|e| Error::format(root.join("grid.json"), format!("not the expected JSON: {e}")))?;
        let path = root.join("grid.safetensors");
        let tensors = parse_tensors(&path, tensors)?;
        let get = |name: &str| tensors.get(name).ok_or_else(|| Error::format(&path, format!("tensor '{name}' is missing")));
        let (embeddings, areas) = (get("embeddings")?, get("areas")?);
        let dimension = embeddings.0.get(1).copied().unwrap_or(0);
        let objects = rows
            .into_iter()
            .map(|r| {
                let range = r.first..r.first + r.count;
                if range.end > areas.1.len() || range.end * dimension > embeddings.1.len() {
                    return Err(Error::format(&path, "it does not fit grid.json; run 'fastlgs preprocess' again"));
                }
                let own = &embeddings.1[range.start * dimension..range.end * dimension];
                Ok(Object {
                    id: r.id,
                    parent: r.parent,
                    support: r.support,
                    code: Vec3::from(r.code),
                    embeddings: own.chunks_exact(dimension.max(1)).map(<[f32]>::to_vec).collect(),
                    areas: areas.1[range].to_vec(),
                    views: r.views,
                })
            })
            .collect::<Result<Vec<_>, Error>>()?;
        Ok(Self { objects })
    }
}
