//! One bar over all stages of `make`.

use fastlgs::progress::{Message, Sink};
use fastlgs::train::Preset;
use std::sync::atomic::{AtomicU64, Ordering};

/// What the bar is called.
pub const WHOLE: &str = "make";

/// A stage, and the seconds that it took on the fox scene.
type Stage = (&'static str, u64);

/// The stages before training, in their order. Those that a scene does not need are passed over.
const PREPARING: [Stage; 9] = [
    ("frames", 15),
    ("poses", 55),
    ("photos", 5),
    ("key points for the pose check", 3),
    ("poses anew", 25),
    ("matches", 4),
    ("bundle adjustment", 2),
    ("masks", 60),
    ("depths", 9),
];

/// What follows them: training, and then the objects.
const OURS: [Stage; 4] = [("train", 125), ("votes", 5), ("objects", 10), ("embeddings", 90)];

/// The same where all is made as the paper has it: objects come before training, which takes most of the time.
const PAPERS: [Stage; 2] = [("embeddings", 300), ("train", 4000)];

/// All stages of a scene that is made with some effort.
fn stages(effort: Preset) -> Vec<Stage> {
    let rest = if effort == Preset::LikePaper { &PAPERS[..] } else { &OURS };
    [&PREPARING[..], rest].concat()
}

/// Tells another sink of all stages as one.
pub struct Whole<'a> {
    sink: &'a dyn Sink,
    stages: Vec<Stage>,
    /// In hundredths of a per cent: stages may come in another order, but the bar goes on.
    reached: AtomicU64,
}

/// Parts of the bar.
const PARTS: u64 = 10_000;

impl<'a> Whole<'a> {
    /// Begins the bar of a scene that is made with some effort.
    pub fn new(sink: &'a dyn Sink, effort: Preset) -> Self {
        sink.tell(Message::Started { stage: WHOLE, total: PARTS });
        Self { sink, stages: stages(effort), reached: AtomicU64::new(0) }
    }

    /// A stage has done `done` of `total`.
    fn reach(&self, stage: &str, done: u64, total: u64, note: &str) {
        let place = parts_at(&self.stages, stage, done as f64 / total.max(1) as f64);
        let place = self.reached.fetch_max(place, Ordering::Relaxed).max(place);
        let note = if note.is_empty() { stage.to_owned() } else { format!("{stage}: {note}") };
        self.sink.tell(Message::Advanced { stage: WHOLE, done: place, total: PARTS, note: &note });
    }
}

/// Where the bar stands when a share of a stage is done; nowhere for one that it does not know.
fn parts_at(stages: &[Stage], stage: &str, share: f64) -> u64 {
    let Some(place) = stages.iter().position(|s| s.0 == stage) else { return 0 };
    let seconds = |stages: &[Stage]| stages.iter().map(|s| s.1 as f64).sum::<f64>();
    let done = seconds(&stages[..place]) + share.min(1.0) * stages[place].1 as f64;
    (PARTS as f64 * done / seconds(stages)) as u64
}

impl Sink for Whole<'_> {
    fn tell(&self, message: Message<'_>) {
        match message {
            Message::Started { stage, .. } => self.reach(stage, 0, 1, ""),
            Message::Advanced { stage, done, total, note } => self.reach(stage, if total == 0 { 0 } else { done }, total, note),
            Message::Trained { step, total, .. } => {
                let note = format!("{:.1} dB, {}k Gaussians", step.psnr, step.gaussians / 1000);
                self.reach("train", u64::from(step.iteration), u64::from(total), &note);
            }
            Message::Finished { stage } => self.reach(stage, 1, 1, ""),
            other => self.sink.tell(other),
        }
    }

    fn cancelled(&self) -> bool {
        self.sink.cancelled()
    }
}

impl Drop for Whole<'_> {
    fn drop(&mut self) {
        self.sink.tell(Message::Finished { stage: WHOLE });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    struct Record(Mutex<Vec<(u64, String)>>);

    impl Sink for Record {
        fn tell(&self, message: Message<'_>) {
            if let Message::Advanced { stage: WHOLE, done, note, .. } = message {
                self.0.lock().unwrap().push((done, note.to_owned()));
            }
        }
    }

    #[test]
    fn the_bar_goes_on_through_all_stages() {
        let record = Record(Mutex::default());
        let whole = Whole::new(&record, Preset::Quick);
        for stage in ["photos", "masks", "a stage that nobody knows", "embeddings"] {
            whole.tell(Message::Started { stage, total: 4 });
            whole.tell(Message::Advanced { stage, done: 2, total: 4, note: "x" });
            whole.tell(Message::Finished { stage });
        }
        let told = record.0.lock().unwrap();
        assert!(told.is_sorted_by_key(|t| t.0), "{told:?}");
        assert_eq!((told[0].1.as_str(), told[1].1.as_str()), ("photos", "photos: x"));
        assert_eq!(told.last().unwrap().0, PARTS);
        assert!(told[0].0 > 0, "poses were there already");
        let before = |stage: &str| parts_at(&stages(Preset::LikePaper), stage, 0.0);
        assert!(before("embeddings") < before("train"), "objects come first there");
    }
}
