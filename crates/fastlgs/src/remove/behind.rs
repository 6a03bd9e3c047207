//! Decides which Gaussians remain when an object is removed.

use crate::{Result, Scene};
use fastlgs_core::{Camera, LabelMap};
use glam::Vec3;

/// Least number of views that show a remaining Gaussian outside of the hidden pixels.
const MIN_VIEWS: u8 = 2;
/// Least sum of blending weights of a Gaussian in such a view, in pixels.
const MIN_SEEN_WEIGHT: f32 = 0.5;

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
