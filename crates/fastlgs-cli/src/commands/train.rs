//! `fastlgs train`: trains a scene and can show the training in the browser.

use super::bind::{DEFAULT_BIND, parse_bind};
use crate::console::Console;
use crate::outcome::Outcome;
use crate::{report, ui, words};
use anyhow::Result;
use fastlgs::progress::{Message, Sink};
use fastlgs::train;
use fastlgs_core::SceneFolder;
use fastlgs_serve::{Live, Server};
use std::net::SocketAddr;
use std::sync::Arc;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs train scenes/fox --preset quick")]
pub struct Args {
    #[command(flatten)]
    config: train::TrainConfig,
    /// Show the training in the browser. After training, the page answers queries until Ctrl-C.
    #[arg(long, value_name = "IP:PORT", num_args = 0..=1, require_equals = true, default_missing_value = DEFAULT_BIND, value_parser = parse_bind)]
    serve: Option<SocketAddr>,
}

/// Forwards progress to the terminal and to the page.
struct ConsoleAndPage<'a>(&'a Console, &'a Server);

impl Sink for ConsoleAndPage<'_> {
    fn on_message(&self, message: Message<'_>) {
        self.0.on_message(message);
        self.1.on_message(message);
    }

    fn cancelled(&self) -> bool {
        self.0.cancelled() || self.1.cancelled()
    }
}

pub fn run(args: &Args, common: &ui::Common, console: &Console) -> Result<Outcome> {
    let Some(bind) = args.serve else {
        return report::write_summary(
            common,
            &train::train(&args.config, &common.run(console))?,
            words::train,
        );
    };
    let config = &args.config;
    let live = Live::new(
        config.iterations(),
        config.antialias,
        config.background.unwrap_or_default().color,
    );
    let server = Server::start(
        &SceneFolder::open(&config.scene)?,
        bind,
        Some(Arc::new(live)),
        &[],
    )?;
    // Standard output is reserved for the report.
    eprintln!("watch the training at {}", server.url);
    let report = train::train(config, &common.run(&ConsoleAndPage(console, &server)))?;
    report::write_summary(common, &report, words::train)?;
    server.open_scene(&common.device, None)?;
    server.wait()?;
    Ok(Outcome::Done)
}
