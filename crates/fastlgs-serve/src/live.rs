//! A training run that is watched: what the page shows while the scene grows.

use crate::splats;
use axum::body::Bytes;
use fastlgs::progress::TrainStep;
use fastlgs_core::Gaussians;
use serde::Serialize;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Pictures of the growing scene are not made more often than this.
const PICTURE_EVERY: Duration = Duration::from_secs(2);
/// Nor at all when no page has asked for so long.
const WATCHED: Duration = Duration::from_secs(10);
/// Points of the curves; older ones are thinned out when there are more.
const POINTS: usize = 600;

/// What a page is told about a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Progress {
    /// Steps that the run will have.
    pub iterations: u32,
    /// Number of the picture that `/api/splats` gives now.
    pub revision: u32,
    /// Whether the run is over.
    pub finished: bool,
    /// The curves, oldest first.
    pub curve: Vec<TrainStep>,
}

/// A run and who watches it.
pub struct Live {
    /// Whether the 2-D Mip filter is on.
    pub antialias: bool,
    /// Colour behind everything.
    pub background: [f32; 3],
    state: Mutex<Watched>,
}

#[derive(Default)]
struct Watched {
    progress: Progress,
    splats: Bytes,
    pictured: Option<Instant>,
    asked: Option<Instant>,
}

impl Live {
    /// A run that is about to begin, as far as is known of `iterations` steps.
    pub fn new(iterations: u32, antialias: bool, background: [f32; 3]) -> Self {
        let progress = Progress { iterations, ..Progress::default() };
        let first = Watched { progress, splats: Bytes::from(splats::pack(&Gaussians::default())), ..Watched::default() };
        Self { antialias, background, state: Mutex::new(first) }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, Watched> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Adds to the curves of a run of `total` steps; true when a new picture of the scene is wanted.
    pub fn report(&self, point: TrainStep, total: u32) -> bool {
        let mut state = self.state();
        state.progress.iterations = total;
        let curve = &mut state.progress.curve;
        curve.push(point);
        if curve.len() > POINTS {
            let mut number = 0;
            // Measured held-out values are few and stay.
            curve.retain(|p| {
                number += 1;
                number % 2 == 0 || p.psnr_held_out.is_some()
            });
        }
        let watched = state.asked.is_some_and(|t| t.elapsed() < WATCHED);
        watched && state.pictured.is_none_or(|t| t.elapsed() >= PICTURE_EVERY)
    }

    /// The scene as it is now.
    pub fn picture(&self, scene: &Gaussians) {
        let splats = Bytes::from(splats::pack(scene));
        let mut state = self.state();
        state.splats = splats;
        state.progress.revision += 1;
        state.pictured = Some(Instant::now());
    }

    /// Steps are over; objects are being made.
    pub fn finish(&self, scene: &Gaussians) {
        self.picture(scene);
        self.state().progress.finished = true;
    }

    /// What the page asks for.
    pub fn progress(&self) -> Progress {
        let mut state = self.state();
        state.asked = Some(Instant::now());
        state.progress.clone()
    }

    /// The last picture.
    pub fn splats(&self) -> Bytes {
        self.state().splats.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_made_for_those_who_watch_and_curves_stay_short() {
        let live = Live::new(100_000, false, [0.0; 3]);
        let point = |iteration: u32| TrainStep { iteration, seconds: 0.0, loss: 0.1, psnr: 20.0, psnr_held_out: None, gaussians: 1 };
        live.picture(&Gaussians::default());
        live.state().pictured = None;
        assert!(!live.report(point(20), 30_000), "no one watches");
        assert_eq!(live.progress().revision, 1);
        assert!(live.report(point(40), 30_000));
        live.picture(&Gaussians::default());
        assert!(!live.report(point(60), 30_000), "the last picture is fresh");
        for k in 4..5_000 {
            live.report(TrainStep { psnr_held_out: (k == 1_000).then_some(25.0), ..point(20 * k) }, 30_000);
        }
        let progress = live.progress();
        assert_eq!(progress.revision, 2);
        assert!(progress.curve.len() <= POINTS && progress.curve.windows(2).all(|w| w[0].iteration < w[1].iteration));
        assert!(progress.curve.iter().any(|p| p.psnr_held_out.is_some()));
    }
}
