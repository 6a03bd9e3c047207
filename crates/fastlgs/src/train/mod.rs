//! Training: optimises Gaussians with colour and features, then finds their objects (paper,
//! training features for Gaussians).

mod config;
mod init;
mod map_objects;
mod mask_supervision;
mod report;
mod run;
mod settings;
mod texture;

use crate::error::Context;
use crate::output::SceneLock;
use crate::staged::StagedOutput;
use crate::{Error, Result, Run, SceneNotes, checkpoints, objects, transparent};
pub use config::{Background, Cue, FeatureMode, Mapping, Preset, Switch, TrainConfig};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, SceneFolder, ply};
use fastlgs_grid::Grid;
use fastlgs_raster::Targets;
pub(crate) use init::{target, targets};
use map_objects::MappedObjects;
pub use report::{CurvePoint, TrainReport};
use run::Trained;

/// Files of the scene that training replaces, besides the manifest and the object maps.
const REPLACED: [&str; 4] = [
    "grid.json",
    "grid.safetensors",
    "scene.ply",
    "cameras/trained.json",
];

/// Trains the scene `config.scene`: writes its Gaussians, object table and object maps.
///
/// # Errors
/// Contradictory options, a scene that was not preprocessed, a failing device, or a cancelled run.
/// The earlier scene then stays unchanged, and `config.resume` continues from the last checkpoint.
pub fn train(config: &TrainConfig, run: &Run) -> Result<TrainReport> {
    train_locked(config, &SceneLock::of_scene(&config.scene, "train")?, run)
}

/// Trains a scene that the caller has locked.
pub(crate) fn train_locked(
    config: &TrainConfig,
    _lock: &SceneLock,
    run: &Run,
) -> Result<TrainReport> {
    let config = config.resolved();
    check(&config)?;
    let inputs = Inputs::read(config, run)?;
    let mut trained = run::train(&inputs, run)?;
    let mapped = map_objects::map_objects(&inputs, &mut trained, run)?;
    write(inputs, trained, mapped)
}

/// Refuses options that contradict each other.
fn check(config: &TrainConfig) -> Result<()> {
    let trains_features = config.feature_mode == FeatureMode::Train;
    if config.preset == Preset::LikePaper && config.mapping == Mapping::Keep {
        return Err(Error::option(
            "preset",
            "'like-paper' finds objects by Algorithm 1 and cannot keep existing ones; omit mapping 'keep', or choose another preset",
        ));
    }
    if trains_features && config.mapping == Mapping::Global {
        return Err(Error::option(
            "feature_mode",
            "'train' needs the objects before training; set mapping to paper, or to keep for those of a trained scene",
        ));
    }
    if config.freeze && !trains_features {
        return Err(Error::option(
            "freeze",
            "this trains features only; set feature_mode to train, and mapping to paper or keep; to lift objects without training, set iterations to 0",
        ));
    }
    Ok(())
}

/// Options of a training, and its inputs from the scene folder.
struct Inputs {
    config: TrainConfig,
    folder: SceneFolder,
    manifest: Manifest,
    notes: SceneNotes,
    /// Cameras as `preprocess` wrote them.
    initial_cameras: Vec<Camera>,
    /// Cameras that training starts with, of all views.
    cameras: Vec<Camera>,
    /// The training views among them.
    training: Vec<Camera>,
    /// Objects that are known before training.
    prior_objects: Option<Grid>,
}

impl Inputs {
    fn read(config: TrainConfig, run: &Run) -> Result<Self> {
        let folder = SceneFolder::open(&config.scene)?;
        let manifest = folder.manifest()?;
        let initial_cameras = folder.initial_cameras()?;
        // Gaussians of an earlier training belong to its cameras, which alignment may have moved.
        let cameras = if config.init.is_some() {
            folder.cameras()?
        } else {
            initial_cameras.clone()
        };
        let training = manifest.training(&cameras);
        let prior_objects = match config.mapping {
            Mapping::Paper => {
                let paper = config.paper(&manifest.encoder);
                Some(crate::paper::map(&folder, &training, &paper, run)?)
            }
            Mapping::Keep => Some(objects::load_kept(&folder, &training)?),
            Mapping::Global => None,
        };
        Ok(Self {
            config: init::with_earlier_settings(&config, &folder, &manifest)?,
            notes: SceneNotes::read(&manifest, &folder.root)?,
            folder,
            manifest,
            initial_cameras,
            cameras,
            training,
            prior_objects,
        })
    }

    /// Whether features are trained by gradient descent.
    fn trains_features(&self) -> bool {
        self.config.feature_mode == FeatureMode::Train
    }

    /// Target images of the training views.
    fn targets(&self) -> Targets {
        let codes = self
            .prior_objects
            .as_ref()
            .filter(|_| self.trains_features());
        let brightness = self.notes.brightness.clone().unwrap_or_default();
        init::targets(
            &self.folder,
            &self.training,
            codes.map(init::codes).as_ref(),
            &self.config.background.unwrap_or_default(),
            |name| brightness.gain(name),
        )
    }

    /// Target images of the held-out views.
    fn held_out(&self) -> Targets {
        let cameras = self.manifest.held_out(&self.cameras);
        let background = self.config.background.unwrap_or_default();
        init::targets(&self.folder, &cameras, None, &background, |_| [1.0; 3])
    }
}

/// Writes the result to the scene folder.
fn write(inputs: Inputs, trained: Trained, mapped: MappedObjects) -> Result<TrainReport> {
    let staged = StagedOutput::new(&inputs.folder, "train")?;
    mapped.grid.save(&staged.folder)?;
    staged
        .folder
        .save_trained_cameras(trained.aligned.then_some(&trained.cameras))?;
    ply::write(&staged.folder.ply_path(), &trained.scene)
        .context("the trained scene cannot be written")?;
    let report = report(&inputs.config, trained, mapped);
    let Inputs {
        folder,
        mut manifest,
        mut notes,
        ..
    } = inputs;
    manifest.seconds.insert("train".to_owned(), report.seconds);
    // The note of `make` is invalid now; `make` writes it again if it called this function.
    notes.made = None;
    notes.train = Some(report.clone());
    notes.store(&mut manifest)?;
    staged.publish(&folder, &REPLACED, [], &manifest)?;
    objects::mark_maps_finished(&folder);
    // Only an interrupted run needs its checkpoints.
    checkpoints::remove_all(&folder);
    Ok(report)
}

fn report(config: &TrainConfig, trained: Trained, mapped: MappedObjects) -> TrainReport {
    let Trained {
        scene,
        cameras,
        result,
        settings,
        ..
    } = trained;
    let [r, g, b, ..] = result.background;
    TrainReport {
        scene: config.scene.clone(),
        preset: config.preset,
        mapping: config.mapping,
        feature_mode: config.feature_mode,
        objects: mapped.grid.objects.len(),
        mapping_seconds: trained.supervision_seconds + mapped.seconds,
        mapping_summary: mapped.summary,
        iterations: result.iterations,
        seconds: result.seconds,
        iterations_per_second: result.iterations_per_second,
        gaussians: scene.len(),
        clear: transparent::count(&scene),
        removals: result.removals,
        sh_degree: scene.sh_degree,
        exposure: settings.exposure,
        alignment_gain: result.alignment_gain,
        aligned: trained.aligned,
        borders: settings.couples_at.is_some() && result.iterations > 0,
        antialias: settings.antialias,
        background: [r, g, b],
        size: format!("{}x{}", cameras[0].width, cameras[0].height),
        psnr_held_out: trained.psnr_held_out,
        curve: trained.curve,
        adapter: result.adapter,
        device: trained.device,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contradictory_options_are_refused_by_name() {
        let refused = |config: TrainConfig| match check(&config) {
            Err(Error::Option { option, .. }) => option,
            other => panic!("{other:?}"),
        };
        let features = TrainConfig {
            feature_mode: FeatureMode::Train,
            ..TrainConfig::default()
        };
        assert_eq!(refused(features), "feature_mode");
        let keep = TrainConfig {
            preset: Preset::LikePaper,
            mapping: Mapping::Keep,
            ..TrainConfig::default()
        };
        assert_eq!(refused(keep), "preset");
        let freeze = TrainConfig {
            freeze: true,
            ..TrainConfig::default()
        };
        assert_eq!(refused(freeze), "freeze");
        assert!(check(&TrainConfig::default()).is_ok());
    }
}
