//! `fastlgs serve`: a page in the browser where a scene is looked at and asked.

use super::bind::{DEFAULT_BIND, parse_bind};
use crate::outcome::Outcome;
use crate::ui::say;
use crate::{report, ui};
use anyhow::{Result, bail};
use fastlgs_core::SceneFolder;
use fastlgs_serve::Server;
use std::io::Write;
use std::net::SocketAddr;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs serve scenes/fox\n\nStop it with Ctrl-C. Addresses that other machines can reach need the token that is printed."
)]
pub struct Args {
    /// Trained scene folder.
    scene: PathBuf,
    /// Address to listen on: IP, PORT or IP:PORT; port 0 takes a free one.
    #[arg(long, default_value = DEFAULT_BIND, value_parser = parse_bind)]
    bind: SocketAddr,
    /// The name of a proxy on this machine that passes requests on with its own name as host, as nginx can; may be repeated.
    #[arg(long, value_name = "NAME")]
    host_name: Vec<String>,
    /// CLIP's text tower, for scenes whose embeddings were imported, or when the file has moved.
    #[arg(long, value_name = "FILE")]
    clip_text: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let folder = SceneFolder::open(&args.scene)?;
    let scene = folder.gaussians()?;
    if scene.is_empty() {
        bail!("{}: the scene has no Gaussians; train it again", args.scene.display());
    }
    let server = Server::start(&folder, args.bind, None, &args.host_name)?;
    server.set_focus(&scene.means);
    drop(scene);
    server.open_scene(&common.device, args.clip_text.clone())?;
    announce(&server, common)?;
    server.wait()?;
    Ok(Outcome::Done)
}

/// Tells where the page is, at once: who starts the server reads this line.
fn announce(server: &Server, common: &ui::Common) -> Result<()> {
    if common.json.is_some() {
        report::give(common, &serde_json::json!({ "url": server.url }))?;
    } else {
        say!("open {} in a browser", server.url);
    }
    Ok(std::io::stdout().flush()?)
}
