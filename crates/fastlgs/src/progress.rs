//! What a running stage tells, and how it is stopped.

use crate::{Error, Result};
use fastlgs_core::Gaussians;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicU64, Ordering};

/// What all stages share: device, seed, and who hears of their progress.
#[derive(Clone, Copy)]
pub struct Run<'a> {
    /// `auto`, `cpu`, or an adapter's name or index ([`fastlgs_raster::adapters`] lists them).
    pub device: &'a str,
    /// Seed of all randomness.
    pub seed: u64,
    /// Who hears of progress and warnings.
    pub progress: &'a dyn Sink,
}

impl<'a> Run<'a> {
    /// A run that nobody watches.
    pub fn silent(device: &'a str, seed: u64) -> Self {
        Self { device, seed, progress: &Silent }
    }

    /// Begins a stretch of work of `total` steps (0 where that is not known).
    pub fn work(&self, stage: &'static str, total: u64) -> Work<'a> {
        self.progress.tell(Message::Started { stage, total });
        Work { sink: self.progress, stage, total, done: AtomicU64::new(0) }
    }

    /// Tells of something survivable.
    pub fn warn(&self, text: &str) {
        self.progress.tell(Message::Warning(text));
    }
}

/// Hears what a stage tells. Messages come from several threads.
pub trait Sink: Sync {
    /// Takes a message.
    fn tell(&self, message: Message<'_>);

    /// Whether the run shall end with [`Error::Cancelled`] at its next step. Earlier results stay whole, and a training that is
    /// resumed goes on from its last checkpoint.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Hears nothing and never cancels.
pub struct Silent;

impl Sink for Silent {
    fn tell(&self, _: Message<'_>) {}
}

/// What a stage tells.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum Message<'a> {
    /// A stage begins.
    Started {
        /// Its name, such as `masks`.
        stage: &'static str,
        /// Its steps; 0 where their number is not known.
        total: u64,
    },
    /// Steps were done.
    Advanced {
        /// As it was started.
        stage: &'static str,
        /// All that were done so far.
        done: u64,
        /// As it was started.
        total: u64,
        /// What is being done now; empty where there is nothing to say.
        note: &'a str,
    },
    /// Training begins with these Gaussians.
    TrainingBegins(&'a Gaussians),
    /// Training goes on.
    Trained {
        /// Where it stands.
        step: TrainStep,
        /// Iterations that the run will have.
        total: u32,
        /// Gives the Gaussians as they are now, which costs a copy from the device.
        scene: &'a dyn Fn() -> Result<Gaussians>,
    },
    /// Training is over, with these Gaussians; objects follow.
    TrainingEnds(&'a Gaussians),
    /// A stage is over, well or not.
    Finished {
        /// As it was started.
        stage: &'static str,
    },
    /// Something survivable is wrong.
    Warning(&'a str),
}

/// Where training stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrainStep {
    /// Steps done.
    pub iteration: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// 0.8 L1 + 0.2 (1 - SSIM) of the last measured training view.
    pub loss: f64,
    /// PSNR of that view in dB.
    pub psnr: f64,
    /// PSNR of the held-out views in dB, where it was measured.
    pub psnr_held_out: Option<f64>,
    /// Gaussians.
    pub gaussians: usize,
}

/// A stretch of work that is being done; dropping it ends the stage.
pub struct Work<'a> {
    sink: &'a dyn Sink,
    stage: &'static str,
    total: u64,
    done: AtomicU64,
}

impl Work<'_> {
    /// One more step is done.
    ///
    /// # Errors
    /// [`Error::Cancelled`] where that is asked for.
    pub fn advance(&self) -> Result<()> {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.sink.tell(Message::Advanced { stage: self.stage, done, total: self.total, note: "" });
        self.check()
    }

    /// Says what is being done now.
    pub fn note(&self, note: &str) {
        let done = self.done.load(Ordering::Relaxed);
        self.sink.tell(Message::Advanced { stage: self.stage, done, total: self.total, note });
    }

    /// So much of `total` is done, and what is being done now; for work whose extent shows only on the way.
    pub fn set(&self, done: u64, total: u64, note: &str) {
        self.done.store(done, Ordering::Relaxed);
        self.sink.tell(Message::Advanced { stage: self.stage, done, total, note });
    }

    /// Ends the run where that is asked for.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub fn check(&self) -> Result<()> {
        if self.sink.cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }
}

impl Drop for Work<'_> {
    fn drop(&mut self) {
        self.sink.tell(Message::Finished { stage: self.stage });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    /// Writes down what it hears, and cancels after so many steps.
    struct Record {
        heard: Mutex<Vec<String>>,
        after: u64,
    }

    impl Sink for Record {
        fn tell(&self, message: Message<'_>) {
            let line = match message {
                Message::Started { stage, total } => format!("{stage} of {total}"),
                Message::Advanced { done, note, .. } => format!("{done}{note}"),
                Message::Finished { stage } => format!("{stage} over"),
                _ => "other".to_owned(),
            };
            self.heard.lock().unwrap().push(line);
        }

        fn cancelled(&self) -> bool {
            self.heard.lock().unwrap().iter().filter(|l| l.parse::<u64>().is_ok()).count() as u64 >= self.after
        }
    }

    #[test]
    fn work_is_told_and_cancelled() {
        let sink = Record { heard: Mutex::default(), after: 2 };
        let run = Run { progress: &sink, ..Run::silent("cpu", 0) };
        let work = || -> Result<()> {
            let work = run.work("masks", 3);
            work.note(" first");
            (0..3).try_for_each(|_| work.advance())
        };
        assert!(matches!(work(), Err(Error::Cancelled)));
        assert_eq!(*sink.heard.lock().unwrap(), ["masks of 3", "0 first", "1", "2", "masks over"]);
    }
}
