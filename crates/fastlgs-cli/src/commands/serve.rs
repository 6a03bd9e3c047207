//! `fastlgs serve`: a page in the browser where a scene is looked at and asked.

use crate::serve::Server;
use crate::{Outcome, ui};
use anyhow::{Result, bail};
use fastlgs_core::SceneFolder;
use std::io::Write;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

/// Where the page is unless `--bind` says otherwise.
pub const DEFAULT_BIND: &str = "127.0.0.1:8742";

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
    let server = Server::start(&folder, args.bind, None)?;
    server.set_focus(&scene.means);
    drop(scene);
    server.open_scene(&common.device, args.clip_text.clone())?;
    announce(&server, common)?;
    server.wait()?;
    Ok(Outcome::Done)
}

/// Tells where the page is, at once: who starts the server reads this line.
pub fn announce(server: &Server, common: &ui::Common) -> Result<()> {
    if common.json.is_some() {
        crate::report::give(common, &serde_json::json!({ "url": server.url }))?;
    } else {
        println!("open {} in a browser", server.url);
    }
    Ok(std::io::stdout().flush()?)
}

/// Parses `0.0.0.0:8000`, `::1`, or `8000`.
pub fn parse_bind(text: &str) -> Result<SocketAddr, String> {
    let own: SocketAddr = DEFAULT_BIND.parse().expect("a fixed address");
    let by_port = || text.parse::<u16>().ok().map(|port| SocketAddr::new(own.ip(), port));
    let by_ip = || text.parse::<IpAddr>().ok().map(|ip| SocketAddr::new(ip, own.port()));
    text.parse().ok().or_else(by_port).or_else(by_ip).ok_or_else(|| format!("'{text}' is not an address like 127.0.0.1:8742"))
}
