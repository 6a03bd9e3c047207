//! Evidence that a query means an object. Each [`Source`] converts its measurements to log-odds, and
//! is calibrated by the share of absent names that it would answer.

use crate::grid::{Grid, Object};
use crate::relevancy::{Rule, Source, TextQuery};

/// Evidence of a query for one object.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    /// Log-odds that the query means this object, up to a constant.
    pub rank: f32,
    /// The same without the object's share of the surface.
    pub calibrated_margin: f32,
    /// Share of absent names whose best object has less evidence, 0 to 1.
    pub score: f32,
    /// Standard error of rank and calibrated margin.
    pub error: f32,
}

impl Evidence {
    /// Evidence that excludes an object.
    const NONE: Self = Self {
        rank: f32::NEG_INFINITY,
        calibrated_margin: f32::NEG_INFINITY,
        score: 0.0,
        error: 0.0,
    };

    /// Evidence for the object that gave the example.
    const CERTAIN: Self = Self {
        rank: f32::INFINITY,
        calibrated_margin: f32::INFINITY,
        score: 1.0,
        error: 0.0,
    };
}

/// Returns the evidence of a query for each object, in order of id.
///
/// Objects at least as near to a negative as to the query have rank -inf and score 0. The object
/// that gave the example has rank inf and score 1.
pub fn evidence(grid: &Grid, query: &TextQuery) -> Vec<Evidence> {
    // The law of absent names depends on the number of objects that are compared.
    let compared = grid.objects.iter().filter(|object| is_seen(object)).count();
    let by_cosines = |object: &Object, prior: f32| by_cosines(object, prior, query, compared);
    match query.source_in(grid) {
        _ if query.rule == Rule::Paper => of_objects(grid, |object, _| by_relevancy(object, query)),
        Source::Detector(classes) => of_objects(grid, |object, _| by_votes(object, query, classes)),
        Source::Unknown => of_objects(grid, |object, prior| Evidence {
            score: 0.0,
            ..by_cosines(object, prior)
        }),
        Source::Embeddings => of_objects(grid, by_cosines),
    }
}

/// Returns the evidence for each object. `of` gets the object and its prior probability, up to a
/// constant: max(min(f, 1 - f), 1 / n) for the share f of the surface and n objects.
///
/// With the prior f, small fragments need a larger margin, because there are many of them. Objects
/// that cover more than half of the scene have the prior `1 - f`, because a name separates an
/// object from the rest. Objects with less than an equal share get the prior `1 / n`.
fn of_objects(grid: &Grid, of: impl Fn(&Object, f32) -> Evidence) -> Vec<Evidence> {
    let equal = 1.0 / grid.objects.len().max(1) as f32;
    let prior = |share: f32| share.min(1.0 - share).max(equal);
    let objects = grid.objects.iter().zip(grid.shares());
    objects
        .map(|(object, share)| of(object, prior(share)))
        .collect()
}

/// Returns the evidence by the cosines of embeddings:
/// rank = temperature * margin + ln prior. `compared` is the number of objects with embeddings.
///
/// The margin is cosine minus canonical cosine; the temperature comes from the
/// [`crate::calibration::Calibration`]. The score depends on the margin alone: the object with the
/// largest margin decides whether the query is answered.
///
/// The margin is the linear discriminant of both cosines: some objects are near to all texts, and
/// the difference cancels that. Between the objects of a room, the regression of a text's cosine on
/// the canonical cosine has a slope of 0.90 (`fastlgs-bench clip`). Without canonical phrases, the
/// margin ranks like the cosine.
fn by_cosines(object: &Object, prior: f32, query: &TextQuery, compared: usize) -> Evidence {
    let calibration = &query.calibration;
    let Some(margin) = margin(object, query) else {
        return Evidence::NONE;
    };
    if query.from_example && object.embeddings.iter().all(|e| query.positive.contains(e)) {
        return Evidence::CERTAIN;
    }
    let calibrated_margin = calibration.temperature * margin;
    let variance = mean_over_views(object, |e| (query.margin(e) - margin).powi(2))
        / object.embeddings.len() as f32;
    Evidence {
        rank: calibrated_margin + prior.ln(),
        calibrated_margin,
        score: calibration.confidence(margin, compared),
        error: calibration.temperature * variance.sqrt(),
    }
}

/// Scale of the exponential distribution of the best vote in a scene for an absent class: of 330
/// classes in five photographed scenes, 7 % exceed 0.110 and half exceed 0.025.
const ABSENT_VOTE: f32 = 0.042;
/// Standard error of the vote for an object, as a share of the vote. Instances of a class in one
/// scene differ by that much.
const VOTE_ERROR: f32 = 0.3;

/// Returns the evidence by the votes of the detector for these classes.
fn by_votes(object: &Object, query: &TextQuery, classes: &[String]) -> Evidence {
    if is_negative(object, query) {
        return Evidence::NONE;
    }
    let votes = object.detected.as_ref();
    let vote = |class: &String| votes.and_then(|votes| votes.get(class)).copied();
    let log_odds = classes.iter().filter_map(vote).fold(0.0, f32::max) / ABSENT_VOTE;
    Evidence {
        rank: log_odds,
        calibrated_margin: log_odds,
        score: 1.0 - (-log_odds).exp(),
        error: VOTE_ERROR * log_odds,
    }
}

/// Returns the evidence for an object by the paper's rule: rank and score are the largest relevancy
/// of its embeddings. The error is 0, so that only the first object is a target.
fn by_relevancy(object: &Object, query: &TextQuery) -> Evidence {
    if !is_seen(object) || is_negative(object, query) {
        return Evidence::NONE;
    }
    let relevancies = object.embeddings.iter().map(|e| query.relevancy(e));
    let relevancy = relevancies.fold(0.0, f32::max);
    Evidence {
        rank: relevancy,
        calibrated_margin: relevancy,
        score: relevancy,
        error: 0.0,
    }
}

/// Returns an object's margin: the mean of [`TextQuery::margin`] over its embeddings, weighted by
/// mask area.
///
/// Returns `None` without embeddings, or if the object is at least as near to a negative.
pub fn margin(object: &Object, query: &TextQuery) -> Option<f32> {
    (is_seen(object) && !is_negative(object, query))
        .then(|| mean_over_views(object, |e| query.margin(e)))
}

/// Returns the mean of `of` over an object's embeddings, weighted by mask area; 0 without
/// embeddings.
fn mean_over_views(object: &Object, of: impl Fn(&[f32]) -> f32) -> f32 {
    let total: f32 = object.areas.iter().sum();
    object
        .embeddings
        .iter()
        .zip(&object.areas)
        .map(|(e, area)| area / total.max(f32::MIN_POSITIVE) * of(e))
        .sum()
}

/// Returns whether an object has embeddings.
fn is_seen(object: &Object) -> bool {
    !object.embeddings.is_empty() && object.areas.iter().sum::<f32>() > 0.0
}

/// Returns whether an object is at least as near to a negative as to the query.
fn is_negative(object: &Object, query: &TextQuery) -> bool {
    !query.negatives.is_empty()
        && mean_over_views(object, |e| query.negative(e))
            >= mean_over_views(object, |e| query.cosine(e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use std::collections::BTreeMap;

    /// An object with one embedding, and votes for a class "cat".
    fn object(id: u16, cosine: f32, cat: f32) -> Object {
        Object {
            id,
            parent: 0,
            support: 1.0,
            code: glam::Vec3::ZERO,
            embeddings: vec![vec![cosine, (1.0 - cosine * cosine).sqrt()]],
            areas: vec![0.1],
            views: 3,
            detected: Some(BTreeMap::from([("cat".to_owned(), cat)])),
        }
    }

    #[test]
    fn each_name_is_decided_by_the_source_that_knows_it() {
        // By embeddings, object 1 is the cat; by the detector, object 2 is.
        let grid = Grid {
            objects: vec![object(1, 0.95, 0.02), object(2, 0.5, 0.3)],
            ..Grid::default()
        };
        let query = |source: Source| TextQuery {
            source,
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::OFFLINE)
        };
        let scores = |grid: &Grid, source: Source| -> Vec<f32> {
            let found = evidence(grid, &query(source));
            found.into_iter().map(|e| e.score).collect()
        };
        let cat = || Source::Detector(vec!["lion".to_owned(), "cat".to_owned()]);
        let by_detector = scores(&grid, cat());
        let expected = 1.0 - (-0.02f32 / ABSENT_VOTE).exp();
        assert!((by_detector[0] - expected).abs() < 1e-6);
        assert!(by_detector[1] > 0.99);
        let by_embeddings = scores(&grid, Source::Embeddings);
        assert!(by_embeddings[0] > by_embeddings[1]);
        assert_eq!(scores(&grid, Source::Unknown), [0.0, 0.0]);
        // Without votes, only embeddings are left.
        let mut without = grid.clone();
        without.objects.iter_mut().for_each(|o| o.detected = None);
        for source in [cat(), Source::Unknown] {
            assert_eq!(scores(&without, source), by_embeddings);
        }
    }
}
