//! From a text to objects and from objects to a mask (paper, querying features).

use crate::codes;
use crate::grid::{Grid, Object};
use crate::relevancy::TextQuery;
use fastlgs_core::{LabelMap, Shares};
use glam::Vec3;
use serde::{Deserialize, Serialize};

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
pub const MIN_SCORE: f32 = 0.6;

/// The same for CLIP, whose cosines lie closer together: nearer to the text than to anything. Not calibrated.
pub const CLIP_MIN_SCORE: f32 = 0.55;

/// Share of an object's area, over its views, that decides its score.
pub const BEST_SHARE: f32 = 0.5;

impl Default for QueryConfig {
    fn default() -> Self {
        Self { min_score: MIN_SCORE, top_k: 8, margin: 0.02 }
    }
}

/// An object with its score.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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

/// What full support by the masks adds to the log-odds of the score when objects are ranked.
const SUPPORT_WEIGHT: f32 = 2.5;

/// What objects are ranked by.
pub fn rank_score(score: f32, support: f32) -> f32 {
    odds(score) + SUPPORT_WEIGHT * support
}

/// All objects, best first: by their score and their support. A union of two things is often
/// more relevant than the one that is meant.
pub fn rank(grid: &Grid, query: &TextQuery) -> Vec<Hit> {
    let hits = grid.objects.iter().map(|o| (object_score(o, query), o));
    let mut hits: Vec<(f32, Hit)> = hits.map(|(score, o)| (rank_score(score, o.support), Hit { id: o.id, score })).collect();
    hits.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.id.cmp(&b.1.id)));
    hits.into_iter().map(|h| h.1).collect()
}

/// By how much, in log-odds, a part must be more relevant than what it is a part of to be meant: a face is more like "cat" than a
/// cat is.
const PART_MARGIN: f32 = 1.2;

fn odds(score: f32) -> f32 {
    (score.max(1e-6) / (1.0 - score).max(1e-6)).ln()
}

/// Least support, as a share of the best one's, of an object that is taken instead of a part of it.
pub const SUPPORT_SHARE: f32 = 0.86;

/// Of objects that lie in each other, from small to large: the largest whose support comes near the best.
pub fn best_supported(grid: &Grid, nested: &[u16]) -> Option<u16> {
    let support = |id: &u16| grid.objects[usize::from(*id) - 1].support;
    let best = nested.iter().map(support).fold(0.0, f32::max);
    nested.iter().rev().find(|id| support(id) >= SUPPORT_SHARE * best).copied()
}

/// The target objects; empty means "not found". Of things that lie in each other one is taken: of the best and what around
/// its relevancy is within the margin, the largest whose support comes near the best.
pub fn select(grid: &Grid, ranked: &[Hit], config: &QueryConfig) -> Vec<Hit> {
    let Some(best) = ranked.iter().find(|h| h.score >= config.min_score) else { return Vec::new() };
    let floor = config.min_score.max(best.score - config.margin);
    let mut score = vec![0.0; grid.objects.len() + 1];
    ranked.iter().for_each(|h| score[usize::from(h.id)] = h.score);
    let mut chosen: Vec<Hit> = Vec::new();
    for hit in ranked.iter().filter(|h| h.score >= floor) {
        let within_margin = |s: f32| s >= config.min_score && odds(s) >= odds(hit.score) - PART_MARGIN;
        let around: Vec<u16> = grid.chain(hit.id).filter(|id| within_margin(score[usize::from(*id)])).collect();
        let id = best_supported(grid, &around).unwrap_or(hit.id);
        let nested = |other: &Hit| grid.chain(id).any(|a| a == other.id) || grid.chain(other.id).any(|a| a == id);
        if chosen.len() < config.top_k && !chosen.iter().any(nested) {
            chosen.push(Hit { id, score: score[usize::from(id)] });
        }
    }
    chosen
}

/// The part of the `targets` that is meant, going down their trees; the targets themselves where no part is relevant.
pub fn part(grid: &Grid, targets: &[Hit], query: &TextQuery, config: &QueryConfig) -> Found {
    let inside = |id: u16| grid.chain(id).skip(1).any(|above| targets.iter().any(|t| t.id == above));
    let below: Vec<Hit> = rank(grid, query).into_iter().filter(|h| inside(h.id)).collect();
    let parts = select(grid, &below, config);
    if parts.is_empty() { Found { ranked: targets.to_vec(), targets: targets.to_vec() } } else { Found { ranked: below, targets: parts } }
}

/// The objects of an answer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// What was considered, best first.
    pub ranked: Vec<Hit>,
    /// The answer; empty means "not found".
    pub targets: Vec<Hit>,
}

/// What a rendered view tells about objects.
pub enum Field {
    /// Blending weights by id, of lifted scenes.
    Shares(Shares),
    /// Blended codes, of scenes whose features were trained (the paper's way).
    Features {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
        /// `[3][h][w]`.
        values: Vec<f32>,
        /// Largest distance of a feature to its object's code, on the 0..255 scale.
        tau_ac: f32,
    },
}

impl Field {
    /// The smallest object that each pixel shows; 0 for none.
    pub fn owners(&self, grid: &Grid) -> LabelMap {
        match self {
            Self::Shares(shares) => shares.winners(),
            Self::Features { width, height, values, tau_ac } => {
                let nearest = |feature: Vec3| grid.nearest(feature).filter(|(_, d)| d < tau_ac).map_or(0, |(id, _)| id);
                LabelMap { width: *width, height: *height, labels: features(values).map(nearest).collect() }
            }
        }
    }

    /// The mask of some objects. Each target's code is compared on its own, as in the paper.
    pub fn mask(&self, grid: &Grid, targets: &[Hit]) -> Vec<bool> {
        let ids: Vec<u16> = targets.iter().map(|t| t.id).collect();
        let members = grid.members(&ids);
        match self {
            Self::Shares(shares) => shares.mask(&members),
            Self::Features { values, tau_ac, .. } => {
                let codes: Vec<Vec3> = grid.objects.iter().filter(|o| members[usize::from(o.id)]).map(|o| o.code).collect();
                features(values).map(|f| codes.iter().any(|c| codes::distance(f, *c) < *tau_ac)).collect()
            }
        }
    }

    /// Relevancy of each pixel: the highest of the objects that it belongs to.
    pub fn relevancy(&self, grid: &Grid, ranked: &[Hit]) -> Vec<f32> {
        let mut own = vec![0.0f32; grid.objects.len() + 1];
        ranked.iter().for_each(|h| own[usize::from(h.id)] = h.score);
        let highest = |id| grid.chain(id).fold(0.0, |score: f32, above| score.max(own[usize::from(above)]));
        let score: Vec<f32> = (0..=grid.objects.len() as u16).map(highest).collect();
        self.owners(grid).labels.iter().map(|id| score.get(usize::from(*id)).copied().unwrap_or(0.0)).collect()
    }
}

/// Pixels of a planar feature picture.
fn features(values: &[f32]) -> impl Iterator<Item = Vec3> {
    let n = values.len() / 3;
    (0..n).map(move |p| Vec3::new(values[p], values[n + p], values[2 * n + p]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::shares::pack;

    /// Object 2 lies in object 1; 3 is elsewhere.
    fn grid() -> Grid {
        let object = |id: u16, parent: u16, e: [f32; 2]| Object {
            id,
            parent,
            support: 1.0,
            code: Vec3::splat(0.25 * f32::from(id)),
            embeddings: vec![e.to_vec()],
            areas: vec![0.1],
            views: 1,
        };
        Grid { objects: vec![object(1, 0, [1.0, 0.0]), object(2, 1, [0.8, 0.6]), object(3, 0, [0.0, 1.0])] }
    }

    fn ids(hits: &[Hit]) -> Vec<u16> {
        hits.iter().map(|h| h.id).collect()
    }

    #[test]
    fn the_right_object_is_found_and_absence_is_said() {
        let find = |text: [f32; 2], config: &QueryConfig| {
            let query = TextQuery { text: text.to_vec(), canonical: vec![vec![0.1, 0.1]], anything: -1.0 };
            ids(&select(&grid(), &rank(&grid(), &query), config))
        };
        let config = QueryConfig::default();
        assert_eq!(find([1.0, 0.0], &config), [1]);
        assert_eq!(find([-0.5, 1.0], &config), [3]);
        assert!(find([-1.0, 0.0], &config).is_empty());
        // The part is a little more relevant than the whole: it takes more than that to be meant.
        let one = QueryConfig { top_k: 1, ..config };
        assert_eq!((find([0.85, 0.5], &one), find([0.8, 0.6], &one)), (vec![1], vec![2]));
    }

    #[test]
    fn one_view_that_fools_the_encoder_counts_little() {
        let query = TextQuery { text: vec![1.0, 0.0], canonical: Vec::new(), anything: 0.6 };
        let seen = |recognised: usize| {
            let view = |k: usize| if k < recognised { vec![1.0, 0.0] } else { vec![0.0, 1.0] };
            object_score(&Object { embeddings: (0..5).map(view).collect(), areas: vec![0.1; 5], ..grid().objects[0].clone() }, &query)
        };
        assert!(seen(1) < 0.5, "{}", seen(1));
        assert!(seen(3) > 0.95, "recognised from most sides: {}", seen(3));
    }

    #[test]
    fn parts_are_looked_for_inside_their_object() {
        let query = |text: [f32; 2]| TextQuery { text: text.to_vec(), canonical: Vec::new(), anything: 0.0 };
        let targets = [Hit { id: 1, score: 0.9 }];
        let ask = |text| ids(&part(&grid(), &targets, &query(text), &QueryConfig::default()).targets);
        assert_eq!(ask([0.0, 1.0]), [2], "3 is nearer but lies elsewhere");
        assert_eq!(ask([0.0, -1.0]), [1], "no such part");
    }

    #[test]
    fn a_whole_that_no_mask_shows_is_not_taken_for_its_part() {
        let mut grid = grid();
        let ranked = [Hit { id: 2, score: 0.9 }, Hit { id: 1, score: 0.89 }];
        assert_eq!(ids(&select(&grid, &ranked, &QueryConfig::default())), [1]);
        grid.objects[0].support = 0.5;
        assert_eq!(ids(&select(&grid, &ranked, &QueryConfig::default())), [2]);
    }

    #[test]
    fn several_of_a_kind_are_found_together() {
        let hit = |id, score| Hit { id, score };
        let ranked = [hit(2, 0.97), hit(3, 0.96), hit(1, 0.2)];
        assert_eq!(ids(&select(&grid(), &ranked, &QueryConfig::default())), [2, 3]);
        assert_eq!(ids(&select(&grid(), &ranked, &QueryConfig { top_k: 1, ..QueryConfig::default() })), [2]);
    }

    #[test]
    fn masks_follow_tau_ac() {
        // Features: on code 1, within 5/255 of it, midway between codes 1 and 2, on code 3.
        let x = [0.25, 0.26, 0.375, 0.75];
        let values: Vec<f32> = x.iter().chain(&x).chain(&x).copied().collect();
        let field = Field::Features { width: 4, height: 1, values, tau_ac: codes::TAU_AC };
        assert_eq!(field.mask(&grid(), &[Hit { id: 1, score: 1.0 }]), [true, true, false, false]);
        assert_eq!(field.owners(&grid()).labels, [1, 1, 0, 3]);
    }

    #[test]
    fn an_object_is_shown_by_its_parts_as_well() {
        let pixels = vec![[pack(1, 0.4), pack(2, 0.2), pack(3, 0.4), 0], [pack(2, 0.9), 0, 0, 0], [pack(3, 1.0), 0, 0, 0]];
        let field = Field::Shares(Shares { width: 3, height: 1, pixels });
        let mask = |id| field.mask(&grid(), &[Hit { id, score: 1.0 }]);
        assert_eq!((mask(1), mask(2)), (vec![true, true, false], vec![false, true, false]));
        let ranked = [Hit { id: 1, score: 0.8 }, Hit { id: 2, score: 0.5 }, Hit { id: 3, score: 0.1 }];
        assert_eq!(field.relevancy(&grid(), &ranked), [0.8, 0.8, 0.1]);
    }
}
