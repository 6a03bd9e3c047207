//! Embeds the objects beside a removed object again.
//!
//! An embedding also describes the surroundings of a mask. Without new ones, a text that names the
//! removed object would find what it stood on.

use crate::query::selection;
use crate::{Result, Run, Scene, detections, embedding_views, model_choice, objects};
use fastlgs_core::{Camera, SceneFolder};
use fastlgs_grid::Grid;
use fastlgs_grid::support::ViewSupport;

/// Replaces the embeddings of the objects that the hidden pixels of `views`, the training views,
/// show. `folder` receives the object maps of the new scene and holds its photos. Objects keep their
/// embeddings if the encoder is not available.
pub fn renew(
    scene: &mut Scene,
    grid: &mut Grid,
    folder: &SceneFolder,
    views: &[(Camera, Vec<bool>)],
    run: &Run,
) -> Result<()> {
    let mut touched = vec![false; grid.objects.len()];
    let mut supports: Vec<Vec<ViewSupport>> = vec![Vec::new(); grid.objects.len()];
    for (view, (camera, hidden)) in views.iter().enumerate() {
        let field = scene.field_without_transparent(camera)?;
        field.ids(grid).save(&folder.objects_path(&camera.name))?;
        let mut pixels = vec![0; grid.objects.len()];
        let mut hidden = hidden.iter();
        field.for_each_pixel(grid, |shown| {
            let is_hidden = hidden.next().copied().unwrap_or_default();
            for id in shown {
                let object = usize::from(*id) - 1;
                pixels[object] += 1;
                touched[object] |= is_hidden;
            }
        });
        for (supports, pixels) in supports.iter_mut().zip(pixels) {
            if pixels > 0 {
                supports.push(ViewSupport {
                    view: view as u32,
                    pixels,
                    iou: 1.0,
                });
            }
        }
    }
    let encoder = match model_choice::encoder_of(scene.folder(), scene.manifest()) {
        Ok(encoder) if scene.manifest().encoder != "import" => encoder,
        _ => {
            run.warn(
                "the objects beside the removed one keep their embeddings, because the encoder is not available; a text may still find the removed object there",
            );
            return Ok(());
        }
    };
    let cameras: Vec<Camera> = views.iter().map(|view| view.0.clone()).collect();
    let own = selection::gaussians_by_object(scene.gaussians(), grid);
    let chosen = (0..grid.objects.len()).map(|object| {
        if touched[object] {
            embedding_views::choose(&supports[object], &own[object], scene.gaussians(), &cameras)
        } else {
            Vec::new()
        }
    });
    let chosen: Vec<Vec<usize>> = chosen.collect();
    let found = objects::embed(folder, &cameras, &grid.lists(), &chosen, &*encoder, run)?;
    for object in &mut grid.objects {
        let is_seen = |values: &[f32]| values.iter().any(|value| *value != 0.0);
        let new = found
            .iter()
            .filter(|mask| mask.label == object.id && is_seen(&mask.embedding));
        let (embeddings, areas): (Vec<_>, Vec<_>) =
            new.map(|mask| (mask.embedding.clone(), mask.area)).unzip();
        if !embeddings.is_empty() {
            (object.embeddings, object.areas) = (embeddings, areas);
        }
    }
    if let Some(detector) = detections::detector_of(scene.manifest())? {
        let votes = detections::votes(folder, &cameras, &grid.lists(), &detector, run)?;
        for ((object, votes), _) in grid
            .objects
            .iter_mut()
            .zip(votes)
            .zip(&touched)
            .filter(|(_, touched)| **touched)
        {
            object.detected = Some(votes);
        }
    }
    tracing::debug!(
        objects = touched.iter().filter(|touched| **touched).count(),
        "embedded again"
    );
    Ok(())
}
