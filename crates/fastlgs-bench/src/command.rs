//! Runs commands of `fastlgs` in this process, with the arguments that a user would type. Each
//! figure can thus be reproduced by hand.

use crate::baseline;
use anyhow::{Context, Result, bail};
use clap::Parser;
use fastlgs::progress::{Message, Sink};
use fastlgs::{Run, eval, export, preprocess, synth, train};
use serde_json::Value;

/// The commands of `fastlgs` that benches run.
#[derive(Parser)]
#[command(name = "fastlgs", no_binary_name = true)]
enum Command {
    Synth(synth::SynthConfig),
    Preprocess(preprocess::PreprocessConfig),
    Train(train::TrainConfig),
    Eval(eval::EvalConfig),
    Export(export::ExportConfig),
    #[command(subcommand)]
    Bench(Bench),
}

#[derive(clap::Subcommand)]
enum Bench {
    Baseline(baseline::Args),
}

/// A muted progress sink, so that the bars of a trial do not hide those of the bench. It passes on
/// cancellation only.
struct MutedSink<'a>(&'a dyn Sink);

impl Sink for MutedSink<'_> {
    fn on_message(&self, message: Message<'_>) {
        if let Message::Warning(text) = message {
            tracing::debug!("{text}");
        }
    }

    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}

/// Runs `fastlgs COMMAND ARGS` on the device of `run` with `seed`, and returns the report.
pub fn run_command(run: &Run, seed: u64, command: &str, args: &[&str]) -> Result<Value> {
    let words = std::iter::once(&command).chain(args);
    let Ok(parsed) = Command::try_parse_from(words) else {
        bail!(
            "fastlgs {command} {}: this command is unknown or its arguments are wrong",
            args.join(" ")
        )
    };
    let quiet = MutedSink(run.progress);
    let run = &Run {
        seed,
        progress: &quiet,
        ..*run
    };
    let report = match parsed {
        Command::Synth(config) => to_value(fastlgs::synth(&config, run)),
        Command::Preprocess(config) => to_value(fastlgs::preprocess(&config, run)),
        Command::Train(config) => to_value(fastlgs::train(&config, run)),
        Command::Eval(config) => to_value(fastlgs::eval(&config, run)),
        Command::Export(config) => to_value(fastlgs::export(&config, run)),
        Command::Bench(Bench::Baseline(args)) => baseline::run(&args, run),
    };
    report.with_context(|| format!("fastlgs {command} {}", args.join(" ")))
}

fn to_value(report: fastlgs::Result<impl serde::Serialize>) -> Result<Value> {
    Ok(serde_json::to_value(report?)?)
}
