//! From a text to objects and from objects to a mask (paper, querying features).

use crate::codes;
use crate::grid::{Grid, Object};
use crate::relevancy::TextQuery;
use glam::Vec3;
use serde::Serialize;

/// How objects are chosen.
#[derive(Clone, Copy, Debug)]
pub struct QueryConfig {
    /// Score from which an object counts as found.
    pub min_score: f32,
    /// At most this many objects.
    pub top_k: usize,
    /// Further objects must score within this of the best.
    pub margin: f32,
}

/// Calibrated on the offline encoder: see `docs/evaluation.md`.
pub const MIN_SCORE: f32 = 0.9;

/// The same for CLIP, whose cosines lie closer together: nearer to the text than to anything. Not calibrated.
pub const CLIP_MIN_SCORE: f32 = 0.55;

/// Share of an object's area, over its views, that decides its score.
pub const BEST_SHARE: f32 = 0.3;

impl Default for QueryConfig {
    fn default() -> Self {
        Self { min_score: MIN_SCORE, top_k: 8, margin: 0.02 }
    }
}

/// An object with its score.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Hit {
    /// Object id.
    pub id: u16,
    /// Relevancy, 0 to 1.
    pub score: f32,
}

/// Score of an object: area-weighted mean relevancy of its best views, which together show [`BEST_SHARE`] of all the area
/// it has in its views. An object is seldom recognised from everywhere; a single view that fools the encoder counts little.
pub fn object_score(object: &Object, query: &TextQuery) -> f32 {
    let mut scores: Vec<(f32, f32)> = object.embeddings.iter().map(|e| query.relevancy(e)).zip(object.areas.iter().copied()).collect();
    scores.sort_by(|a, b| b.0.total_cmp(&a.0));
    let total: f32 = object.areas.iter().sum();
    let (mut sum, mut weight) = (0.0, 0.0);
    for (score, area) in scores {
        sum += score * area;
        weight += area;
        if weight >= BEST_SHARE * total {
            break;
        }
    }
    if weight > 0.0 { sum / weight } else { 0.0 }
}

/// All objects, best first.
pub fn rank(grid: &Grid, query: &TextQuery) -> Vec<Hit> {
    let mut hits: Vec<Hit> = grid.objects.iter().map(|o| Hit { id: o.id, score: object_score(o, query) }).collect();
    hits.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.id.cmp(&b.id)));
    hits
}

/// The target objects; empty means "not found".
pub fn select(ranked: &[Hit], config: &QueryConfig) -> Vec<Hit> {
    let Some(best) = ranked.first() else { return Vec::new() };
    let floor = config.min_score.max(best.score - config.margin);
    ranked.iter().take(config.top_k).filter(|h| h.score >= floor).copied().collect()
}

/// How a rendered feature becomes an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decision {
    /// The paper's: the feature lies within this distance (0..255 scale) of the code.
    Within(f32),
    /// The nearest code, or none where "no object" (the zero code) is nearer: the strongest share of the blend wins.
    Nearest,
}

/// Object of each pixel from rendered features `[3][h][w]`; 0 for none.
pub fn restore_objects(grid: &Grid, features: &[f32], decision: Decision) -> Vec<u16> {
    let n = features.len() / 3;
    let decide = |feature: Vec3| {
        let limit = match decision {
            Decision::Within(tau_ac) => tau_ac,
            Decision::Nearest => codes::SCALE * feature.length(),
        };
        grid.nearest(feature).filter(|(_, d)| *d < limit).map_or(0, |(id, _)| id)
    };
    (0..n).map(|p| decide(Vec3::new(features[p], features[n + p], features[2 * n + p]))).collect()
}

/// The target mask: pixels that belong to one of the targets.
///
/// With [`Decision::Within`] each target's code is compared on its own, as in the paper.
pub fn mask(grid: &Grid, targets: &[Hit], features: &[f32], decision: Decision) -> Vec<bool> {
    let Decision::Within(tau_ac) = decision else {
        return restore_objects(grid, features, decision).iter().map(|id| targets.iter().any(|t| t.id == *id)).collect();
    };
    let n = features.len() / 3;
    let codes: Vec<Vec3> = grid.objects.iter().filter(|o| targets.iter().any(|t| t.id == o.id)).map(|o| o.code).collect();
    (0..n)
        .map(|p| {
            let feature = Vec3::new(features[p], features[n + p], features[2 * n + p]);
            codes.iter().any(|c| codes::distance(feature, *c) < tau_ac)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        let object = |id: u16, e: [f32; 2]| Object {
            id,
            code: Vec3::splat(0.25 * f32::from(id)),
            embeddings: vec![e.to_vec()],
            areas: vec![0.1],
            views: 1,
        };
        Grid { objects: vec![object(1, [1.0, 0.0]), object(2, [0.0, 1.0])] }
    }

    #[test]
    fn the_right_object_is_found_and_absence_is_said() {
        let query = TextQuery { text: vec![1.0, 0.0], canonical: vec![vec![0.1, 0.1]] };
        let hits = select(&rank(&grid(), &query), &QueryConfig::default());
        assert_eq!(hits.iter().map(|h| h.id).collect::<Vec<_>>(), [1]);
        let absent = TextQuery { text: vec![-1.0, 0.0], canonical: vec![vec![0.1, 0.1]] };
        assert!(select(&rank(&grid(), &absent), &QueryConfig::default()).is_empty());
    }

    #[test]
    fn masks_follow_tau_ac() {
        // Features: on code 1, within 5/255 of it, midway between both codes, on code 2.
        let x = [0.25, 0.26, 0.375, 0.5];
        let features: Vec<f32> = x.iter().chain(&x).chain(&x).copied().collect();
        let targets = [Hit { id: 1, score: 1.0 }];
        let paper = Decision::Within(codes::TAU_AC);
        assert_eq!(mask(&grid(), &targets, &features, paper), [true, true, false, false]);
        assert_eq!(restore_objects(&grid(), &features, paper), [1, 1, 0, 2]);
        assert_eq!(restore_objects(&grid(), &[0.1, 0.2, 0.1, 0.2, 0.1, 0.2], Decision::Nearest), [0, 1]);
    }
}
