//! The paper's own method: objects by Algorithm 1 before training, and objects of trained features
//! by their nearest code.

use crate::{Result, Run, masks, model_choice, objects};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder};
use fastlgs_grid::codebook::Codebook;
use fastlgs_grid::mapping::{self, PaperConfig};
use fastlgs_grid::{Grid, codes, mask_pairs};

/// Finds objects by Algorithm 1 of the paper from the masks of preprocessing, and writes the object
/// maps.
pub fn map(
    folder: &SceneFolder,
    training: &[Camera],
    config: &PaperConfig,
    run: &Run,
) -> Result<Grid> {
    let masks = masks::training_descriptors(folder, training, run)?;
    let pairs = mask_pairs::load_pairs(folder, &masks)?;
    let manifest = folder.manifest()?;
    // Embeddings are compared without their appearance part; with it, the masks of fox give twice
    // as many objects.
    let mut compared = masks.clone();
    compared.iter_mut().for_each(|mask| {
        mask.embedding = model_choice::for_texts(&manifest, std::mem::take(&mut mask.embedding))
    });
    let mapping::Mapped {
        object_of,
        count,
        comparisons,
    } = mapping::paper(&compared, &pairs, config)?;
    tracing::debug!(masks = masks.len(), count, comparisons, "Algorithm 1");
    objects::mark_maps_unfinished(folder)?;
    for (view, camera) in training.iter().enumerate() {
        let labels = masks::whole_masks(folder, camera)?;
        let mut table = vec![0u16; usize::from(labels.max()) + 1];
        for (mask, object) in masks.iter().zip(&object_of).filter(|(m, _)| m.view == view) {
            if let Some(entry) = table.get_mut(usize::from(mask.label)) {
                *entry = *object;
            }
        }
        let map = LabelMap {
            labels: labels
                .labels
                .iter()
                .map(|l| table[usize::from(*l)])
                .collect(),
            ..labels
        };
        map.save(&folder.objects_path(&camera.name))?;
    }
    let encoder = model_choice::identity_of(&manifest);
    Ok(Grid {
        encoder,
        ..Grid::build(
            &masks,
            &object_of,
            codes::lattice(usize::from(count), run.seed),
        )
    })
}

/// Assigns every Gaussian the object whose code is nearest to its trained feature. Gaussians nearer
/// to the origin get none: pixels outside of all masks are trained towards the origin.
pub fn assign_nearest_codes(scene: &mut Gaussians, grid: &Grid) {
    let codebook = Codebook::of(grid);
    scene.object_ids = scene
        .features
        .iter()
        .map(|feature| codebook.owner(*feature).0)
        .collect();
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn gaussians_get_the_nearest_code_and_none_near_the_origin() {
        let codes = vec![Vec3::new(0.9, 0.1, 0.1), Vec3::new(0.1, 0.9, 0.9)];
        let grid = Grid::build(&[], &[], codes.clone());
        let mut scene = Gaussians::default();
        for feature in [codes[1] * 0.9, codes[0] + 0.05, Vec3::ZERO] {
            scene.push_sphere(Vec3::ZERO, 0.1, 0.5, [0.5; 3]);
            *scene.features.last_mut().unwrap() = feature;
        }
        assign_nearest_codes(&mut scene, &grid);
        assert_eq!(scene.object_ids, [2, 1, 0]);
    }
}
