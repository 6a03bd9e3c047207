//! State of a running training, for the page.

use crate::splats;
use axum::body::Bytes;
use fastlgs::progress::TrainStep;
use fastlgs_core::Gaussians;
use serde::Serialize;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Shortest time between two snapshots of the Gaussians.
const SNAPSHOT_INTERVAL: Duration = Duration::from_secs(2);
/// No snapshots are taken if no page has polled for this time.
const WATCH_TIMEOUT: Duration = Duration::from_secs(10);
/// Largest number of points of the curves. Above it, every second point is dropped.
const POINTS: usize = 600;

/// Progress of a training run, for the page.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Progress {
    /// Total number of iterations.
    pub iterations: u32,
    /// Number of the snapshot that `/api/splats` returns.
    pub revision: u32,
    /// Whether all iterations are done.
    pub finished: bool,
    /// The curves, oldest first.
    pub curve: Vec<TrainStep>,
}

/// State of a training run that pages can watch.
pub struct Live {
    /// Whether the 2-D Mip filter is on.
    pub antialias: bool,
    /// Background colour, each channel 0 to 1.
    pub background: [f32; 3],
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    progress: Progress,
    splats: Bytes,
    last_snapshot: Option<Instant>,
    last_poll: Option<Instant>,
}

impl Live {
    /// Creates the state of a run before its start. `iterations` is the expected total.
    pub fn new(iterations: u32, antialias: bool, background: [f32; 3]) -> Self {
        let progress = Progress {
            iterations,
            ..Progress::default()
        };
        let first = State {
            progress,
            splats: Bytes::from(splats::pack(&Gaussians::default())),
            ..State::default()
        };
        Self {
            antialias,
            background,
            state: Mutex::new(first),
        }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Adds a point to the curves of a run with `total` iterations. Returns whether a new snapshot
    /// is needed.
    pub fn report(&self, point: TrainStep, total: u32) -> bool {
        let mut state = self.state();
        state.progress.iterations = total;
        let curve = &mut state.progress.curve;
        curve.push(point);
        if curve.len() > POINTS {
            let mut number = 0;
            // Points with a held-out PSNR are few and are kept.
            curve.retain(|p| {
                number += 1;
                number % 2 == 0 || p.psnr_held_out.is_some()
            });
        }
        let watched = state.last_poll.is_some_and(|t| t.elapsed() < WATCH_TIMEOUT);
        watched
            && state
                .last_snapshot
                .is_none_or(|t| t.elapsed() >= SNAPSHOT_INTERVAL)
    }

    /// Stores a snapshot of the Gaussians.
    pub fn set_snapshot(&self, scene: &Gaussians) {
        let splats = Bytes::from(splats::pack(scene));
        let mut state = self.state();
        state.splats = splats;
        state.progress.revision += 1;
        state.last_snapshot = Some(Instant::now());
    }

    /// Stores the final Gaussians. All iterations are done, and objects follow.
    pub fn finish(&self, scene: &Gaussians) {
        self.set_snapshot(scene);
        self.state().progress.finished = true;
    }

    /// Returns the progress, and notes that a page is watching.
    pub fn progress(&self) -> Progress {
        let mut state = self.state();
        state.last_poll = Some(Instant::now());
        state.progress.clone()
    }

    /// Returns the last snapshot, packed for browsers.
    pub fn splats(&self) -> Bytes {
        self.state().splats.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn snapshots_are_taken_only_while_a_page_polls_and_curves_stay_short() {
        let live = Live::new(100_000, false, [0.0; 3]);
        let point = |iteration: u32| TrainStep {
            iteration,
            seconds: 0.0,
            loss: 0.1,
            psnr: 20.0,
            psnr_held_out: None,
            gaussians: 1,
        };
        live.set_snapshot(&Gaussians::default());
        live.state().last_snapshot = None;
        assert!(!live.report(point(20), 30_000), "no page polls");
        assert_eq!(live.progress().revision, 1);
        assert!(live.report(point(40), 30_000));
        live.set_snapshot(&Gaussians::default());
        assert!(!live.report(point(60), 30_000), "the snapshot is recent");
        for k in 4..5_000 {
            live.report(
                TrainStep {
                    psnr_held_out: (k == 1_000).then_some(25.0),
                    ..point(20 * k)
                },
                30_000,
            );
        }
        let progress = live.progress();
        assert_eq!(progress.revision, 2);
        assert!(
            progress.curve.len() <= POINTS
                && progress
                    .curve
                    .windows(2)
                    .all(|w| w[0].iteration < w[1].iteration)
        );
        assert!(progress.curve.iter().any(|p| p.psnr_held_out.is_some()));
    }
}
