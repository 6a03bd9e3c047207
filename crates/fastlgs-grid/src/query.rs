//! Selects the objects that answer a query (paper, querying features).

use crate::calibration::Best;
use crate::evidence::{Evidence, evidence, margin};
use crate::grid::{Grid, Object};
use crate::relevancy::{Rule, Source, TextQuery};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Options of object selection.
#[derive(Clone, Copy, Debug)]
pub struct QueryConfig {
    /// Accepted share of absent names that are answered, 0 to 1.
    pub false_alarms: f32,
    /// Largest number of objects in an answer.
    pub top_k: usize,
}

impl Default for QueryConfig {
    fn default() -> Self {
        Self {
            false_alarms: 0.07,
            top_k: 8,
        }
    }
}

impl QueryConfig {
    /// Returns the score from which an object counts as found.
    pub fn min_score(&self, rule: Rule) -> f32 {
        match rule {
            Rule::Calibrated => 1.0 - self.false_alarms,
            Rule::Paper => 0.0,
        }
    }
}

/// An object with its score.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hit {
    /// Object id.
    pub id: u16,
    /// Score, 0 to 1; see [`Evidence`].
    pub score: f32,
}

/// Returns the largest margin of the objects; `None` if fewer than two objects have one.
pub fn best(grid: &Grid, query: &TextQuery) -> Option<Best> {
    let margins: Vec<f32> = grid
        .objects
        .iter()
        .filter_map(|object| margin(object, query))
        .collect();
    best_of(&margins)
}

/// Returns the largest of the objects' margins; `None` with fewer than two.
pub fn best_of(margins: &[f32]) -> Option<Best> {
    // Alternate objects form the halves, because neighbouring ids have similar sizes.
    let half = |first: usize| {
        margins
            .iter()
            .skip(first)
            .step_by(2)
            .copied()
            .max_by(f32::total_cmp)
    };
    let (even, odd) = (half(0)?, half(1)?);
    Some(Best {
        margin: even.max(odd),
        halves_margin: 0.5 * (even + odd),
        objects: margins.len(),
    })
}

/// Returns all objects, sorted by rank in descending order.
pub fn rank(grid: &Grid, query: &TextQuery) -> Vec<Hit> {
    let hit = |(object, Evidence { rank, score, .. }): (&Object, Evidence)| {
        (
            rank,
            Hit {
                id: object.id,
                score,
            },
        )
    };
    let mut hits: Vec<(f32, Hit)> = grid
        .objects
        .iter()
        .zip(evidence(grid, query))
        .map(hit)
        .collect();
    hits.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.id.cmp(&b.1.id)));
    hits.into_iter().map(|h| h.1).collect()
}

/// Smallest odds, relative to those of the best candidate, at which a larger object is preferred to
/// its part.
pub const SUPPORT_SHARE: f32 = 0.98;

/// Assumed share of clicks that miss the target.
const MISCLICK_RATE: f32 = 0.1;

/// Returns the objects at some pixels, smallest first, and the target. `pixels`: for each click,
/// the objects that have most of that pixel.
///
/// log-odds = ln(support * (1 - f)) + (1 - hits) * ln f + misses * ln 0.1
///
/// f is the object's share of the scene's surface. All masks agree on objects that fill the view,
/// so the factor 1 - f penalises the whole scene. Each hit favours small objects by 1 / f; each
/// miss costs a factor of 10.
///
/// The target is the largest object whose odds are at least [`SUPPORT_SHARE`] of the best ones.
pub fn select_at_pixels(grid: &Grid, pixels: &[Vec<u16>]) -> (Vec<u16>, Option<u16>) {
    let shares = grid.shares();
    let candidates: BTreeSet<u16> = pixels.iter().flatten().copied().collect();
    let odds = |id: u16| {
        let (object, share) = (
            &grid.objects[usize::from(id) - 1],
            shares[usize::from(id) - 1].max(1e-6),
        );
        let on = pixels.iter().filter(|at| at.contains(&id)).count();
        // In logarithms, because the odds of many clicks overflow.
        (object.support * (1.0 - share)).ln()
            + (1.0 - on as f32) * share.ln()
            + (pixels.len() - on) as f32 * MISCLICK_RATE.ln()
    };
    let best = candidates
        .iter()
        .map(|id| odds(*id))
        .fold(f32::NEG_INFINITY, f32::max);
    let target = candidates
        .iter()
        .find(|id| odds(**id) >= SUPPORT_SHARE.ln() + best)
        .copied();
    (candidates.into_iter().rev().collect(), target)
}

/// Returns the highest score of the objects; 0 without objects. It decides whether the query is
/// answered.
pub fn best_score(ranked: &[Hit]) -> f32 {
    ranked.iter().map(|hit| hit.score).fold(0.0, f32::max)
}

/// Returns the targets; empty means "not found".
///
/// The first target is the object with the highest rank, if it is found, or a whole that contains
/// it. Others are added if they do not overlap a target. Their rank and calibrated margin may be lower than the first one's by at
/// most the combined standard error.
///
/// The calibrated margin must agree as well. Size alone may make a large object the first target,
/// but not a further one.
pub fn select(grid: &Grid, ranked: &[Hit], query: &TextQuery, config: &QueryConfig) -> Vec<Hit> {
    let evidence = evidence(grid, query);
    let of = |hit: &Hit| evidence[usize::from(hit.id) - 1];
    let found =
        |hit: &&Hit| of(hit).rank > f32::NEG_INFINITY && hit.score >= config.min_score(query.rule);
    // If the likeliest object does not suffice, a less likely one is no answer either.
    let Some(best) = ranked.first().filter(found) else {
        return Vec::new();
    };
    let found = ranked.iter().skip(1).filter(found);
    let best = whole_of(best, grid, ranked, query, &evidence);
    let first = of(best);
    let mut chosen = vec![*best];
    let mut taken = grid.related(best.id);
    for hit in found {
        let own = of(hit);
        if chosen.len() >= config.top_k || first.rank - own.rank > own.error.hypot(first.error) {
            break;
        }
        let alike = own.calibrated_margin >= first.calibrated_margin - own.error.hypot(first.error);
        if alike && !taken[usize::from(hit.id) - 1] {
            chosen.push(*hit);
            taken
                .iter_mut()
                .zip(grid.related(hit.id))
                .for_each(|(taken, related)| *taken |= related);
        }
    }
    chosen
}

/// Returns the largest object that contains `best` and whose rank is not lower by more than twice
/// the combined standard error; `best` itself if there is none.
///
/// A crop of a part looks like a crop of the whole. Their cosines differ by less than those of the
/// views, so cosines do not tell one from the other. The boxes of the detector do.
fn whole_of<'a>(
    best: &'a Hit,
    grid: &Grid,
    ranked: &'a [Hit],
    query: &TextQuery,
    evidence: &[Evidence],
) -> &'a Hit {
    if query.rule == Rule::Paper || *query.source_in(grid) != Source::Embeddings {
        return best;
    }
    let place = |hit: &Hit| usize::from(hit.id) - 1;
    let (shares, first) = (grid.shares(), evidence[place(best)]);
    let is_whole = |hit: &&Hit| {
        let own = evidence[place(hit)];
        first.rank - own.rank <= 2.0 * own.error.hypot(first.error)
            && (shares[place(best)]..0.5).contains(&shares[place(hit)])
            && grid.parts(&[hit.id])[place(best)]
    };
    let wholes = ranked.iter().filter(is_whole);
    wholes
        .max_by(|a, b| shares[place(a)].total_cmp(&shares[place(b)]))
        .unwrap_or(best)
}

/// Returns the part of the `targets` that answers the query, among all objects in them; `None` if
/// no part is found.
pub fn part(
    grid: &Grid,
    targets: &[Hit],
    query: &TextQuery,
    config: &QueryConfig,
) -> Option<Found> {
    let whole: Vec<u16> = targets.iter().map(|t| t.id).collect();
    let inside = grid.parts(&whole);
    let below: Vec<Hit> = rank(grid, query)
        .into_iter()
        .filter(|h| inside[usize::from(h.id) - 1] && !whole.contains(&h.id))
        .collect();
    let parts = select(grid, &below, query, config);
    (!parts.is_empty()).then_some(Found {
        ranked: below,
        targets: parts,
    })
}

impl Found {
    /// Returns scores for a heat map that agrees with the mask. Targets get the highest score;
    /// others at most the lowest score of a target.
    pub fn heat(&self) -> Vec<Hit> {
        let least = self
            .targets
            .iter()
            .map(|hit| hit.score)
            .fold(f32::INFINITY, f32::min);
        let best = best_score(&self.ranked);
        let shown = |hit: &Hit| {
            let is_target = self.targets.iter().any(|target| target.id == hit.id);
            Hit {
                score: if is_target {
                    best
                } else {
                    hit.score.min(least)
                },
                ..*hit
            }
        };
        self.ranked.iter().map(shown).collect()
    }
}

/// Ranking and targets of a query.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// All candidates, sorted by rank in descending order.
    pub ranked: Vec<Hit>,
    /// The targets; empty means "not found".
    pub targets: Vec<Hit>,
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use fastlgs_core::rng::Rng;
    use glam::Vec3;

    /// Object 2 is a part of object 1; object 3 is elsewhere.
    pub(crate) fn grid() -> Grid {
        let object = |id: u16, parent: u16, e: [f32; 2]| Object {
            id,
            parent,
            support: 1.0,
            code: Vec3::splat(0.25 * f32::from(id)),
            embeddings: vec![e.to_vec()],
            areas: vec![0.1],
            views: 1,
            detected: None,
        };
        Grid {
            objects: vec![
                object(1, 0, [1.0, 0.0]),
                object(2, 1, [0.8, 0.6]),
                object(3, 0, [0.0, 1.0]),
            ],
            ..Grid::default()
        }
    }

    fn ids(hits: &[Hit]) -> Vec<u16> {
        hits.iter().map(|h| h.id).collect()
    }

    fn query(text: [f32; 2]) -> TextQuery {
        TextQuery::new(vec![text.to_vec()], Calibration::OFFLINE)
    }

    fn find(grid: &Grid, text: [f32; 2], config: &QueryConfig) -> Vec<u16> {
        let query = query(text);
        ids(&select(grid, &rank(grid, &query), &query, config))
    }

    #[test]
    fn present_names_are_found_and_absent_names_are_not() {
        let config = QueryConfig::default();
        assert_eq!(find(&grid(), [1.0, 0.0], &config), [1]);
        assert_eq!(find(&grid(), [0.0, 1.0], &config), [3]);
        assert!(find(&grid(), [-1.0, 0.0], &config).is_empty());
        assert_eq!(
            find(&grid(), [0.8, 0.6], &config),
            [2],
            "the text fits the part better"
        );
        let lenient = QueryConfig {
            false_alarms: 1.0,
            ..config
        };
        assert_eq!(find(&grid(), [-1.0, 0.0], &lenient).len(), 1);
    }

    #[test]
    fn heat_map_is_highest_at_the_targets() {
        // A small object has the higher score, but a large one is the target.
        let hit = |id, score| Hit { id, score };
        let found = Found {
            ranked: vec![hit(1, 0.95), hit(2, 0.99), hit(3, 0.2)],
            targets: vec![hit(1, 0.95)],
        };
        assert_eq!(found.heat(), [hit(1, 0.99), hit(2, 0.95), hit(3, 0.2)]);
        let nothing = Found {
            targets: Vec::new(),
            ..found
        };
        assert_eq!(nothing.heat(), nothing.ranked);
    }

    #[test]
    fn of_equally_similar_objects_the_larger_ranks_first() {
        let mut grid = grid();
        grid.objects
            .iter_mut()
            .for_each(|object| object.embeddings = vec![vec![0.999, 0.045]]);
        grid.objects
            .push(object_with_cosines(4, 0, 0.5, vec![[0.0, 1.0]]));
        // Surface of each object without its parts. The last object covers half of the scene.
        for (places, id) in [
            ([0.1, 0.2, 0.1, 0.15, 0.55], 1),
            ([0.1, 0.1, 0.05, 0.3, 0.55], 3),
        ] {
            grid.id_areas = places.to_vec();
            assert_eq!(
                find(&grid, [1.0, 0.0], &QueryConfig::default())[0],
                id,
                "{:?}",
                grid.shares()
            );
        }
    }

    /// An object with given cosines: for each view, with the text and with a canonical phrase.
    fn object_with_cosines(id: u16, parent: u16, area: f32, cosines: Vec<[f32; 2]>) -> Object {
        let (code, areas, views) = (Vec3::ZERO, vec![area; cosines.len()], cosines.len());
        Object {
            id,
            parent,
            support: 1.0,
            code,
            embeddings: cosines.into_iter().map(|c| c.to_vec()).collect(),
            areas,
            views,
            detected: None,
        }
    }

    #[test]
    fn by_the_papers_rule_the_largest_relevancy_wins_and_nothing_is_refused() {
        // One view of object 2 has the largest cosine. Object 1 is larger and near in all views.
        let objects = vec![
            object_with_cosines(1, 0, 0.5, vec![[0.25, 0.2]; 3]),
            object_with_cosines(2, 0, 0.01, vec![[0.3, 0.2], [0.1, 0.2], [0.1, 0.2]]),
        ];
        let grid = Grid {
            objects,
            ..Grid::default()
        };
        let query = TextQuery {
            canonical: vec![vec![0.0, 1.0]],
            rule: Rule::Paper,
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP)
        };
        let strict = QueryConfig {
            false_alarms: 0.0,
            ..QueryConfig::default()
        };
        let ranked = rank(&grid, &query);
        assert_eq!(ids(&select(&grid, &ranked, &query, &strict)), [2]);
        let expected = 1.0 / (1.0 + (-1.0f32).exp());
        assert!((ranked[0].score - expected).abs() < 1e-6, "{ranked:?}");
        let calibrated = TextQuery {
            rule: Rule::Calibrated,
            ..query
        };
        assert_eq!(rank(&grid, &calibrated)[0].id, 1);
    }

    #[test]
    fn a_small_object_needs_a_larger_cosine() {
        let thing =
            |id, area, cosine: f32| object_with_cosines(id, 0, area, vec![[cosine, 0.0]; 3]);
        let first = |fragment: f32| {
            let others = (3..40).map(|id| thing(id, 0.01, 0.1));
            let grid = Grid {
                objects: [thing(1, 0.2, 0.6), thing(2, 0.01, fragment)]
                    .into_iter()
                    .chain(others)
                    .collect(),
                ..Grid::default()
            };
            rank(&grid, &query([1.0, 0.0]))[0].id
        };
        // A size ratio of 1/13 (limited by the equal share) costs 2.6 in log-odds, about 0.12 in
        // cosine.
        assert_eq!((first(0.68), first(0.78)), (1, 2));
    }

    #[test]
    fn the_margin_cancels_what_an_object_has_with_all_texts() {
        let rng = &mut Rng::new(5, "clip");
        // Cosines as `fastlgs-bench clip` measures them: an object that is near to one text is near
        // to all. Only object `right` matches the text.
        let mut scene = |right: u16| -> Grid {
            let object = |id: u16| {
                let nearness = 0.012 * rng.normal();
                let own = if id == right { 0.06 } else { 0.0 };
                let cosine = 0.17 + own + 0.9 * nearness + 0.026 * rng.normal();
                object_with_cosines(id, 0, 0.01, vec![[cosine, 0.22 + nearness]])
            };
            Grid {
                objects: (1..=60).map(object).collect(),
                ..Grid::default()
            }
        };
        let query = TextQuery {
            canonical: vec![vec![0.0, 1.0]],
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP)
        };
        const TEXTS: u16 = 3000;
        let (mut by_margin, mut by_cosine) = (0, 0);
        for text in 0..TEXTS {
            let right = 1 + text % 60;
            let grid = scene(right);
            let cosine = |object: &&Object| query.cosine(&object.embeddings[0]);
            let nearest = grid
                .objects
                .iter()
                .max_by(|a, b| cosine(a).total_cmp(&cosine(b)))
                .unwrap();
            by_cosine += u16::from(nearest.id == right);
            by_margin += u16::from(rank(&grid, &query)[0].id == right);
        }
        println!("right object first: {by_cosine} by cosine, {by_margin} by rank, of {TEXTS}");
        assert!(
            by_margin > by_cosine + TEXTS / 50,
            "right object first: {by_cosine} by cosine, {by_margin} by rank, of {TEXTS}"
        );
    }

    #[test]
    fn a_click_selects_an_object_not_the_whole_scene() {
        // Object 1 is the whole scene, with full support; 2 is an object in it; 3 is a part of 2
        // with less support.
        let object = |id: u16, parent: u16, support: f32| Object {
            support,
            parent,
            ..object_with_cosines(id, parent, 0.1, vec![[0.5, 0.5]])
        };
        let objects = vec![object(1, 0, 1.0), object(2, 1, 0.9), object(3, 2, 0.7)];
        let grid = Grid {
            objects,
            id_areas: vec![0.0, 0.8, 0.15, 0.05],
            ..Grid::default()
        };
        let meant = |pixels: &[Vec<u16>]| select_at_pixels(&grid, pixels);
        assert_eq!(meant(&[vec![3, 2, 1]]), (vec![3, 2, 1], Some(2)));
        assert_eq!(meant(&[vec![1]]).1, Some(1), "it is the only object there");
        assert_eq!(meant(&[vec![]]), (vec![], None));
        // If all clicks hit the part, it is the target, however many they are. Two of five clicks
        // beside it select the object.
        assert_eq!(
            meant(&[vec![3, 2, 1], vec![3, 2, 1], vec![3, 2, 1]]).1,
            Some(3)
        );
        assert_eq!(meant(&vec![vec![3, 2, 1]; 60]).1, Some(3));
        assert_eq!(
            meant(&[
                vec![3, 2, 1],
                vec![3, 2, 1],
                vec![3, 2, 1],
                vec![2, 1],
                vec![2, 1]
            ])
            .1,
            Some(2)
        );
    }

    #[test]
    fn clicks_on_two_parts_select_their_whole_and_one_may_miss() {
        let object = |id: u16, parent: u16| Object {
            support: 0.8,
            parent,
            ..object_with_cosines(id, parent, 0.1, vec![[0.5, 0.5]])
        };
        // Objects 2 and 3 are parts of 1, which covers 0.4 of the scene; 4 is the rest.
        let objects = vec![object(1, 0), object(2, 1), object(3, 1), object(4, 0)];
        let grid = Grid {
            objects,
            id_areas: vec![0.0, 0.1, 0.2, 0.1, 0.6],
            ..Grid::default()
        };
        let meant = |pixels: &[Vec<u16>]| select_at_pixels(&grid, pixels).1;
        assert_eq!(meant(&[vec![2, 1], vec![3, 1]]), Some(1));
        assert_eq!(
            meant(&[vec![2, 1], vec![2, 1], vec![2, 1], vec![2, 1], vec![]]),
            Some(2)
        );
        // One click on the other part is outweighed by four, but not by two.
        assert_eq!(
            meant(&[vec![3, 1], vec![3, 1], vec![3, 1], vec![3, 1], vec![2, 1]]),
            Some(3)
        );
        assert_eq!(meant(&[vec![3, 1], vec![3, 1], vec![2, 1]]), Some(1));
    }

    #[test]
    fn a_whole_is_preferred_to_a_part_that_differs_by_less_than_the_views() {
        // Object 2 is a part of 1 and has a higher cosine. Object 3 is the rest.
        let target = |whole: [f32; 2], source: Source| {
            let seen = |id, parent, vote, cosines: [f32; 2]| Object {
                detected: Some([("cat".to_owned(), vote)].into()),
                ..object_with_cosines(id, parent, 0.1, cosines.map(|c| [c, 0.0]).to_vec())
            };
            let grid = Grid {
                objects: vec![
                    seen(1, 0, 0.39, whole),
                    seen(2, 1, 0.4, [0.9, 0.9]),
                    seen(3, 0, 0.1, [0.1, 0.1]),
                ],
                id_areas: vec![0.0, 0.2, 0.1, 0.7],
                ..Grid::default()
            };
            let query = TextQuery {
                source,
                ..query([1.0, 0.0])
            };
            ids(&select(
                &grid,
                &rank(&grid, &query),
                &query,
                &QueryConfig::default(),
            ))[0]
        };
        assert_eq!(target([0.95, 0.65], Source::Embeddings), 1);
        assert_eq!(target([0.81, 0.79], Source::Embeddings), 2, "clearly less");
        let detector = Source::Detector(vec!["cat".to_owned()]);
        assert_eq!(
            target([0.95, 0.65], detector),
            2,
            "votes of the detector tell the level"
        );
    }

    #[test]
    fn no_target_if_all_objects_are_excluded() {
        let config = QueryConfig {
            false_alarms: 1.0,
            ..QueryConfig::default()
        };
        let mut query = query([0.6, 0.8]);
        query
            .negatives
            .extend([vec![1.0, 0.0], vec![0.0, 1.0], vec![0.8, 0.6]]);
        assert!(select(&grid(), &rank(&grid(), &query), &query, &config).is_empty());
    }

    #[test]
    fn objects_nearer_to_a_negative_are_excluded() {
        let mut query = query([0.95, 0.31]);
        let find = |query: &TextQuery| {
            ids(&select(
                &grid(),
                &rank(&grid(), query),
                query,
                &QueryConfig::default(),
            ))[0]
        };
        assert!(evidence(&grid(), &query).iter().all(|e| e.rank.is_finite()));
        query.negatives.push(vec![1.0, 0.0]);
        assert_eq!(find(&query), 2, "object 1 is nearer to the negative");
    }

    #[test]
    fn one_misrecognised_view_has_little_influence() {
        let seen = |recognised: usize| {
            let view = |k: usize| {
                if k < recognised {
                    vec![1.0, 0.0]
                } else {
                    vec![0.0, 1.0]
                }
            };
            let object = Object {
                embeddings: (0..5).map(view).collect(),
                areas: vec![0.1; 5],
                ..grid().objects[0].clone()
            };
            rank(
                &Grid {
                    objects: vec![object],
                    ..Grid::default()
                },
                &query([1.0, 0.0]),
            )[0]
            .score
        };
        assert!(seen(1) < 0.05, "{}", seen(1));
        assert!(seen(4) > 0.9, "recognised in most views: {}", seen(4));
        let unseen = Object {
            embeddings: Vec::new(),
            areas: Vec::new(),
            ..grid().objects[0].clone()
        };
        assert_eq!(
            rank(
                &Grid {
                    objects: vec![unseen],
                    ..Grid::default()
                },
                &query([1.0, 0.0])
            )[0]
            .score,
            0.0
        );
    }

    #[test]
    fn the_example_object_itself_ranks_first() {
        let mut grid = grid();
        // A larger object with nearly the same embedding.
        (grid.objects[2].embeddings, grid.objects[2].areas) = (vec![vec![0.81, 0.586]], vec![0.9]);
        let shown = TextQuery::of_examples(
            grid.objects[1].embeddings.clone(),
            Calibration::OFFLINE_PICTURES,
        );
        let ranked = rank(&grid, &shown);
        assert_eq!((ranked[0].id, ranked[0].score), (2, 1.0));
        assert_eq!(
            ids(&select(&grid, &ranked, &shown, &QueryConfig::default())),
            [2]
        );
    }

    #[test]
    fn parts_are_searched_inside_the_targets() {
        let targets = [Hit { id: 1, score: 0.9 }];
        let ask = |text| {
            part(&grid(), &targets, &query(text), &QueryConfig::default())
                .map(|found| ids(&found.targets))
        };
        assert_eq!(
            ask([0.3, 0.954]),
            Some(vec![2]),
            "object 3 has a higher cosine but lies elsewhere"
        );
        assert_eq!(ask([0.0, -1.0]), None, "no such part");
    }

    #[test]
    fn similar_objects_are_found_together() {
        let mut grid = grid();
        // Two similar objects, whose difference is within the variation between views.
        let alike = |k: usize| -> Vec<Vec<f32>> {
            [0.98f32, 0.999]
                .map(|c| vec![c, (1.0 - c * c).sqrt()])
                .into_iter()
                .cycle()
                .skip(k)
                .take(2)
                .collect()
        };
        (
            grid.objects[1].parent,
            grid.objects[1].embeddings,
            grid.objects[1].areas,
        ) = (0, alike(0), vec![0.11, 0.1]);
        (grid.objects[2].embeddings, grid.objects[2].areas) = (alike(1), vec![0.1, 0.1]);
        grid.objects[0].embeddings = vec![vec![0.0, 1.0]];
        assert_eq!(find(&grid, [1.0, 0.0], &QueryConfig::default()), [2, 3]);
        assert_eq!(
            find(
                &grid,
                [1.0, 0.0],
                &QueryConfig {
                    top_k: 1,
                    ..QueryConfig::default()
                }
            ),
            [2]
        );
    }
}
