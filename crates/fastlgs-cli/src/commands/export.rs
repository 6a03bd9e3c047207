//! `fastlgs export`: writes a scene for other programs, for queries, or for a web server.

use crate::outcome::Outcome;
use crate::{report, ui, words};
use anyhow::{Result, bail};
use fastlgs::Run;
use fastlgs::export::{ExportConfig, names_folder};
use fastlgs::query::selection::EXTENSIONS;
use fastlgs_serve::share;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ExportConfig,
    /// Write a folder with the viewer page, for any web server. The page answers common words and
    /// taught names; it has no photos.
    #[arg(long)]
    html: bool,
    /// Number of common words that the page answers, with --html.
    #[arg(long, default_value_t = share::DEFAULT_WORDS, requires = "html")]
    words: usize,
    /// CLIP text tower, with --html; for scenes with imported embeddings, or if the file has moved.
    #[arg(long, value_name = "FILE", requires = "html")]
    clip_text: Option<std::path::PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    let config = &args.config;
    if !args.html {
        return report::write_summary(common, &fastlgs::export(config, run)?, words::export);
    }
    let ending = config
        .output
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default();
    if ending == "json"
        || EXTENSIONS.contains(&ending)
        || !(names_folder(&config.output) || ending.is_empty())
    {
        bail!(
            "{}: --html writes a folder; give a name without the ending .{ending}",
            config.output.display()
        );
    }
    let share = share::ShareConfig {
        scene: config.scene.clone(),
        output: config.output.clone(),
        sh_degree: config.sh_degree,
        words: args.words,
        clip_text: args.clip_text.clone(),
    };
    report::write_summary(common, &share::share(&share, run)?, words::share)
}
