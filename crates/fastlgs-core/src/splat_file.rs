//! Reads files of Gaussians in all supported formats: PLY (also SuperSplat's compressed one), SPZ,
//! SOG, glTF and .splat.

use crate::{Error, Gaussians, Result, WorldFrame, fs, glb, ply, sog, splat, spz};
use glam::DVec3;
use std::path::Path;

/// File extensions of the supported formats.
pub const EXTENSIONS: [&str; 5] = ["ply", "spz", "sog", "glb", "splat"];

/// Reads a file according to its extension and converts it from world coordinates to `frame`. Also
/// returns a warning if Gaussians that cannot be drawn were dropped.
///
/// # Errors
/// An unknown extension, a file without Gaussians, and the errors of the formats.
pub fn read(path: &Path, frame: &WorldFrame) -> Result<(Gaussians, Option<String>)> {
    let ending = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default()
        .to_ascii_lowercase();
    let (scene, warning) = match ending.as_str() {
        "ply" => ply::parse_in(path, &fs::read(path)?, frame)?,
        "spz" => in_frame(path, spz::read(path)?, frame),
        "sog" => in_frame(path, sog::read(path)?, frame),
        "glb" => in_frame(path, glb::read(path)?, frame),
        "splat" => in_frame(path, splat::read(path)?, frame),
        _ => {
            let known = EXTENSIONS.map(|ending| format!(".{ending}")).join(", ");
            return Err(Error::format(
                path,
                format!("its extension is not supported; supported are {known}"),
            ));
        }
    };
    if scene.is_empty() {
        return Err(Error::format(
            path,
            "it has no Gaussians; give the file of a trained scene",
        ));
    }
    Ok((scene, warning))
}

/// Converts a scene to `frame` if it is in world coordinates. Quantised formats and glTF are in
/// scene coordinates if FastLGS wrote them, but other programs may write world coordinates. The
/// scene counts as in world coordinates if its mean is nearer to the frame's origin than half the
/// origin's distance from zero.
fn in_frame(path: &Path, mut scene: Gaussians, frame: &WorldFrame) -> (Gaussians, Option<String>) {
    let warning = scene
        .drop_invalid()
        .map(|dropped| format!("{}: {dropped}", path.display()));
    let mean = scene
        .means
        .iter()
        .map(|mean| mean.as_dvec3())
        .sum::<DVec3>()
        / scene.len().max(1) as f64;
    if frame.origin != DVec3::ZERO && mean.distance(frame.origin) < 0.5 * frame.origin.length() {
        let shift = frame.scale.ln() as f32;
        scene
            .means
            .iter_mut()
            .for_each(|mean| *mean = frame.to_local(mean.as_dvec3()));
        scene
            .log_scales
            .iter_mut()
            .for_each(|scale| *scale -= shift);
    }
    (scene, warning)
}
