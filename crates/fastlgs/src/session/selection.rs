//! The three-dimensional side of an answer: which Gaussians belong to it.

use crate::Result;
use crate::error::{Context, bail};
use fastlgs_core::camera::mean_up;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, WorldFrame, glb, ply, sog, spz};
use fastlgs_grid::Grid;
use glam::Vec3;
use std::path::Path;

/// Places of the Gaussians of some objects.
pub fn gaussians(scene: &Gaussians, grid: &Grid, objects: &[u16]) -> Vec<usize> {
    let members = grid.members(objects);
    let ids = scene.object_ids.iter().enumerate();
    ids.filter(|(_, id)| members.get(usize::from(**id)) == Some(&true)).map(|(i, _)| i).collect()
}

/// Writes the selection (`keep`), or the scene without it, in the format of the file's ending.
///
/// # Errors
/// An empty rest, an unknown ending, or the system's refusal.
pub fn export(path: &Path, scene: &Gaussians, world: &World, selected: &[usize], keep: bool) -> Result<()> {
    let mut inside = vec![false; scene.len()];
    selected.iter().for_each(|&i| inside[i] = true);
    let places: Vec<usize> = (0..inside.len()).filter(|&i| inside[i] == keep).collect();
    if places.is_empty() {
        bail!("{}: nothing would be left to write", path.display());
    }
    let selected = scene.select(&places);
    write(path, &selected, world).context("the selection cannot be written")
}

/// Files that Gaussians are written to, by their endings.
pub const ENDINGS: [&str; 4] = ["ply", "spz", "sog", "glb"];

/// How a scene stands in the world.
pub struct World {
    /// Its place and unit.
    pub frame: WorldFrame,
    /// Its upward direction, a unit vector.
    pub up: Vec3,
}

impl World {
    /// As the scene's manifest states it; up is that of the cameras.
    pub fn of(manifest: &Manifest, cameras: &[Camera]) -> Self {
        Self { frame: manifest.frame, up: mean_up(cameras) }
    }
}

/// Writes Gaussians, in the coordinates of the world, as the file's ending says ([`ENDINGS`]). Formats of few bits hold the scene's
/// own coordinates, and no Gaussians far outside, on which they would spend their range; the log says so.
///
/// # Errors
/// An unknown ending, or the system's refusal.
pub fn write(path: &Path, gaussians: &Gaussians, world: &World) -> Result<()> {
    let frame = &world.frame;
    match path.extension().and_then(|e| e.to_str()) {
        Some("ply") => ply::write_in(path, gaussians, frame)?,
        Some("spz") => spz::write(path, &of_few_bits(path, gaussians, frame))?,
        Some("sog") => sog::write(path, &of_few_bits(path, gaussians, frame))?,
        Some("glb") => glb::write(path, gaussians, world.up, frame)?,
        _ => bail!("{}: name it .ply, .spz, .sog or .glb", path.display()),
    }
    Ok(())
}

/// The scene as formats of few bits hold it: relative to the frame's origin, in the world's units, without far outliers.
fn of_few_bits(path: &Path, gaussians: &Gaussians, frame: &WorldFrame) -> Gaussians {
    let (written, dropped) = gaussians.without_far_outliers();
    let path = path.display();
    if dropped > 0 {
        tracing::warn!("{path}: {dropped} Gaussians far outside of the scene were left out, as the format's precision would suffer");
    }
    if !frame.is_identity() {
        let (origin, scale) = (frame.origin, frame.scale);
        tracing::warn!("{path}: the format cannot hold the world's coordinates; they are origin + scale x those in it: {origin}, {scale}");
    }
    written
}

/// World box [min, max] between the 2nd and 98th percentile of the Gaussians' centres: a few floaters do not stretch it.
pub fn robust_box(scene: &Gaussians, frame: &WorldFrame, own: &[usize]) -> Option<[[f64; 3]; 2]> {
    if own.is_empty() {
        return None;
    }
    let mut out = [[0.0; 3]; 2];
    for k in 0..3 {
        let mut values: Vec<f32> = own.iter().map(|&i| scene.means[i][k]).collect();
        values.sort_by(f32::total_cmp);
        out[0][k] = values[values.len() * 2 / 100];
        out[1][k] = values[(values.len() - 1) * 98 / 100];
    }
    Some(out.map(|corner| frame.reported(corner)))
}
