//! Maps objects onto trained Gaussians.

use super::Inputs;
use super::run::Trained;
use crate::{Result, Run, objects, transparent};
use fastlgs_core::Gaussians;
use fastlgs_grid::Grid;
use fastlgs_grid::codebook::Codebook;
use std::time::Instant;

/// The object table of a trained scene.
pub struct MappedObjects {
    pub grid: Grid,
    /// Statistics of global mapping.
    pub summary: Option<objects::Summary>,
    pub seconds: f64,
}

/// Assigns object ids to the Gaussians, and makes the object table.
pub fn map_objects(inputs: &Inputs, trained: &mut Trained, run: &Run) -> Result<MappedObjects> {
    let started = Instant::now();
    let Trained {
        scene,
        training,
        kept_transparent,
        ..
    } = trained;
    let (config, folder) = (&inputs.config, &inputs.folder);
    let (grid, summary) = match inputs.prior_objects.clone() {
        Some(grid) if inputs.trains_features() => {
            if !grid.overlaps.0.is_empty() {
                run.warn("a trained feature keeps only the smallest of overlapping objects and the objects that contain it; set feature_mode to lift to keep them all");
            }
            nearest_codes(scene, &grid);
            (grid, None)
        }
        Some(grid) => {
            scene.append(std::mem::take(kept_transparent).with_sh_degree(scene.sh_degree));
            objects::lift(scene, folder, training, &grid, config.antialias)?;
            transparent::keep_owned(scene);
            (grid, None)
        }
        None => {
            let mapped = transparent::map(scene, folder, training, &config.global(), run)?;
            let (grid, summary) = objects::embed_objects(scene, folder, training, mapped, run)?;
            (grid, Some(summary))
        }
    };
    Ok(MappedObjects {
        grid,
        summary,
        seconds: started.elapsed().as_secs_f64(),
    })
}

/// Assigns every Gaussian the object whose code is nearest to its trained feature. Gaussians nearer
/// to the origin get none: pixels outside of all masks are trained towards the origin.
fn nearest_codes(scene: &mut Gaussians, grid: &Grid) {
    let codebook = Codebook::of(grid);
    scene.object_ids = scene
        .features
        .iter()
        .map(|feature| codebook.owner(*feature).0)
        .collect();
}
