//! Decides which Gaussians remain when an object is removed.

use super::membrane::Membrane;
use crate::{Result, Scene, transparent};
use fastlgs_core::{Camera, LabelMap};
use glam::Vec3;

/// Least number of views that show a remaining Gaussian outside of the hidden pixels.
const MIN_VIEWS: u8 = 2;
/// Least sum of blending weights of a Gaussian in such a view, in pixels.
const MIN_SEEN_WEIGHT: f32 = 0.5;
/// Relative depth difference from which a Gaussian stands before or behind a surface.
const DEPTH_MARGIN: f32 = 0.03;
/// Share of the nearest and farthest Gaussians of an object that may be outliers.
const OUTLIERS: f32 = 0.05;
/// Depth behind an object that may still belong to it, relative to the object's own depth.
const DEPTH_BEYOND: f32 = 0.5;

/// Returns the Gaussians that stand where the object is, although they belong to none or to another
/// one: fur at its border, and parts that few photos show. `views` holds the hidden pixels of each
/// training view, `object` the indices of the object's Gaussians.
///
/// Most views that see the place of such a Gaussian have it within the hidden pixels, not far behind
/// the object, and before the surface that continues the depth around the hidden pixels.
pub fn protruding_gaussians(
    scene: &mut Scene,
    object: &[usize],
    views: &[(Camera, Vec<bool>)],
) -> Result<Vec<usize>> {
    // Views that see the place of a Gaussian, and those that have it at the object's place.
    let mut counts = vec![[0u32; 2]; scene.gaussians().len()];
    for (camera, hidden) in views {
        let depth = scene.render_depth(camera)?;
        let behind = inverse_depth_behind(&depth, hidden, camera.width as usize);
        let means = &scene.gaussians().means;
        let far = far_side(camera, object.iter().map(|i| means[*i]));
        for (mean, [seen, at_object]) in means.iter().zip(&mut counts) {
            let Some((pixel, z)) = camera.pixel_and_depth(*mean) else {
                continue;
            };
            let stands_before = z * behind[pixel] < 1.0 - DEPTH_MARGIN;
            *seen += 1;
            *at_object += u32::from(hidden[pixel] && stands_before && z <= far);
        }
    }
    let scene = scene.gaussians();
    let protrudes = |i: &usize| {
        let [seen, at_object] = counts[*i];
        2 * at_object > seen && !transparent::is_transparent(scene, *i)
    };
    Ok((0..counts.len()).filter(protrudes).collect())
}

/// Returns the largest depth at which Gaussians may belong to an object.
fn far_side(camera: &Camera, object: impl Iterator<Item = Vec3>) -> f32 {
    let depth = |mean: Vec3| camera.world_to_camera.transform_point3(mean).z;
    let mut depths: Vec<f32> = object.map(depth).collect();
    depths.sort_by(f32::total_cmp);
    let at = |share: f32| {
        let last = depths.len().saturating_sub(1) as f32;
        depths.get((share * last) as usize).copied()
    };
    match (at(OUTLIERS), at(1.0 - OUTLIERS)) {
        (Some(near), Some(far)) => far + DEPTH_BEYOND * (far - near),
        _ => f32::INFINITY,
    }
}

/// Returns the inverse depth of a view, continued into the hidden pixels from the pixels around
/// them; 0 where nothing is rendered.
pub fn inverse_depth_behind(depth: &[f32], hidden: &[bool], width: usize) -> Vec<f32> {
    let inverse = |depth: &f32| if depth.is_finite() { 1.0 / depth } else { 0.0 };
    let mut inverse: Vec<f32> = depth.iter().map(inverse).collect();
    Membrane::fill_planes(&mut inverse, hidden, width);
    inverse
}

/// Returns for each Gaussian whether it remains. `views` holds the hidden pixels of each view:
/// those that the object may have coloured.
///
/// A Gaussian remains if at least two views show it outside of the hidden pixels. It also remains
/// if neither it nor its centre is within the hidden pixels of any view. All others belong to the
/// object, or lie inside or below it, where photos do not constrain training.
pub fn remaining_gaussians(scene: &mut Scene, views: &[(Camera, Vec<bool>)]) -> Result<Vec<bool>> {
    let mut view_counts = vec![0u8; scene.gaussians().len()];
    let mut within = vec![false; scene.gaussians().len()];
    for (camera, hidden) in views {
        let labels = hidden.iter().map(|hidden| u16::from(!hidden)).collect();
        let map = LabelMap {
            width: camera.width,
            height: camera.height,
            labels,
        };
        let view = scene.view(camera);
        for vote in scene.engine().votes(view, &map)? {
            within[vote.gaussian as usize] |= vote.label == 0;
            if vote.label == 1 && vote.weight >= MIN_SEEN_WEIGHT {
                let count = &mut view_counts[vote.gaussian as usize];
                *count = count.saturating_add(1);
            }
        }
    }
    let is_within = |mean: Vec3| {
        views.iter().any(|(camera, hidden)| {
            camera
                .pixel_and_depth(mean)
                .is_some_and(|(pixel, _)| hidden[pixel])
        })
    };
    let stays = |((count, within), mean): ((u8, bool), &Vec3)| {
        count >= MIN_VIEWS || !(within || is_within(*mean))
    };
    Ok(view_counts
        .into_iter()
        .zip(within)
        .zip(&scene.gaussians().means)
        .map(stays)
        .collect())
}
