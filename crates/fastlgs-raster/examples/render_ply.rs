//! Renders a 3DGS scene of any program to a PNG, on the first Vulkan device or, with `cpu`, without one.
//!
//! `cargo run --release -p fastlgs-raster --example render_ply -- scene.ply picture.png [DEVICE]`

use fastlgs_core::{Camera, image_io, ply};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, View, open_engine};
use glam::Vec3;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let (Some(scene), Some(picture)) = (args.next(), args.next()) else {
        return Err("usage: render_ply scene.ply picture.png [DEVICE]".into());
    };
    let gaussians = ply::read(Path::new(&scene))?;

    // From outside onto the middle of the scene; files of 3DGS have y pointing down.
    let centre = gaussians.means.iter().sum::<Vec3>() / gaussians.len().max(1) as f32;
    let mut distances: Vec<f32> = gaussians.means.iter().map(|m| m.distance(centre)).collect();
    distances.sort_by(f32::total_cmp);
    let radius = distances.get(distances.len() / 2).copied().unwrap_or(1.0);
    let eye = centre + Vec3::new(0.0, -0.5, -3.0) * radius;
    let camera = Camera::look_at("outside", eye, centre, Vec3::NEG_Y, 640, 480, 0.8);

    let mut engine = open_engine(&args.next().unwrap_or_else(|| "auto".into()))?;
    engine.set_state(&State::of(&gaussians))?;
    let frame = engine.render(View::new(&camera, gaussians.len(), gaussians.sh_degree), Channels::Color)?;
    image_io::save_png(Path::new(&picture), image_io::from_planar(frame.channels(0, 3), frame.width, frame.height))?;
    println!("{} Gaussians, {} pairs with tiles, on {}: {picture}", gaussians.len(), frame.pairs, engine.name());
    Ok(())
}
