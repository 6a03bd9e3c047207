//! Renders a 3DGS scene, written by any program, to a PNG.
//!
//! `cargo run --release -p fastlgs-raster --example render_ply -- scene.ply picture.png [DEVICE]`
//!
//! DEVICE is `auto` (the default: a hardware adapter, else the CPU), `cpu`, or an adapter by name
//! or index.

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

    // The camera looks from outside at the centre of the scene. In 3DGS files, y points down.
    let centre = gaussians.means.iter().sum::<Vec3>() / gaussians.len().max(1) as f32;
    let mut distances: Vec<f32> = gaussians.means.iter().map(|m| m.distance(centre)).collect();
    distances.sort_by(f32::total_cmp);
    let radius = distances.get(distances.len() / 2).copied().unwrap_or(1.0);
    let eye = centre + Vec3::new(0.0, -0.5, -3.0) * radius;
    let camera = Camera::look_at("outside", eye, centre, Vec3::NEG_Y, 640, 480, 0.8);

    let mut engine = open_engine(&args.next().unwrap_or_else(|| "auto".into()))?;
    engine.set_state(&State::of(&gaussians))?;
    let frame = engine.render(
        View::new(&camera, gaussians.len(), gaussians.sh_degree),
        Channels::Color,
    )?;
    image_io::save_png(
        Path::new(&picture),
        image_io::from_planar(frame.color(), frame.width, frame.height),
    )?;
    println!(
        "{} Gaussians and {} (tile, Gaussian) pairs, rendered on {}: {picture}",
        gaussians.len(),
        frame.pairs,
        engine.name()
    );
    Ok(())
}
