//! Lifts label maps onto Gaussians: each Gaussian gets the label with most of its blending weight.
//!
//! The weights are summed over all views. The result is a PLY with the labels as object ids, which
//! other programs can open.
//!
//! `cargo run --release -p fastlgs-raster --example lift_labels -- SCENE labelled.ply`
//!
//! SCENE is a trained scene folder, and the labels are the object maps of its views. Any label maps
//! work if their numbers mean the same objects in all views.

use fastlgs_core::{SceneFolder, ply};
use fastlgs_raster::density::State;
use fastlgs_raster::{View, open_engine};
use std::collections::BTreeMap;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let (Some(scene), Some(output)) = (args.next(), args.next()) else {
        return Err("usage: lift_labels SCENE labelled.ply".into());
    };
    let folder = SceneFolder::open(Path::new(&scene))?;
    let mut gaussians = folder.gaussians()?;
    let cameras = folder.manifest()?.training(&folder.cameras()?);

    let mut engine = open_engine("auto")?;
    engine.set_state(&State::of(&gaussians))?;
    let mut weights: Vec<BTreeMap<u16, f32>> = vec![BTreeMap::new(); gaussians.len()];
    for camera in &cameras {
        // The weight that each Gaussian contributes to each label of the view.
        let view = View::new(camera, gaussians.len(), 0);
        for vote in engine.votes(view, &folder.objects(&camera.name)?)? {
            *weights[vote.gaussian as usize]
                .entry(vote.label)
                .or_default() += vote.weight;
        }
    }
    let heaviest = |w: &BTreeMap<u16, f32>| {
        w.iter()
            .max_by(|a, b| a.1.total_cmp(b.1))
            .map_or(0, |(label, _)| *label)
    };
    gaussians.object_ids = weights.iter().map(heaviest).collect();

    let labelled = gaussians.object_ids.iter().filter(|id| **id > 0).count();
    ply::write(Path::new(&output), &gaussians)?;
    println!(
        "{labelled} of {} Gaussians have a label, from {} views: {output}",
        gaussians.len(),
        cameras.len()
    );
    Ok(())
}
