//! Key points of overlapping photos are matched; pairs of them tell which masks show the same.

use super::photos::Known;
use crate::cache::{self, Cache};
use crate::{Error, Result, Run, masks};
use fastlgs_core::{Camera, SceneFolder};
use fastlgs_grid::mapping::{Correspondences, Mask};
use fastlgs_vision::keypoints::{self, Keypoints};
use fastlgs_vision::matching;
use fastlgs_vision::triangulate::{self, PairMatches};
use glam::Vec2;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Matches each photo with its neighbours.
pub(super) fn match_photos(
    training: &[Known],
    cameras: &[Camera],
    neighbours: usize,
    cache: &Cache,
    run: &Run,
) -> Result<Vec<PairMatches>> {
    let described = cameras.iter().map(serde_json::to_vec).collect::<Result<Vec<_>, _>>()?;
    let chosen = triangulate::overlapping_pairs(cameras, neighbours);
    let work = run.work("matches", chosen.len() as u64);
    let match_pair = |(a, b): (usize, usize)| {
        let inputs = [&training[a].key, &training[b].key, described[a].as_slice(), &described[b], keypoints::backend().as_bytes()];
        let pairs = cache.get("matches", &cache::key(&inputs), || {
            let [pa, pb] = [a, b].map(|k| &training[k].points);
            let pairs = matching::matches(pa, pb);
            Ok(triangulate::epipolar_filter((&cameras[a], pa), (&cameras[b], pb), &pairs))
        })?;
        work.advance()?;
        Ok::<_, Error>(PairMatches { a, b, pairs })
    };
    chosen.into_par_iter().map(match_pair).collect()
}

/// Counts the key-point pairs between the masks of matched photos.
pub(super) fn correspondences(
    masks: &[Mask],
    folder: &SceneFolder,
    cameras: &[Camera],
    points: &[Keypoints],
    matches: &[PairMatches],
) -> Result<Correspondences> {
    let index: BTreeMap<(usize, u16), usize> = masks.iter().enumerate().map(|(i, m)| ((m.view, m.label), i)).collect();
    let of_view = |(view, camera): (usize, &Camera)| -> Result<Vec<Option<usize>>> {
        let map = masks::whole(folder, camera)?;
        let label = |p: &Vec2| map.at((p.x as u32).min(map.width - 1), (p.y as u32).min(map.height - 1));
        Ok(points[view].positions.iter().map(|p| index.get(&(view, label(p))).copied()).collect())
    };
    let mask_at: Vec<Vec<Option<usize>>> = cameras.iter().enumerate().map(of_view).collect::<Result<_>>()?;
    let mut out = Correspondences::new();
    for m in matches {
        for &(i, j) in &m.pairs {
            if let (Some(a), Some(b)) = (mask_at[m.a][i], mask_at[m.b][j]) {
                *out.entry((b, a)).or_default() += 1;
            }
        }
    }
    Ok(out)
}
