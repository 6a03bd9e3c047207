//! Which Gaussians photos saw past the thing.

use crate::{Result, Session};
use fastlgs_core::{Camera, LabelMap};
use fastlgs_raster::lift;
use glam::Vec3;

/// Views that must have seen a Gaussian.
const WITNESSES: u8 = 2;
/// Pixels that it must have coloured in each, as its blending weights add up.
const SHARE: f32 = 0.5;

/// For each Gaussian whether two views show it outside the pixels that the thing may have coloured (`hidden`), or none shows or has it within
/// them. The others are the thing's own, or lie in or under it, where training put whatever did no harm.
pub fn seen(session: &Session, views: &[(Camera, Vec<bool>)]) -> Result<Vec<bool>> {
    let mut witnesses = vec![0u8; session.gaussians.len()];
    let mut within = vec![false; session.gaussians.len()];
    for (camera, hidden) in views {
        let labels = hidden.iter().map(|hidden| u16::from(!hidden)).collect();
        let map = LabelMap { width: camera.width, height: camera.height, labels };
        for vote in lift::votes(&session.gaussians, &session.view(camera), &map) {
            within[vote.gaussian as usize] |= vote.label == 0;
            if vote.label == 1 && vote.weight >= SHARE {
                let count = &mut witnesses[vote.gaussian as usize];
                *count = count.saturating_add(1);
            }
        }
    }
    let is_within = |mean: Vec3| views.iter().any(|(camera, hidden)| camera.see(mean).is_some_and(|(pixel, _)| hidden[pixel]));
    let stays = |((count, within), mean): ((u8, bool), &Vec3)| count >= WITNESSES || !(within || is_within(*mean));
    Ok(witnesses.into_iter().zip(within).zip(&session.gaussians.means).map(stays).collect())
}
