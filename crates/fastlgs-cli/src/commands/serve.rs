//! `fastlgs serve`: shows a scene in the browser and answers queries.

use super::bind::{DEFAULT_BIND, parse_bind};
use crate::outcome::Outcome;
use crate::ui::print_line;
use crate::{report, ui};
use anyhow::{Result, bail};
use fastlgs_core::SceneFolder;
use fastlgs_serve::Server;
use std::io::Write;
use std::net::SocketAddr;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs serve scenes/fox\n\nStop the server with Ctrl-C. If other machines can reach the address, requests need the printed token."
)]
pub struct Args {
    /// Trained scene folder.
    scene: PathBuf,
    /// Address to listen on: IP, PORT or IP:PORT; port 0 selects a free one.
    #[arg(long, default_value = DEFAULT_BIND, value_parser = parse_bind)]
    bind: SocketAddr,
    /// Host name of a proxy on this machine that forwards requests with its own name, such as
    /// nginx; may be repeated.
    #[arg(long, value_name = "NAME")]
    host_name: Vec<String>,
    /// CLIP text tower, for scenes with imported embeddings, or if the file has moved.
    #[arg(long, value_name = "FILE")]
    clip_text: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let folder = SceneFolder::open(&args.scene)?;
    let scene = folder.gaussians()?;
    if scene.is_empty() {
        bail!(
            "{}: the scene has no Gaussians; train it again",
            args.scene.display()
        );
    }
    let server = Server::start(&folder, args.bind, None, &args.host_name)?;
    server.set_focus(&scene.means);
    drop(scene);
    server.open_scene(&common.device, args.clip_text.clone())?;
    announce(&server, common)?;
    server.wait()?;
    Ok(Outcome::Done)
}

/// Prints the address of the page and flushes it, so that the program that started the server can
/// read it.
fn announce(server: &Server, common: &ui::Common) -> Result<()> {
    if common.json.is_some() {
        report::write_fields(common, &serde_json::json!({ "url": server.url }))?;
    } else {
        print_line!("open {} in a browser", server.url);
    }
    Ok(std::io::stdout().flush()?)
}
