//! Which Gaussians photos saw past the thing.

use crate::{Result, Session};
use fastlgs_core::{Camera, LabelMap};
use fastlgs_raster::lift;

/// Views that must have seen a Gaussian.
const WITNESSES: u8 = 2;
/// Pixels that it must have coloured in each, as its blending weights add up.
const SHARE: f32 = 0.5;

/// For each Gaussian whether two views show it outside the pixels that the thing may have coloured (`hidden`). The others are the thing's own,
/// or lie in or under it, where training put whatever did no harm.
pub fn seen(session: &Session, views: &[(Camera, Vec<bool>)]) -> Result<Vec<bool>> {
    let mut witnesses = vec![0u8; session.gaussians.len()];
    for (camera, hidden) in views {
        let labels = hidden.iter().map(|hidden| u16::from(!hidden)).collect();
        let map = LabelMap { width: camera.width, height: camera.height, labels };
        for vote in lift::votes(&session.gaussians, &session.view(camera), &map) {
            if vote.label == 1 && vote.weight >= SHARE {
                let count = &mut witnesses[vote.gaussian as usize];
                *count = count.saturating_add(1);
            }
        }
    }
    Ok(witnesses.into_iter().map(|count| count >= WITNESSES).collect())
}
