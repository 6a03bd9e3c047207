//! Loads posed photos in any supported layout (COLMAP, transforms.json, LLFF) and prints their
//! cameras.
//!
//! `cargo run --release -p fastlgs-core --example read_dataset -- PHOTOS`

use fastlgs_core::{camera, dataset};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let photos = std::env::args()
        .nth(1)
        .ok_or("usage: read_dataset PHOTOS")?;
    let dataset = dataset::load(Path::new(&photos))?;
    let cameras: Vec<_> = dataset.photos.iter().map(|p| p.camera.clone()).collect();
    for camera in &cameras {
        let (eye, forward) = (camera.centre(), camera.forward());
        println!(
            "{}: {}x{} pixels, focal length {:.1}, at {eye:.2}, looking along {forward:.2}",
            camera.name, camera.width, camera.height, camera.fx
        );
    }
    println!(
        "{} photos, {} points, scene extent {:.2}",
        cameras.len(),
        dataset.points.len(),
        camera::scene_extent(&cameras)
    );
    Ok(())
}
