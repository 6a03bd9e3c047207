//! Progress on stderr: bars on a terminal, occasional lines elsewhere.

use crate::ui::Common;
use fastlgs::progress::{Message, Sink};
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Shortest time between two progress lines of a stage. A line also needs another tenth of the
/// stage to be done.
const MIN_LINE_INTERVAL: Duration = Duration::from_secs(15);

/// Prints progress to stderr.
pub struct Console {
    medium: Medium,
    stages: Mutex<BTreeMap<&'static str, Stage>>,
}

#[derive(Clone, Copy, PartialEq)]
enum Medium {
    Bars,
    Lines,
    Nothing,
}

/// A running stage.
struct Stage {
    bar: ProgressBar,
    started: Instant,
    /// Time of the last printed line, and the number of steps done by then.
    last_line: (Instant, u64),
}

impl Console {
    /// Creates a console: bars on a terminal, lines elsewhere, nothing with `--quiet`.
    pub fn new(common: &Common) -> Self {
        let medium = match (common.quiet, std::io::stderr().is_terminal()) {
            (true, _) => Medium::Nothing,
            (false, true) => Medium::Bars,
            (false, false) => Medium::Lines,
        };
        Self {
            medium,
            stages: Mutex::default(),
        }
    }

    fn stages(&self) -> std::sync::MutexGuard<'_, BTreeMap<&'static str, Stage>> {
        self.stages
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn start(&self, stage: &'static str, total: u64) {
        let bar = if self.medium == Medium::Bars {
            ProgressBar::new(total)
        } else {
            ProgressBar::hidden()
        };
        let template = "{msg:44!} {bar:30} {pos}/{len} {per_sec} {elapsed} (eta {eta})";
        bar.set_style(ProgressStyle::with_template(template).expect("a fixed template"));
        bar.set_message(stage);
        let now = Instant::now();
        self.stages().insert(
            stage,
            Stage {
                bar,
                started: now,
                last_line: (now, 0),
            },
        );
    }

    /// Shows that `done` of `total` steps are done. `facts` is additional text for the end of the
    /// line.
    fn advance(&self, name: &'static str, done: u64, total: u64, facts: &str) {
        let mut stages = self.stages();
        let Some(stage) = stages.get_mut(name) else {
            return;
        };
        match self.medium {
            Medium::Nothing => {}
            Medium::Bars => {
                stage.bar.set_length(total);
                stage.bar.set_position(done);
                if !facts.is_empty() {
                    stage.bar.set_message(format!("{name}: {facts}"));
                }
            }
            Medium::Lines => {
                if stage.last_line.0.elapsed() >= MIN_LINE_INTERVAL
                    && is_tenth_more(stage.last_line.1, done, total)
                {
                    stage.last_line = (Instant::now(), done);
                    eprintln!(
                        "{}",
                        line(name, done, total, facts, stage.started.elapsed())
                    );
                }
            }
        }
    }

    /// Hides the bar while something is printed.
    fn without_bar(&self, print: impl FnOnce()) {
        match self.stages().values().next() {
            Some(stage) => stage.bar.suspend(print),
            None => print(),
        }
    }

    fn finish(&self, stage: &'static str) {
        if let Some(stage) = self.stages().remove(stage) {
            stage.bar.finish_and_clear();
        }
    }
}

impl Sink for Console {
    fn on_message(&self, message: Message<'_>) {
        match message {
            Message::Started { stage, total } => self.start(stage, total),
            Message::Advanced {
                stage,
                done,
                total,
                note,
            } => self.advance(stage, done, total, note),
            Message::Trained { step, total, .. } => {
                let details = format!(
                    "loss {:.4}, {:.1} dB, {}k Gaussians",
                    step.loss,
                    step.psnr,
                    step.gaussians / 1000
                );
                self.advance(
                    "train",
                    u64::from(step.iteration),
                    u64::from(total),
                    &details,
                );
            }
            Message::Finished { stage } => self.finish(stage),
            Message::Note(text) if self.medium != Medium::Nothing => {
                self.without_bar(|| eprintln!("{text}"));
            }
            Message::Warning(text) => self.without_bar(|| tracing::warn!("{text}")),
            _ => {}
        }
    }
}

/// Returns whether another tenth of the stage is done since the last printed line. Always true if
/// the total is unknown (0).
fn is_tenth_more(last_done: u64, done: u64, total: u64) -> bool {
    total == 0 || 10 * (done - last_done.min(done)) >= total
}

/// Formats a progress line: "train 400/2,000, loss 0.0410, 22.1 it/s, 62 s left".
fn line(name: &str, done: u64, total: u64, facts: &str, elapsed: Duration) -> String {
    let seconds = elapsed.as_secs_f64().max(1e-9);
    let facts = if facts.is_empty() {
        String::new()
    } else {
        format!(", {facts}")
    };
    if total == 0 {
        return format!("{name}{facts}, {seconds:.0} s so far");
    }
    let rate = done as f64 / seconds;
    let rate_text = if rate >= 1.0 {
        format!("{rate:.1} it/s")
    } else {
        format!("{:.1} s each", 1.0 / rate.max(1e-9))
    };
    let left = total.saturating_sub(done) as f64 / rate.max(1e-9);
    format!(
        "{name} {}/{}{facts}, {rate_text}, {left:.0} s left",
        grouped(done),
        grouped(total)
    )
}

/// Formats a number with thousands separators.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_reports_steps_rate_and_remaining_time() {
        let training = line("train", 400, 2_000, "loss 0.0410", Duration::from_secs(20));
        assert_eq!(
            training,
            "train 400/2,000, loss 0.0410, 20.0 it/s, 80 s left"
        );
        assert_eq!(
            line("masks", 4, 44, "", Duration::from_secs(8)),
            "masks 4/44, 2.0 s each, 80 s left"
        );
        assert_eq!(
            line("poses", 0, 0, "matching: 12", Duration::from_secs(31)),
            "poses, matching: 12, 31 s so far"
        );
        assert_eq!(grouped(1_234_567), "1,234,567");
    }

    #[test]
    fn a_line_needs_another_tenth_of_the_stage() {
        assert!(
            !is_tenth_more(100, 299, 2_000)
                && is_tenth_more(100, 300, 2_000)
                && is_tenth_more(0, 0, 0)
        );
    }
}
