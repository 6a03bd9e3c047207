//! How many iterations fit into the minutes that somebody has.

use super::config::{Config, Mapping, Preset};
use super::settings::{device, settings};
use super::{borders, start};
use crate::{Result, Run, checkpoints, objects};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, SceneFolder};
use fastlgs_raster::{Targets, Trainer};
use serde_json::json;
use std::time::Instant;

/// Iterations of the trial, which is a whole run in small: half resolution, growth, removal and all.
const TRIAL: u32 = 100;
/// What an iteration of a long run costs, for each of the trial: scenes grow for longer.
const GROWTH: f64 = 1.3;
/// Iterations of any run: fewer make no scene, and more gain nothing.
const FEWEST: u32 = 500;
const MOST: u32 = 30_000;

/// Note of the manifest: what was decided, for a run that goes on after it was broken off.
pub const NOTE: &str = "minutes";

/// `config` with iterations, and the preset's limits, that fit into its minutes together with the mapping, of which those that have gone since
/// `began` are no longer there; itself where it has none.
pub fn fitted(
    config: &Config,
    folder: &SceneFolder,
    manifest: &mut Manifest,
    training: &[Camera],
    targets: &Targets,
    began: Instant,
    run: &Run,
) -> Result<Config> {
    let Some(minutes) = config.minutes else { return Ok(config.clone()) };
    let decided = manifest.notes.get(NOTE).and_then(|note| serde_json::from_value(note.clone()).ok());
    let iterations = match decided.filter(|_| config.resume && checkpoints::is_begun(folder)) {
        Some(iterations) => iterations,
        None => {
            // Algorithm 1 is done by now, and so are objects that are kept.
            let mapping = if config.mapping == Mapping::Global { objects::seconds_of_embedding(folder, training)? } else { 0.0 };
            let [step, removals] = trial(config, folder, manifest, targets, run)?.map(|seconds| GROWTH * seconds);
            // What the trial took is gone as well.
            let fit = (60.0 * minutes - began.elapsed().as_secs_f64() - mapping - removals) / step;
            tracing::info!(minutes, mapping, removals, milliseconds_a_step = 1e3 * step, fit, "what fits");
            if fit < f64::from(FEWEST) {
                let (left, needed) = (minutes.max(0.0), (mapping + removals + step * f64::from(FEWEST)) / 60.0);
                run.warn(&format!(
                    "{left:.1} minutes are left for training, too few for these photos on this machine: {FEWEST} iterations take about {needed:.1}"
                ));
            }
            rounded(fit)
        }
    };
    manifest.notes.insert(NOTE.to_owned(), json!(iterations));
    folder.save_manifest(manifest)?;
    let preset = [Preset::Quick, Preset::Standard].into_iter().find(|p| p.values().0 >= iterations).unwrap_or(Preset::Paper);
    Ok(Config { preset, iterations: Some(iterations), ..config.clone() })
}

/// Whole hundreds, within what makes sense.
fn rounded(iterations: f64) -> u32 {
    ((iterations / 100.0).floor() as u32 * 100).clamp(FEWEST, MOST)
}

/// Seconds that an iteration of the trial takes, and those in which it was chosen what to remove: that is done twice a run, however long it is.
fn trial(config: &Config, folder: &SceneFolder, manifest: &Manifest, targets: &Targets, run: &Run) -> Result<[f64; 2]> {
    let short = Config { iterations: Some(TRIAL), ..config.clone() };
    let first = start::gaussians(&short, folder, targets, run)?;
    let settings = settings(&short, &first, targets, manifest, run.seed)?;
    let engine = fastlgs_raster::open_engine_as(&device(MOST, run)?.device, config.shape)?;
    let work = run.work("trial", u64::from(TRIAL));
    let couples_at = settings.couples_at;
    let mut trainer = Trainer::new(engine, &first, targets.clone(), settings)?;
    trainer.keep_free(start::free_space(&short, folder, &targets.cameras, &first)?);
    let result = trainer.run(None, |progress, trainer| {
        if couples_at == Some(progress.iteration) {
            borders::pretend(trainer)?;
        }
        work.check()
    })?;
    // The first step is not in these seconds.
    Ok([(result.seconds - result.removal_seconds) / f64::from(TRIAL - 1), result.removal_seconds])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn iterations_are_whole_hundreds_within_reason() {
        assert_eq!([-3.0, 120.0, 2_399.0, 1e9].map(rounded), [500, 500, 2_300, 30_000]);
    }
}
