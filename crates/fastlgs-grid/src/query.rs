//! From a text to objects (paper, querying features).

use crate::calibration::Best;
use crate::grid::{Grid, Object};
use crate::relevancy::TextQuery;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// How objects are chosen.
#[derive(Clone, Copy, Debug)]
pub struct QueryConfig {
    /// Share of the names of absent things that may be answered all the same.
    pub false_alarms: f32,
    /// At most this many objects.
    pub top_k: usize,
}

impl Default for QueryConfig {
    fn default() -> Self {
        Self { false_alarms: 0.07, top_k: 8 }
    }
}

impl QueryConfig {
    /// Score from which an object counts as found.
    pub fn min_score(&self) -> f32 {
        1.0 - self.false_alarms
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

/// What a text says for an object.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    /// Log-odds that this one is meant, up to a constant of the text: the likeness, and how much there is of it.
    pub rank: f32,
    /// The same by the text alone.
    pub likeness: f32,
    /// Share of absent names that no object of a scene is as like as this one is like the text.
    pub score: f32,
    /// Standard error of rank and likeness, from view to view.
    pub error: f32,
}

/// What a text says for each object.
///
/// By Bayes: what the object's cosine is worth (see [`crate::calibration::Calibration`]), and before any text was heard names go to things
/// by how much of the scene's surface these are, so that small fragments, of which there are many, need more likeness; or, where that is more
/// than half, by how much they are not, because a name tells something from the rest. What has less than an equal part of the scene is not the
/// less likely for it. Whether the text names anything at all is told by the likeness alone: by the object that exceeds
/// "anything" most.
///
/// What no view shows or what is nearer to a negative is not meant; the very object that was shown as an example is meant beyond doubt.
pub fn evidence(grid: &Grid, query: &TextQuery) -> Vec<Evidence> {
    let calibration = &query.calibration;
    let (shares, equal) = (grid.shares(), 1.0 / grid.objects.len().max(1) as f32);
    let seen = grid.objects.iter().filter(|object| is_seen(object)).count();
    let of_object = |(object, share): (&Object, f32)| {
        let Some(cosine) = mean_cosine(object, query).filter(|_| !is_refuted(object, query)) else {
            return Evidence { rank: f32::NEG_INFINITY, likeness: f32::NEG_INFINITY, score: 0.0, error: 0.0 };
        };
        if query.shown && object.embeddings.iter().all(|e| query.meant.contains(e)) {
            return Evidence { rank: f32::INFINITY, likeness: f32::INFINITY, score: 1.0, error: 0.0 };
        }
        let likeness = calibration.temperature * cosine;
        let variance = mean_over_views(object, |e| (query.cosine(e) - cosine).powi(2)) / object.embeddings.len() as f32;
        let anything = mean_over_views(object, |e| query.canonical(e));
        Evidence {
            rank: likeness + share.min(1.0 - share).max(equal).ln(),
            likeness,
            score: calibration.confidence(cosine - anything, seen),
            error: calibration.temperature * variance.sqrt(),
        }
    };
    grid.objects.iter().zip(shares).map(of_object).collect()
}

/// By how much the object that is most like what is meant is more so than like anything; nothing where views show fewer than two.
pub fn best(grid: &Grid, query: &TextQuery) -> Option<Best> {
    let margins: Vec<f32> = grid.objects.iter().filter_map(|object| margin(object, query)).collect();
    // Every second one: neighbours in number are of like size.
    let half = |first: usize| margins.iter().skip(first).step_by(2).copied().max_by(f32::total_cmp);
    let (even, odd) = (half(0)?, half(1)?);
    Some(Best { margin: even.max(odd), of_halves: 0.5 * (even + odd), objects: margins.len() })
}

/// The mean over an object's views, weighted by area; 0 where there are none.
fn mean_over_views(object: &Object, of: impl Fn(&[f32]) -> f32) -> f32 {
    let total: f32 = object.areas.iter().sum();
    object.embeddings.iter().zip(&object.areas).map(|(e, area)| area / total.max(f32::MIN_POSITIVE) * of(e)).sum()
}

/// Whether any view tells what an object looks like.
fn is_seen(object: &Object) -> bool {
    !object.embeddings.is_empty() && object.areas.iter().sum::<f32>() > 0.0
}

/// Mean cosine over an object's views, weighted by area; nothing where no view shows it.
pub fn mean_cosine(object: &Object, query: &TextQuery) -> Option<f32> {
    is_seen(object).then(|| mean_over_views(object, |e| query.cosine(e)))
}

/// Whether an object is as near to a negative as to what is meant.
fn is_refuted(object: &Object, query: &TextQuery) -> bool {
    mean_over_views(object, |e| query.negative(e)) >= mean_over_views(object, |e| query.cosine(e))
}

/// By how much an object is more like what is meant than like anything: the mean over its views, weighted by area. Nothing where no view shows it,
/// or where it is nearer to a negative.
pub fn margin(object: &Object, query: &TextQuery) -> Option<f32> {
    (is_seen(object) && !is_refuted(object, query)).then(|| mean_over_views(object, |e| query.cosine(e) - query.canonical(e)))
}

/// All objects, the likeliest first.
pub fn rank(grid: &Grid, query: &TextQuery) -> Vec<Hit> {
    let hit = |(object, Evidence { rank, score, .. }): (&Object, Evidence)| (rank, Hit { id: object.id, score });
    let mut hits: Vec<(f32, Hit)> = grid.objects.iter().zip(evidence(grid, query)).map(hit).collect();
    hits.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.id.cmp(&b.1.id)));
    hits.into_iter().map(|h| h.1).collect()
}

/// Least support, as a share of the best one's, of an object that is taken instead of a part of it.
pub const SUPPORT_SHARE: f32 = 0.98;

/// Share of clicks that go beside what is meant.
const BESIDE: f32 = 0.1;

/// The objects that some pixels of one thing show, from small to large, and the one that is meant; of each pixel, those that have most of it.
///
/// One pixel means the largest object there whose support comes near the best. Views agree easily on what fills them, so that support counts by how much
/// of the scene an object is not: all of it is no thing. Further pixels tell how far the thing reaches, by Bayes: a pixel that falls on it anywhere
/// says the more for it the smaller it is, and one beside it is a mistake.
pub fn pointed(grid: &Grid, pixels: &[Vec<u16>]) -> (Vec<u16>, Option<u16>) {
    let shares = grid.shares();
    let there: BTreeSet<u16> = pixels.iter().flatten().copied().collect();
    let odds = |id: u16| {
        let (object, share) = (&grid.objects[usize::from(id) - 1], shares[usize::from(id) - 1].max(1e-6));
        let on = pixels.iter().filter(|at| at.contains(&id)).count();
        // In logarithms: many clicks say much.
        (object.support * (1.0 - share)).ln() + (1.0 - on as f32) * share.ln() + (pixels.len() - on) as f32 * BESIDE.ln()
    };
    let best = there.iter().map(|id| odds(*id)).fold(f32::NEG_INFINITY, f32::max);
    let meant = there.iter().find(|id| odds(**id) >= SUPPORT_SHARE.ln() + best).copied();
    (there.into_iter().rev().collect(), meant)
}

/// Score of the object that is most like the text: what decides whether it is found.
pub fn best_score(ranked: &[Hit]) -> f32 {
    ranked.iter().map(|hit| hit.score).fold(0.0, f32::max)
}

/// The target objects; empty means "not found". Of those that are found, the likeliest one, and those elsewhere that cannot be told from it: by no more than
/// the errors of both, and not by their size either. A large thing may be meant rather than a small one that is more like the text, but does not
/// become another of its kind by being large.
pub fn select(grid: &Grid, ranked: &[Hit], query: &TextQuery, config: &QueryConfig) -> Vec<Hit> {
    let evidence = evidence(grid, query);
    let of = |hit: &Hit| evidence[usize::from(hit.id) - 1];
    let found = |hit: &&Hit| of(hit).rank > f32::NEG_INFINITY && hit.score >= config.min_score();
    let mut found = ranked.iter().filter(found);
    let Some(best) = found.next() else { return Vec::new() };
    let first = of(best);
    let mut chosen = vec![*best];
    let mut taken = grid.related(best.id);
    for hit in found {
        let own = of(hit);
        if chosen.len() >= config.top_k || first.rank - own.rank > own.error.hypot(first.error) {
            break;
        }
        let alike = own.likeness >= first.likeness - own.error.hypot(first.error);
        if alike && !taken[usize::from(hit.id) - 1] {
            chosen.push(*hit);
            taken.iter_mut().zip(grid.related(hit.id)).for_each(|(taken, related)| *taken |= related);
        }
    }
    chosen
}

/// The part of the `targets` that is meant, among all that lies in them; nothing where no part is found.
pub fn part(grid: &Grid, targets: &[Hit], query: &TextQuery, config: &QueryConfig) -> Option<Found> {
    let whole: Vec<u16> = targets.iter().map(|t| t.id).collect();
    let inside = grid.parts(&whole);
    let below: Vec<Hit> = rank(grid, query).into_iter().filter(|h| inside[usize::from(h.id) - 1] && !whole.contains(&h.id)).collect();
    let parts = select(grid, &below, query, config);
    (!parts.is_empty()).then_some(Found { ranked: below, targets: parts })
}

impl Found {
    /// Scores for a heat map that agrees with the mask: the targets have the best score, and what is no target at most that of the least of them.
    pub fn heat(&self) -> Vec<Hit> {
        let least = self.targets.iter().map(|hit| hit.score).fold(f32::INFINITY, f32::min);
        let best = best_score(&self.ranked);
        let shown = |hit: &Hit| {
            let is_target = self.targets.iter().any(|target| target.id == hit.id);
            Hit { score: if is_target { best } else { hit.score.min(least) }, ..*hit }
        };
        self.ranked.iter().map(shown).collect()
    }
}

/// The objects of an answer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// What was considered, best first.
    pub ranked: Vec<Hit>,
    /// The answer; empty means "not found".
    pub targets: Vec<Hit>,
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use fastlgs_core::rng::Rng;
    use glam::Vec3;

    /// Object 2 lies in object 1; 3 is elsewhere.
    pub(crate) fn grid() -> Grid {
        let object = |id: u16, parent: u16, e: [f32; 2]| Object {
            id,
            parent,
            support: 1.0,
            code: Vec3::splat(0.25 * f32::from(id)),
            embeddings: vec![e.to_vec()],
            areas: vec![0.1],
            views: 1,
        };
        Grid { objects: vec![object(1, 0, [1.0, 0.0]), object(2, 1, [0.8, 0.6]), object(3, 0, [0.0, 1.0])], ..Grid::default() }
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
    fn the_right_object_is_found_and_absence_is_said() {
        let config = QueryConfig::default();
        assert_eq!(find(&grid(), [1.0, 0.0], &config), [1]);
        assert_eq!(find(&grid(), [0.0, 1.0], &config), [3]);
        assert!(find(&grid(), [-1.0, 0.0], &config).is_empty());
        assert_eq!(find(&grid(), [0.8, 0.6], &config), [2], "a part that the text fits better");
        let lenient = QueryConfig { false_alarms: 1.0, ..config };
        assert_eq!(find(&grid(), [-1.0, 0.0], &lenient).len(), 1);
    }

    #[test]
    fn the_heat_map_is_hottest_where_the_mask_is() {
        // A small thing is more like the text, and a large one is meant.
        let hit = |id, score| Hit { id, score };
        let found = Found { ranked: vec![hit(1, 0.95), hit(2, 0.99), hit(3, 0.2)], targets: vec![hit(1, 0.95)] };
        assert_eq!(found.heat(), [hit(1, 0.99), hit(2, 0.95), hit(3, 0.2)]);
        let nothing = Found { targets: Vec::new(), ..found };
        assert_eq!(nothing.heat(), nothing.ranked);
    }

    #[test]
    fn of_things_that_are_as_like_the_text_the_larger_is_meant() {
        let mut grid = grid();
        grid.objects.iter_mut().for_each(|object| object.embeddings = vec![vec![0.999, 0.045]]);
        grid.objects.push(known(4, 0, 0.5, vec![[0.0, 1.0]]));
        // What the objects show without what lies in them; the last is half of the scene.
        for (places, id) in [([0.1, 0.2, 0.1, 0.15, 0.55], 1), ([0.1, 0.1, 0.05, 0.3, 0.55], 3)] {
            grid.shown = places.to_vec();
            assert_eq!(find(&grid, [1.0, 0.0], &QueryConfig::default())[0], id, "{:?}", grid.shares());
        }
    }

    /// An object of which `cosine` is known, and how like a canonical phrase it is.
    fn known(id: u16, parent: u16, area: f32, cosines: Vec<[f32; 2]>) -> Object {
        let (code, areas, views) = (Vec3::ZERO, vec![area; cosines.len()], cosines.len());
        Object { id, parent, support: 1.0, code, embeddings: cosines.into_iter().map(|c| c.to_vec()).collect(), areas, views }
    }

    #[test]
    fn a_fragment_needs_more_likeness_than_a_large_thing() {
        let thing = |id, area, cosine: f32| known(id, 0, area, vec![[cosine, 0.0]; 3]);
        let first = |fragment: f32| {
            let others = (3..40).map(|id| thing(id, 0.01, 0.1));
            let grid =
                Grid { objects: [thing(1, 0.2, 0.6), thing(2, 0.01, fragment)].into_iter().chain(others).collect(), ..Grid::default() };
            rank(&grid, &query([1.0, 0.0]))[0].id
        };
        // A thirteenth of the size (an equal part of the scene, if less) is worth 2.6 of log-odds, some 0.12 of cosine.
        assert_eq!((first(0.68), first(0.78)), (1, 2));
    }

    #[test]
    fn with_clips_statistics_the_text_decides() {
        let rng = &mut Rng::new(5, "clip");
        let mut scene = || -> Grid {
            let mut objects: Vec<Object> = Vec::new();
            for id in 1..=200u16 {
                let parent = if rng.uniform() < 0.2 { 0 } else { (rng.uniform() * f32::from(id - 1)) as u16 };
                let around = objects.get(usize::from(parent).wrapping_sub(1)).map_or(0.4, |o| o.areas[0]);
                // Right for text 1 only, which means any of them.
                let right = if id == 1 { 0.08 } else { 0.0 };
                let own = 0.20 + right + 0.02 * rng.normal();
                let cosines = (0..5).map(|_| [own, 0.21 + 0.015 * rng.normal()]).collect();
                objects.push(known(id, parent, around * rng.range(0.05, 0.6), cosines));
            }
            // The right one is any of them.
            let place = 1 + (rng.uniform() * 199.0) as usize;
            let (first, other) = (objects[0].embeddings.clone(), objects[place].embeddings.clone());
            (objects[0].embeddings, objects[place].embeddings) = (other, first);
            objects[place].support = 0.5;
            Grid { objects, ..Grid::default() }
        };
        let query = TextQuery { canonical: vec![vec![0.0, 1.0]], ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::CLIP) };
        let (mut ours, mut cosines) = (0, 0);
        const TEXTS: i32 = 4000;
        for _ in 0..TEXTS {
            let grid = scene();
            let own = |o: &&Object| mean_cosine(o, &query).unwrap();
            let best = grid.objects.iter().max_by(|a, b| own(a).total_cmp(&own(b))).unwrap();
            cosines += i32::from(best.support == 0.5);
            ours += i32::from(grid.objects[usize::from(rank(&grid, &query)[0].id) - 1].support == 0.5);
        }
        println!("first by cosine {cosines}, by rank {ours} of {TEXTS}");
        assert!(ours + TEXTS / 50 >= cosines, "first by cosine {cosines}, by rank {ours} of {TEXTS}");
    }

    #[test]
    fn a_click_means_a_thing_and_not_all_there_is() {
        // 1 is the whole scene, on which all views agree; 2 a thing in it; 3 a part of that, on which they agree less.
        let object = |id: u16, parent: u16, support: f32| Object { support, parent, ..known(id, parent, 0.1, vec![[0.5, 0.5]]) };
        let objects = vec![object(1, 0, 1.0), object(2, 1, 0.9), object(3, 2, 0.7)];
        let grid = Grid { objects, shown: vec![0.0, 0.8, 0.15, 0.05], ..Grid::default() };
        let meant = |pixels: &[Vec<u16>]| pointed(&grid, pixels);
        assert_eq!(meant(&[vec![3, 2, 1]]), (vec![3, 2, 1], Some(2)));
        assert_eq!(meant(&[vec![1]]).1, Some(1), "where there is nothing else");
        assert_eq!(meant(&[vec![]]), (vec![], None));
        // What all clicks hit is the part, however many they are; one beside it counts less than two.
        assert_eq!(meant(&[vec![3, 2, 1], vec![3, 2, 1], vec![3, 2, 1]]).1, Some(3));
        assert_eq!(meant(&vec![vec![3, 2, 1]; 60]).1, Some(3));
        assert_eq!(meant(&[vec![3, 2, 1], vec![3, 2, 1], vec![3, 2, 1], vec![2, 1], vec![2, 1]]).1, Some(2));
    }

    #[test]
    fn clicks_on_two_parts_mean_what_holds_both_and_one_may_go_beside() {
        let object = |id: u16, parent: u16| Object { support: 0.8, parent, ..known(id, parent, 0.1, vec![[0.5, 0.5]]) };
        // 2 and 3 are parts of 1, which is 0.4 of the scene; 4 is the rest.
        let objects = vec![object(1, 0), object(2, 1), object(3, 1), object(4, 0)];
        let grid = Grid { objects, shown: vec![0.0, 0.1, 0.2, 0.1, 0.6], ..Grid::default() };
        let meant = |pixels: &[Vec<u16>]| pointed(&grid, pixels).1;
        assert_eq!(meant(&[vec![2, 1], vec![3, 1]]), Some(1));
        assert_eq!(meant(&[vec![2, 1], vec![2, 1], vec![2, 1], vec![2, 1], vec![]]), Some(2));
        // Four on one part outweigh one on the other; two do not.
        assert_eq!(meant(&[vec![3, 1], vec![3, 1], vec![3, 1], vec![3, 1], vec![2, 1]]), Some(3));
        assert_eq!(meant(&[vec![3, 1], vec![3, 1], vec![2, 1]]), Some(1));
    }

    #[test]
    fn nothing_is_meant_where_all_is_ruled_out() {
        let config = QueryConfig { false_alarms: 1.0, ..QueryConfig::default() };
        let mut query = query([0.6, 0.8]);
        query.negatives.extend([vec![1.0, 0.0], vec![0.0, 1.0], vec![0.8, 0.6]]);
        assert!(select(&grid(), &rank(&grid(), &query), &query, &config).is_empty());
    }

    #[test]
    fn what_is_nearer_to_a_negative_is_not_meant() {
        let mut query = query([0.95, 0.31]);
        let find = |query: &TextQuery| ids(&select(&grid(), &rank(&grid(), query), query, &QueryConfig::default()))[0];
        assert!(evidence(&grid(), &query).iter().all(|e| e.rank.is_finite()));
        query.negatives.push(vec![1.0, 0.0]);
        assert_eq!(find(&query), 2, "object 1 is nearer to the negative");
    }

    #[test]
    fn one_view_that_fools_the_encoder_counts_little() {
        let seen = |recognised: usize| {
            let view = |k: usize| if k < recognised { vec![1.0, 0.0] } else { vec![0.0, 1.0] };
            let object = Object { embeddings: (0..5).map(view).collect(), areas: vec![0.1; 5], ..grid().objects[0].clone() };
            rank(&Grid { objects: vec![object], ..Grid::default() }, &query([1.0, 0.0]))[0].score
        };
        assert!(seen(1) < 0.05, "{}", seen(1));
        assert!(seen(4) > 0.9, "recognised from most sides: {}", seen(4));
        let unseen = Object { embeddings: Vec::new(), areas: Vec::new(), ..grid().objects[0].clone() };
        assert_eq!(rank(&Grid { objects: vec![unseen], ..Grid::default() }, &query([1.0, 0.0]))[0].score, 0.0);
    }

    #[test]
    fn what_was_shown_is_meant_beyond_doubt() {
        let mut grid = grid();
        // A larger thing that looks nearly the same.
        (grid.objects[2].embeddings, grid.objects[2].areas) = (vec![vec![0.81, 0.586]], vec![0.9]);
        let shown = TextQuery::of_examples(grid.objects[1].embeddings.clone(), Calibration::OFFLINE_PICTURES);
        let ranked = rank(&grid, &shown);
        assert_eq!((ranked[0].id, ranked[0].score), (2, 1.0));
        assert_eq!(ids(&select(&grid, &ranked, &shown, &QueryConfig::default())), [2]);
    }

    #[test]
    fn parts_are_looked_for_inside_their_object() {
        let targets = [Hit { id: 1, score: 0.9 }];
        let ask = |text| part(&grid(), &targets, &query(text), &QueryConfig::default()).map(|found| ids(&found.targets));
        assert_eq!(ask([0.3, 0.954]), Some(vec![2]), "3 is nearer but lies elsewhere");
        assert_eq!(ask([0.0, -1.0]), None, "no such part");
    }

    #[test]
    fn several_of_a_kind_are_found_together() {
        let mut grid = grid();
        // Two things that look alike, within what each varies from view to view.
        let alike = |k: usize| -> Vec<Vec<f32>> {
            [0.98f32, 0.999].map(|c| vec![c, (1.0 - c * c).sqrt()]).into_iter().cycle().skip(k).take(2).collect()
        };
        (grid.objects[1].parent, grid.objects[1].embeddings, grid.objects[1].areas) = (0, alike(0), vec![0.11, 0.1]);
        (grid.objects[2].embeddings, grid.objects[2].areas) = (alike(1), vec![0.1, 0.1]);
        grid.objects[0].embeddings = vec![vec![0.0, 1.0]];
        assert_eq!(find(&grid, [1.0, 0.0], &QueryConfig::default()), [2, 3]);
        assert_eq!(find(&grid, [1.0, 0.0], &QueryConfig { top_k: 1, ..QueryConfig::default() }), [2]);
    }
}
