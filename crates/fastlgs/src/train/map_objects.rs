//! Maps objects onto trained Gaussians.

use super::Inputs;
use super::run::Trained;
use crate::{Result, Run, objects, paper, transparent};
use fastlgs_grid::Grid;
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
        engine,
        ..
    } = trained;
    let mut mapper = objects::Mapper {
        folder: &inputs.folder,
        cameras: training,
        config: inputs.config.global(&inputs.manifest.segmenter),
        engine: &mut **engine,
        run,
    };
    let (grid, summary) = match inputs.prior_objects.clone() {
        Some(grid) if inputs.trains_features() => {
            if !grid.overlaps.0.is_empty() {
                run.warn("a trained feature keeps only the smallest of overlapping objects and the objects that contain it; set feature_mode to lift to keep them all");
            }
            paper::assign_nearest_codes(scene, &grid);
            (grid, None)
        }
        Some(grid) => {
            scene.append(std::mem::take(kept_transparent).with_sh_degree(scene.sh_degree));
            mapper.lift(scene, &grid)?;
            transparent::remove_unowned(scene);
            (grid, None)
        }
        None => {
            let mapped = transparent::map(&mut mapper, scene)?;
            let (grid, summary) =
                objects::embed_objects(scene, &inputs.folder, training, mapped, run)?;
            (grid, Some(summary))
        }
    };
    Ok(MappedObjects {
        grid,
        summary,
        seconds: started.elapsed().as_secs_f64(),
    })
}
