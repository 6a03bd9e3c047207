//! Progress of a running stage: messages, warnings and cancellation.

use crate::{Error, Result, stop_point};
use fastlgs_core::Gaussians;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicU64, Ordering};

/// Options of all stages: device, seed and progress sink.
#[derive(Clone, Copy)]
pub struct Run<'a> {
    /// `auto`, `cpu`, or the name or index of an adapter ([`fastlgs_raster::adapters`] lists them).
    pub device: &'a str,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Progress sink, which receives progress and warnings.
    pub progress: &'a dyn Sink,
}

impl<'a> Run<'a> {
    /// Creates a run without messages.
    pub fn silent(device: &'a str, seed: u64) -> Self {
        Self {
            device,
            seed,
            progress: &Silent,
        }
    }

    /// Starts a stage of `total` steps; 0 if their number is unknown.
    pub fn work(&self, stage: &'static str, total: u64) -> Work<'a> {
        self.progress.on_message(Message::Started { stage, total });
        Work {
            sink: self.progress,
            stage,
            total,
            done: AtomicU64::new(0),
        }
    }

    /// Sends a note to the progress sink.
    pub fn note(&self, text: &str) {
        self.progress.on_message(Message::Note(text));
    }

    /// Sends a warning to the progress sink.
    pub fn warn(&self, text: &str) {
        self.progress.on_message(Message::Warning(text));
    }
}

/// Progress sink: receives the messages of a stage. They come from several threads.
pub trait Sink: Sync {
    /// Receives a message.
    fn on_message(&self, message: Message<'_>);

    /// Returns whether the run must end with [`Error::Cancelled`] at its next step. Earlier results
    /// remain, and a training can be resumed from its last checkpoint.
    fn cancelled(&self) -> bool {
        false
    }
}

/// A sink that ignores all messages and never cancels.
pub struct Silent;

impl Sink for Silent {
    fn on_message(&self, _: Message<'_>) {}
}

/// A message of a stage.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum Message<'a> {
    /// A stage begins.
    Started {
        /// Name of the stage, such as `masks`.
        stage: &'static str,
        /// Number of all steps; 0 if it is unknown.
        total: u64,
    },
    /// A stage has made progress.
    Advanced {
        /// Name of the stage.
        stage: &'static str,
        /// Number of completed steps.
        done: u64,
        /// Number of all steps; 0 if it is unknown.
        total: u64,
        /// Current activity; may be empty.
        note: &'a str,
    },
    /// Training begins with these Gaussians.
    TrainingBegins(&'a Gaussians),
    /// Training has made progress.
    Trained {
        /// State of the training.
        step: TrainStep,
        /// Number of all iterations.
        total: u32,
        /// Returns the current Gaussians, which are copied from the device.
        scene: &'a dyn Fn() -> Result<Gaussians>,
    },
    /// Training ends with these Gaussians. Finding objects follows.
    TrainingEnds(&'a Gaussians),
    /// A stage ends, with success or with an error.
    Finished {
        /// Name of the stage.
        stage: &'static str,
    },
    /// A note, such as how long a stage takes.
    Note(&'a str),
    /// A warning: the stage continues.
    Warning(&'a str),
}

/// State of a training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrainStep {
    /// Number of completed iterations.
    pub iteration: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Loss of the last measured training view: 0.8 L1 + 0.2 (1 - SSIM).
    pub loss: f64,
    /// PSNR of that view in dB.
    pub psnr: f64,
    /// PSNR of the held-out views in dB, if it was measured.
    pub psnr_held_out: Option<f64>,
    /// Number of Gaussians.
    pub gaussians: usize,
}

/// A running stage. Dropping it ends the stage.
pub struct Work<'a> {
    sink: &'a dyn Sink,
    stage: &'static str,
    total: u64,
    done: AtomicU64,
}

impl Work<'_> {
    /// Reports one more completed step.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if the sink cancels the run.
    pub fn advance(&self) -> Result<()> {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.sink.on_message(Message::Advanced {
            stage: self.stage,
            done,
            total: self.total,
            note: "",
        });
        stop_point::reach(self.stage, done);
        self.check()
    }

    /// Reports the current activity.
    pub fn set_activity(&self, note: &str) {
        let done = self.done.load(Ordering::Relaxed);
        self.sink.on_message(Message::Advanced {
            stage: self.stage,
            done,
            total: self.total,
            note,
        });
    }

    /// Reports `done` of `total` steps and the current activity, for stages whose number of steps
    /// is unknown at the start.
    pub fn set_progress(&self, done: u64, total: u64, note: &str) {
        self.done.store(done, Ordering::Relaxed);
        self.sink.on_message(Message::Advanced {
            stage: self.stage,
            done,
            total,
            note,
        });
    }

    /// Checks whether the sink cancels the run.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if it does.
    pub fn check(&self) -> Result<()> {
        if self.sink.cancelled() {
            Err(Error::Cancelled)
        } else {
            Ok(())
        }
    }
}

impl Drop for Work<'_> {
    fn drop(&mut self) {
        self.sink
            .on_message(Message::Finished { stage: self.stage });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    /// Records all messages, and cancels after `after` steps.
    struct Record {
        messages: Mutex<Vec<String>>,
        after: u64,
    }

    impl Sink for Record {
        fn on_message(&self, message: Message<'_>) {
            let line = match message {
                Message::Started { stage, total } => format!("{stage} of {total}"),
                Message::Advanced { done, note, .. } => format!("{done}{note}"),
                Message::Finished { stage } => format!("{stage} over"),
                _ => "other".to_owned(),
            };
            self.messages.lock().unwrap().push(line);
        }

        fn cancelled(&self) -> bool {
            self.messages
                .lock()
                .unwrap()
                .iter()
                .filter(|l| l.parse::<u64>().is_ok())
                .count() as u64
                >= self.after
        }
    }

    #[test]
    fn progress_is_reported_and_a_run_can_be_cancelled() {
        let sink = Record {
            messages: Mutex::default(),
            after: 2,
        };
        let run = Run {
            progress: &sink,
            ..Run::silent("cpu", 0)
        };
        let work = || -> Result<()> {
            let work = run.work("masks", 3);
            work.set_activity(" first");
            (0..3).try_for_each(|_| work.advance())
        };
        assert!(matches!(work(), Err(Error::Cancelled)));
        assert_eq!(
            *sink.messages.lock().unwrap(),
            ["masks of 3", "0 first", "1", "2", "masks over"]
        );
    }
}
