//! Disturbances of photos, masks and embeddings, for `fastlgs-bench all`.

mod masks;
mod photos;

pub use masks::{MaskChange, masks};
pub use photos::{Album, PhotoChange};

use anyhow::Result;
use fastlgs::model_choice;
use fastlgs_core::SceneFolder;
use fastlgs_core::rng::Rng;
use fastlgs_grid::Grid;
use std::collections::BTreeSet;

/// Adds noise to the part of each object's embeddings that texts are compared with, and normalises
/// that part. `noise` is the root mean square length of the added vector.
pub fn embeddings(scene: &SceneFolder, noise: f32, seed: u64) -> Result<()> {
    let mut rng = Rng::new(seed, "disturbed embeddings");
    let mut grid = Grid::load(scene)?;
    let manifest = scene.manifest()?;
    for embedding in grid.objects.iter_mut().flat_map(|o| &mut o.embeddings) {
        let words = model_choice::text_components(&manifest, embedding);
        let deviation = noise / (words.len() as f32).sqrt();
        words
            .iter_mut()
            .for_each(|v| *v += deviation * rng.normal());
        let length = words
            .iter()
            .map(|v| v * v)
            .sum::<f32>()
            .sqrt()
            .max(f32::MIN_POSITIVE);
        words.iter_mut().for_each(|v| *v /= length);
    }
    Ok(grid.save(scene)?)
}

/// Returns a random `share` (0 to 1) of the indices below `count` that `is_candidate` accepts.
fn random_subset(
    count: usize,
    share: f32,
    rng: &mut Rng,
    is_candidate: impl Fn(usize) -> bool,
) -> BTreeSet<usize> {
    let mut all: Vec<usize> = (0..count).filter(|k| is_candidate(*k)).collect();
    rng.shuffle(&mut all);
    all.truncate((share * all.len() as f32).round() as usize);
    all.into_iter().collect()
}
