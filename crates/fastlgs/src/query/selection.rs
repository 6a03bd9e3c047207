//! Selects the Gaussians of an answer, and exports them.

use crate::error::{Context, bail};
use crate::{Error, Result};
use fastlgs_core::camera::mean_up;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, WorldFrame, glb, ply, sog, spz};
use fastlgs_grid::Grid;
use glam::Vec3;
use std::path::Path;

/// Returns the error for an object id that the scene in `root` does not have.
pub(crate) fn no_object(root: &Path, grid: &Grid, id: u16) -> Error {
    Error::NotFound(format!(
        "{}: its object ids are 1 to {}, and none is {id}; choose one of them",
        root.display(),
        grid.objects.len()
    ))
}

/// Returns the indices of all Gaussians that belong to at least one of `objects`.
pub fn gaussians(scene: &Gaussians, grid: &Grid, objects: &[u16]) -> Vec<usize> {
    let members = grid.members(objects);
    let ids = scene.object_ids.iter().enumerate();
    ids.filter(|(_, id)| members.get(usize::from(**id)) == Some(&true))
        .map(|(i, _)| i)
        .collect()
}

/// Returns the indices of the Gaussians of each object, in order of id. Those of an object include
/// those of its parts.
pub fn gaussians_by_object(scene: &Gaussians, grid: &Grid) -> Vec<Vec<usize>> {
    let mut own: Vec<Vec<usize>> = vec![Vec::new(); grid.objects.len()];
    for (i, id) in scene.object_ids.iter().enumerate() {
        for object in grid.chain(*id) {
            own[usize::from(object) - 1].push(i);
        }
    }
    own
}

/// Writes Gaussians in the format of the file extension: with `keep`, those with the indices
/// `selected`, else all others.
///
/// # Errors
/// No Gaussians are left, the extension is unknown, or the file cannot be written.
pub fn export(
    path: &Path,
    scene: &Gaussians,
    world: &World,
    selected: &[usize],
    keep: bool,
) -> Result<()> {
    let mut is_selected = vec![false; scene.len()];
    selected.iter().for_each(|&i| is_selected[i] = true);
    let indices: Vec<usize> = (0..is_selected.len())
        .filter(|&i| is_selected[i] == keep)
        .collect();
    if indices.is_empty() {
        bail!(
            "{}: no Gaussians are left to write; change the selection",
            path.display()
        );
    }
    let selected = scene.select(&indices);
    write(path, &selected, world).context("the selection cannot be written")
}

/// File extensions of the formats to which Gaussians can be written.
pub const EXTENSIONS: [&str; 4] = ["ply", "spz", "sog", "glb"];

/// World frame and upward direction of a scene.
pub struct World {
    /// Origin and unit.
    pub frame: WorldFrame,
    /// Upward direction in coordinates of the scene, a unit vector.
    pub up: Vec3,
}

impl World {
    /// Creates the world of a scene: the frame of its manifest, and the mean upward direction of
    /// its cameras.
    pub fn of(manifest: &Manifest, cameras: &[Camera]) -> Self {
        Self {
            frame: manifest.frame,
            up: mean_up(cameras),
        }
    }
}

/// Writes Gaussians in world coordinates, in the format of the file extension ([`EXTENSIONS`]). SPZ
/// and SOG have few bits for a coordinate, so they get scene coordinates without distant outliers.
/// Warnings report both.
///
/// # Errors
/// An unknown extension, or a file that cannot be written.
pub fn write(path: &Path, gaussians: &Gaussians, world: &World) -> Result<()> {
    let frame = &world.frame;
    match path.extension().and_then(|e| e.to_str()) {
        Some("ply") => ply::write_in(path, gaussians, frame)?,
        Some("spz") => spz::write(path, &for_low_precision(path, gaussians, frame))?,
        Some("sog") => sog::write(path, &for_low_precision(path, gaussians, frame))?,
        Some("glb") => glb::write(path, gaussians, world.up, frame)?,
        _ => bail!(
            "{}: the file extension is unknown; use .ply, .spz, .sog or .glb",
            path.display()
        ),
    }
    Ok(())
}

/// Removes distant outliers for a format with few bits. Warns about them, and about scene
/// coordinates that are not world coordinates.
fn for_low_precision(path: &Path, gaussians: &Gaussians, frame: &WorldFrame) -> Gaussians {
    let (written, dropped) = gaussians.without_far_outliers();
    let path = path.display();
    if dropped > 0 {
        tracing::warn!(
            "{path}: {dropped} Gaussians far outside the scene were left out, because they would reduce the precision of all others"
        );
    }
    if !frame.is_identity() {
        let (origin, scale) = (frame.origin, frame.scale);
        tracing::warn!(
            "{path}: this format cannot hold world coordinates; compute them as origin + scale x coordinate, with origin {origin} and scale {scale}"
        );
    }
    written
}

/// Returns the minimum and maximum corner of the Gaussians with these indices, in world
/// coordinates; `None` if there are none. Corners are the 2nd and 98th percentiles of the centres,
/// so that floaters do not enlarge the box.
pub fn robust_box(
    scene: &Gaussians,
    frame: &WorldFrame,
    indices: &[usize],
) -> Option<[[f64; 3]; 2]> {
    if indices.is_empty() {
        return None;
    }
    let mut out = [[0.0; 3]; 2];
    for k in 0..3 {
        let mut values: Vec<f32> = indices.iter().map(|&i| scene.means[i][k]).collect();
        values.sort_by(f32::total_cmp);
        out[0][k] = values[values.len() * 2 / 100];
        out[1][k] = values[(values.len() - 1) * 98 / 100];
    }
    Some(out.map(|corner| frame.to_world_decimal(corner)))
}
