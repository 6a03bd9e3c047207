//! Trains the Gaussians in and around a filled gap on the filled photos.

use crate::train;
use crate::{Result, Run, Scene, SceneNotes};
use fastlgs_core::{Camera, LabelMap, SceneFolder};
use fastlgs_raster::{Budget, Trainer, TrainerConfig};

/// Number of training steps.
const ITERATIONS: u32 = 400;
/// Least blending weight within the hidden pixels of a view from which a Gaussian is trained, in
/// pixels.
const MIN_WEIGHT: f32 = 0.5;

/// Trains the Gaussians that contribute to the hidden pixels of `views`, the training views. All
/// others stay as they are. `folder` holds the filled photos.
///
/// The removed Gaussians also contributed to pixels beside the object, and each gap was filled from
/// one view. After training, all views agree with their photos again.
pub fn refine(
    scene: &mut Scene,
    folder: &SceneFolder,
    views: &[(Camera, Vec<bool>)],
    run: &Run,
) -> Result<()> {
    let mut is_trained = vec![false; scene.gaussians().len()];
    for (camera, hidden) in views {
        let map = LabelMap {
            width: camera.width,
            height: camera.height,
            labels: hidden.iter().map(|hidden| u16::from(*hidden)).collect(),
        };
        let view = scene.view(camera);
        for vote in scene.engine().votes(view, &map)? {
            is_trained[vote.gaussian as usize] |= vote.label == 1 && vote.weight >= MIN_WEIGHT;
        }
    }
    let mut order: Vec<usize> = (0..is_trained.len()).collect();
    order.sort_by_key(|i| is_trained[*i]);
    let first = scene.gaussians().select(&order);
    let report = scene.trained();
    let config = TrainerConfig {
        iterations: ITERATIONS,
        seed: run.seed,
        budget: Budget::Fixed(first.len()),
        sh_degree: first.sh_degree,
        first_degree: first.sh_degree,
        frozen: is_trained.iter().filter(|trained| !**trained).count(),
        antialias: report.antialias,
        background: report.background,
        exposure: report.exposure,
        ..TrainerConfig::default()
    }
    .for_refinement();
    if config.frozen == first.len() {
        return Ok(());
    }
    let brightness = SceneNotes::read(scene.manifest(), &folder.root)?.brightness;
    let brightness = brightness.unwrap_or_default();
    let cameras: Vec<Camera> = views.iter().map(|view| view.0.clone()).collect();
    let background = train::Background {
        color: report.background,
        learn: false,
    };
    let targets = train::targets(folder, &cameras, None, &background, |name| {
        brightness.gain(name)
    });
    let work = run.work("refine", u64::from(ITERATIONS));
    let engine = fastlgs_raster::open_engine(run.device)?;
    let mut trainer = Trainer::new(engine, &first, targets, config)?;
    trainer.run(None, |progress, _| -> Result<()> {
        work.set_progress(u64::from(progress.iteration), u64::from(ITERATIONS), "");
        work.check()
    })?;
    let mut trained = trainer.gaussians()?;
    trained.object_ids = first.object_ids;
    trained.features = first.features;
    scene.set_gaussians(trained)
}
