//! The three-dimensional side of an answer: which Gaussians belong to it.

use crate::Result;
use crate::error::{Context, bail};
use fastlgs_core::camera::mean_up;
use fastlgs_core::{Camera, Gaussians, glb, ply, sog, spz};
use fastlgs_grid::Grid;
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
pub fn export(path: &Path, scene: &Gaussians, cameras: &[Camera], selected: &[usize], keep: bool) -> Result<()> {
    let mut inside = vec![false; scene.len()];
    selected.iter().for_each(|&i| inside[i] = true);
    let places: Vec<usize> = (0..inside.len()).filter(|&i| inside[i] == keep).collect();
    if places.is_empty() {
        bail!("{}: nothing would be left to write", path.display());
    }
    let selected = scene.select(&places);
    write(path, &selected, cameras).context("the selection cannot be written")
}

/// Files that Gaussians are written to, by their endings.
pub const ENDINGS: [&str; 4] = ["ply", "spz", "sog", "glb"];

/// Writes Gaussians as the file's ending says ([`ENDINGS`]); up in `.glb` is that of the cameras.
///
/// # Errors
/// An unknown ending, or the system's refusal.
pub fn write(path: &Path, gaussians: &Gaussians, cameras: &[Camera]) -> Result<()> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("ply") => ply::write(path, gaussians)?,
        Some("spz") => spz::write(path, gaussians)?,
        Some("sog") => sog::write(path, gaussians)?,
        Some("glb") => glb::write(path, gaussians, mean_up(cameras))?,
        _ => bail!("{}: name it .ply, .spz, .sog or .glb", path.display()),
    }
    Ok(())
}

/// World box [min, max] between the 2nd and 98th percentile of the Gaussians' centres: a few floaters do not stretch it.
pub fn robust_box(scene: &Gaussians, own: &[usize]) -> Option<[[f32; 3]; 2]> {
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
    Some(out)
}
