//! Charts of accuracy against time and size.

use super::figures::{Mean, Runs, given};
use super::markdown::stamp;
use super::rows::Rows;
use super::ways::{Page, UNDETECTED, Way, on};
use crate::plot::{self, Axes, Marker, Panel, Panels, Point};
use anyhow::Result;

/// Returns name and SVG of all charts.
pub fn all(rows: &Rows) -> Result<Vec<(String, String)>> {
    let charts = [
        (
            "speed.svg",
            objects_by_time(rows),
            "Accuracy against time: from posed photos to answers",
            "seconds",
            "best object, mean IoU",
        ),
        (
            "speed-texts.svg",
            answers_by_time(rows),
            "Answers to texts against time: from posed photos to answers (triangles: without the detector of everyday classes)",
            "seconds",
            "answer, mean IoU",
        ),
        (
            "query.svg",
            panels(
                rows,
                Page::Speed,
                |runs| runs.query_milliseconds(),
                answer,
                by_detector,
            ),
            "Answers to texts against time: first answer in a view; fields without objects: its rendering (triangles: no detector)",
            "milliseconds",
            "answer, mean IoU",
        ),
        (
            "size.svg",
            panels(rows, Page::Size, |runs| runs.megabytes(), best, circle),
            "Accuracy against size",
            "megabytes",
            "best object, mean IoU",
        ),
        (
            "size-psnr.svg",
            panels(rows, Page::Size, |runs| runs.megabytes(), psnr, circle),
            "Colour against size",
            "megabytes",
            "PSNR of held-out views, dB",
        ),
    ];
    let draw = |(name, panels, title, x, y): (&str, _, _, _, _)| {
        let axes = Axes { title, x, y };
        let svg = plot::svg(&Panels { axes, panels }, stamp(rows).trim_end())?;
        Ok((name.to_owned(), svg))
    };
    charts.into_iter().map(draw).collect()
}

/// IoU of the best objects against seconds from photos to answers.
pub fn objects_by_time(rows: &Rows) -> Vec<Panel> {
    panels(rows, Page::Speed, |runs| runs.total_seconds(), best, circle)
}

/// IoU of the answers to texts against seconds from photos to answers.
pub fn answers_by_time(rows: &Rows) -> Vec<Panel> {
    panels(
        rows,
        Page::Speed,
        |runs| runs.total_seconds(),
        answer,
        by_detector,
    )
}

fn best(runs: &Runs) -> Option<Mean> {
    runs.mean("oracle_miou")
}

fn answer(runs: &Runs) -> Option<Mean> {
    runs.mean("miou")
}

fn psnr(runs: &Runs) -> Option<Mean> {
    runs.mean("psnr")
}

/// The marker of charts of best objects, which are the same without the detector.
fn circle(way: &Way) -> Option<Marker> {
    (way.name != UNDETECTED).then_some(Marker::Circle)
}

/// The marker of charts of answers to texts.
fn by_detector(way: &Way) -> Option<Marker> {
    Some(if way.has_detector() {
        Marker::Circle
    } else {
        Marker::Triangle
    })
}

/// Returns a panel for each given scene: the ways of a page, with their Pareto front. Ways that start
/// from prepared photos are not on it, because their seconds lack any repair of poses.
fn panels(
    rows: &Rows,
    page: Page,
    x: impl Fn(&Runs) -> Option<Mean>,
    y: impl Fn(&Runs) -> Option<Mean>,
    marker: impl Fn(&Way) -> Option<Marker>,
) -> Vec<Panel> {
    let point = |scene: &str, way: &Way| {
        let runs = Runs::of(rows, scene, way.name)?;
        let (x, y) = (x(&runs)?, y(&runs)?);
        Some(Point {
            name: way.name.to_owned(),
            x: x.mean,
            y: y.mean,
            ranges: [(x.low, x.high), (y.low, y.high)],
            marker: marker(way)?,
            front: false,
        })
    };
    let panel = |scene: &str| {
        let of = |prepared: bool| -> Vec<Point> {
            let ways = on(page).filter(|way| way.starts_prepared() == prepared);
            ways.filter_map(|way| point(scene, way)).collect()
        };
        let mut points = of(false);
        mark_front(&mut points);
        points.extend(of(true));
        Panel {
            name: scene.to_owned(),
            points,
        }
    };
    let panels = given(rows).into_iter().map(panel);
    panels.filter(|panel| panel.points.len() > 1).collect()
}

/// Marks the Pareto-optimal points: no other point has at most its x and at least its y.
fn mark_front(points: &mut [Point]) {
    let all: Vec<(f64, f64)> = points.iter().map(|p| (p.x, p.y)).collect();
    for point in points {
        let dominates = |other: &(f64, f64)| {
            other.0 <= point.x && other.1 >= point.y && *other != (point.x, point.y)
        };
        point.front = !all.iter().any(dominates);
    }
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{row, rows};
    use super::super::ways::BASE;
    use super::*;

    #[test]
    fn ways_from_prepared_photos_are_not_on_the_front() {
        let mut rows = rows();
        // Better and faster than quick.
        let fewer = "half of the photos missing";
        rows.rows.push(row("fox", fewer, 0, 1.0, 1.0));
        let of_fox = objects_by_time(&rows);
        let point = |name: &str| of_fox[0].points.iter().find(|p| p.name == name).cloned();
        assert!(!point(fewer).expect("the point").front);
        assert!(point(BASE).expect("the point").front);
    }

    #[test]
    fn the_front_has_all_points_that_no_point_dominates() {
        let point = |x: f64, y: f64| Point {
            name: String::new(),
            x,
            y,
            ranges: [(x, x), (y, y)],
            marker: Marker::Circle,
            front: false,
        };
        let mut points = [
            point(1.0, 0.5),
            point(2.0, 0.4),
            point(3.0, 0.6),
            point(1.0, 0.5),
        ];
        mark_front(&mut points);
        assert_eq!(points.map(|p| p.front), [true, false, true, true]);
    }
}
