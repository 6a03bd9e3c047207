//! The fields of `fastlgs-bench baseline`: the vectors of all Gaussians.

use super::vectors::{Labelled, Vectors, lifted, rows};
use super::{PerPixel, Representation};
use crate::autoencoder::Autoencoder;
use anyhow::Result;
use fastlgs::{Run, Scene, model_choice};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, LabelMap, Level};
use fastlgs_grid::Grid;
use fastlgs_vision::Encoder;

/// Sides of LERF's tiles, as fractions of the photo's shorter side.
const TILE_SIDES: [f32; 3] = [0.5, 0.25, 0.125];

impl PerPixel {
    pub fn raw(scene: &Scene, run: &Run) -> Result<Self> {
        let masks = fastlgs::masks::training_descriptors(
            scene.folder(),
            &scene.manifest().training(scene.cameras()),
            run,
        )?;
        let lifted = lifted(scene, |view, camera| {
            let map = scene.folder().masks(camera)?.painted(Level::Whole);
            let own = masks.iter().filter(|m| m.view == view);
            Ok((
                map,
                own.map(|m| {
                    (
                        m.label,
                        model_choice::for_texts(scene.manifest(), m.embedding.clone()),
                    )
                })
                .collect(),
            ))
        })?;
        Ok(Self {
            layers: vec![lifted],
            meaning: Representation::Embedding,
        })
    }

    pub fn lerf(scene: &Scene, run: &Run) -> Result<Self> {
        let encoder = model_choice::encoder_of(scene.folder(), scene.manifest())?;
        let progress = run.work(
            "tiles",
            (TILE_SIDES.len() * scene.manifest().training(scene.cameras()).len()) as u64,
        );
        let of_scale = |share: &f32| {
            lifted(scene, |_, camera| {
                let side = ((share * camera.width.min(camera.height) as f32) as u32).max(8);
                let columns = camera.width.div_ceil(side);
                let labels = (0..camera.width * camera.height).map(|p| {
                    (p / camera.width / side * columns + p % camera.width / side + 1) as u16
                });
                let map = LabelMap {
                    width: camera.width,
                    height: camera.height,
                    labels: labels.collect(),
                };
                progress.advance()?;
                embedded(scene, encoder.as_ref(), camera, map)
            })
        };
        let layers = TILE_SIDES.iter().map(of_scale).collect::<Result<_>>()?;
        Ok(Self {
            layers,
            meaning: Representation::Embedding,
        })
    }

    pub fn langsplat(scene: &Scene, run: &Run) -> Result<Self> {
        let encoder = model_choice::encoder_of(scene.folder(), scene.manifest())?;
        let training = scene.manifest().training(scene.cameras());
        let progress = run.work("embeddings", 2 * training.len() as u64);
        let mut levels: [Vec<Labelled>; 2] = Default::default();
        for (level, found) in [Level::Whole, Level::Part].into_iter().zip(&mut levels) {
            for camera in &training {
                let masks = scene.folder().masks(camera)?;
                // A scene without part masks uses its whole masks twice.
                let level = if masks.count(level) > 0 {
                    level
                } else {
                    Level::Whole
                };
                found.push(embedded(
                    scene,
                    encoder.as_ref(),
                    camera,
                    masks.painted(level),
                )?);
                progress.advance()?;
            }
        }
        let all: Vec<&Vec<f32>> = levels
            .iter()
            .flatten()
            .flat_map(|l| &l.1)
            .map(|e| &e.1)
            .collect();
        let coder = Autoencoder::learn(&rows(&all)?, run.seed);
        let layers = levels.iter().map(|views| {
            lifted(scene, |view, _| {
                let (map, embeddings) = &views[view];
                let encoded =
                    coder.encode(rows(&embeddings.iter().map(|e| &e.1).collect::<Vec<_>>())?);
                Ok((
                    map.clone(),
                    embeddings
                        .iter()
                        .zip(encoded.rows())
                        .map(|(e, code)| (e.0, code.to_vec()))
                        .collect(),
                ))
            })
        });
        Ok(Self {
            layers: layers.collect::<Result<_>>()?,
            meaning: Representation::Encoded(coder),
        })
    }

    /// Gives each Gaussian the code of its smallest object. Gaussians without an object get the origin,
    /// which is not a code.
    pub fn of_codes(scene: &Scene, grid: &Grid, codes: Vectors) -> Self {
        let own = |g: usize, axis: usize| {
            grid.chain(scene.gaussians().object_ids[g])
                .next()
                .map_or(0.0, |id| codes[[usize::from(id) - 1, axis]])
        };
        let layer =
            Vectors::from_shape_fn((scene.gaussians().len(), codes.ncols()), |(g, axis)| {
                own(g, axis)
            });
        Self {
            layers: vec![layer],
            meaning: Representation::Object(codes),
        }
    }
}

/// Returns `count` codes on a lattice with spacing K^(-1/d) in d dimensions (paper, semantic
/// feature grid). K is the number of objects. Their order is random.
pub fn lattice_codes(count: usize, dimension: u32, seed: u64) -> Vectors {
    let side = (1usize..).find(|s| s.pow(dimension) >= count).unwrap_or(1);
    let mut cells: Vec<usize> = (0..side.pow(dimension)).collect();
    Rng::new(seed, "codes of any dimension").shuffle(&mut cells);
    Vectors::from_shape_fn((count, dimension as usize), |(k, axis)| {
        ((cells[k] / side.pow(axis as u32) % side) as f32 + 0.5) / side as f32
    })
}

/// Embeds the masks of a label map. Labels whose embedding is zero are left out.
fn embedded(
    scene: &Scene,
    encoder: &dyn Encoder,
    camera: &Camera,
    map: LabelMap,
) -> Result<Labelled> {
    let found = encoder.embed_masks(&camera.name, &scene.folder().photo(&camera.name)?, &map)?;
    let own = found
        .into_iter()
        .enumerate()
        .filter(|(_, e)| e.iter().any(|v| *v != 0.0));
    Ok((
        map,
        own.map(|(k, e)| (k as u16 + 1, model_choice::for_texts(scene.manifest(), e)))
            .collect(),
    ))
}
