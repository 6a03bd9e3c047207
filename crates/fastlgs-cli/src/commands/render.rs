//! `fastlgs render`: pictures of a trained scene.

use crate::scene::{Scene, ViewChoice};
use crate::{Outcome, report, ui};
use anyhow::{Result, bail};
use fastlgs_core::{exr_image, image_io, turbo};
use image::{Rgb, RgbImage};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs render scenes/fox --view 0027.jpg --what color,depth,feature,objects -o pictures")]
pub struct Args {
    /// Trained scene folder.
    scene: PathBuf,
    #[command(flatten)]
    views: ViewChoice,
    /// What to write: color (PNG), depth (EXR), feature (EXR), objects (PNG), separated by commas.
    #[arg(long, default_value = "color", value_delimiter = ',')]
    what: Vec<String>,
    /// Folder to write to.
    #[arg(short, long)]
    output: PathBuf,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    if let Some(unknown) = args.what.iter().find(|w| !["color", "depth", "feature", "objects"].contains(&w.as_str())) {
        bail!("--what {unknown}: unknown; there are color, depth, feature and objects");
    }
    let mut scene = Scene::open(&args.scene, &common.device)?;
    let cameras = args.views.cameras(&scene)?;
    let wants = |what: &str| args.what.iter().any(|w| w == what);
    let mut files = Vec::new();
    let mut milliseconds = Vec::new();
    for camera in &cameras {
        let started = Instant::now();
        let frame = scene.render(camera)?;
        milliseconds.push(started.elapsed().as_secs_f64() * 1e3);
        let (w, h) = (frame.width as usize, frame.height as usize);
        let path = |what: &str, ending: &str| args.output.join(format!("{}.{what}.{ending}", camera.name));
        if wants("color") {
            image_io::save_png(&path("color", "png"), image_io::from_planar(frame.channels(0, 3), frame.width, frame.height))?;
            files.push(path("color", "png"));
        }
        if wants("feature") {
            let channels = [("feature.0", frame.channels(3, 4)), ("feature.1", frame.channels(4, 5)), ("feature.2", frame.channels(5, 6))];
            exr_image::write(&path("feature", "exr"), w, h, &channels)?;
            files.push(path("feature", "exr"));
        }
        if wants("depth") {
            let depth = scene.render_depth(camera)?;
            exr_image::write(&path("depth", "exr"), w, h, &[("Z", &depth)])?;
            files.push(path("depth", "exr"));
        }
        if wants("objects") {
            let ids = scene.field(camera, None)?.owners(&scene.grid()?);
            let picture = RgbImage::from_fn(frame.width, frame.height, |x, y| Rgb(turbo::id_color(ids.at(x, y))));
            image_io::save_png(&path("objects", "png"), picture)?;
            files.push(path("objects", "png"));
        }
    }
    let value = serde_json::json!({
        "scene": args.scene,
        "files": files,
        "size": format!("{}x{}", cameras[0].width, cameras[0].height),
        "gaussians": scene.gaussians.len(),
        "render_ms": milliseconds,
        "adapter": scene.engine.name(),
    });
    report::give(common, &value)?;
    Ok(Outcome::Done)
}
