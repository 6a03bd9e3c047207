//! Scatter charts beside each other.

use super::{Axes, Drawing, Drawn, FONT, titled};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// A point of a scatter chart.
#[derive(Clone)]
pub struct Point {
    pub name: String,
    pub x: f64,
    pub y: f64,
    /// Lowest and highest x and y, drawn as bars.
    pub ranges: [(f64, f64); 2],
    pub marker: Marker,
    /// Whether the point is on the Pareto front. Such points are filled and joined by a line.
    pub front: bool,
}

/// Shape of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marker {
    Circle,
    Triangle,
}

/// One of several scatter charts with the same axes.
pub struct Panel {
    pub name: String,
    pub points: Vec<Point>,
}

/// Colour of points.
const COLOR: RGBColor = RGBColor(20, 80, 160);
/// Smallest span of a y axis.
const MIN_SPAN: f64 = 0.1;

/// Formats a number with two significant digits, or more before the decimal point.
fn two_digits(value: f64) -> String {
    let decimals = (1.0 - value.abs().max(1e-9).log10().floor()).max(0.0) as usize;
    format!("{value:.decimals$}")
}

/// Place of the name of a point, in pixels: both ends, and the middle of its line.
struct Name {
    left: i32,
    right: i32,
    y: i32,
}

impl Name {
    const HEIGHT: i32 = 11;
    /// Distance from the centre of the point.
    const GAP: i32 = 7;

    /// Returns the place nearest to a point, at its left or right, that covers no other name and
    /// none of the pixels that are `taken`; beside the point if there is none.
    fn near(
        (x, y): (i32, i32),
        width: i32,
        at_left: bool,
        names: &[Self],
        taken: &[(i32, i32)],
    ) -> Self {
        let left = if at_left {
            x - Self::GAP - width
        } else {
            x + Self::GAP
        };
        let at = |shift: i32| Self {
            left,
            right: left + width,
            y: y + shift,
        };
        let shifts = (0..100).map(|k| if k % 2 == 0 { k / 2 } else { -(k + 1) / 2 });
        let is_free = |place: &Self| {
            let is_beside = |from: i32, to: i32| to < place.left || from > place.right;
            let covers_name = |other: &Self| {
                (other.y - place.y).abs() < Self::HEIGHT && !is_beside(other.left, other.right)
            };
            let covers_pixel = |(x, y): &(i32, i32)| {
                (y - place.y).abs() < Self::HEIGHT && !is_beside(x - 4, x + 4)
            };
            !names.iter().any(covers_name) && !taken.iter().any(covers_pixel)
        };
        shifts.map(at).find(is_free).unwrap_or_else(|| at(0))
    }
}

/// Returns round numbers of a range for a logarithmic axis, fewer if it is wide.
fn ticks(left: f64, right: f64) -> Vec<f64> {
    let decades = left.log10().floor() as i32..=right.log10().floor() as i32;
    let digits: &[f64] = if right > 100.0 * left {
        &[1.0, 3.0]
    } else {
        &[1.0, 1.5, 2.0, 3.0, 5.0, 7.0]
    };
    let numbers = decades.flat_map(|k| digits.iter().map(move |n| n * 10f64.powi(k)));
    numbers.filter(|x| (left..=right).contains(x)).collect()
}

/// Returns the smallest and the largest value.
fn span(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let ends = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if ends.0.is_finite() { ends } else { (1.0, 2.0) }
}

/// Scatter charts beside each other, with logarithmic x axes and the names of their points.
pub struct Panels<'a> {
    pub axes: Axes<'a>,
    pub panels: Vec<Panel>,
}

impl Panels<'_> {
    const COLUMNS: usize = 2;
    const PANEL: (u32, u32) = (560, 400);
    const TITLE: u32 = 40;

    fn draw_panel<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, panel: &Panel) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let points = || panel.points.iter().filter(|p| p.x > 0.0 && p.y.is_finite());
        let (left, right) = span(points().flat_map(|p| [p.ranges[0].0, p.ranges[0].1]));
        let (low, high) = span(points().flat_map(|p| [p.ranges[1].0, p.ranges[1].1]));
        // Differences that seeds make alone do not fill the chart.
        let margin = 0.1 * (high - low) + 0.5 * (MIN_SPAN - (high - low)).max(0.0);
        let beside = 1.1 * (right / left).powf(0.1);
        let (left, right) = (left / beside, right * beside);
        let x = (left..right).log_scale();
        let axes = Axes {
            title: &panel.name,
            ..self.axes
        };
        let mut chart = titled(area, &axes).build_cartesian_2d(
            x.with_key_points(ticks(left, right)),
            low - margin..high + margin,
        )?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .max_light_lines(0)
            .x_desc(axes.x)
            .y_desc(axes.y)
            .y_labels(6)
            .x_label_formatter(&|x| two_digits(*x))
            .draw()?;
        let mut front: Vec<(f64, f64)> = points().filter(|p| p.front).map(|p| (p.x, p.y)).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart.draw_series(LineSeries::new(front.clone(), COLOR.stroke_width(1)))?;
        chart.draw_series(points().flat_map(|p| {
            let [x, y] = p.ranges;
            let bars = [[(p.x, y.0), (p.x, y.1)], [(x.0, p.y), (x.1, p.y)]];
            bars.map(|ends| PathElement::new(ends.to_vec(), BLACK.mix(0.4).stroke_width(1)))
        }))?;
        let mut sorted: Vec<&Point> = points().collect();
        sorted.sort_by(|a, b| b.y.total_cmp(&a.y).then(a.x.total_cmp(&b.x)));
        chart.draw_series(sorted.iter().map(|p| {
            let at = (p.x, p.y);
            match p.marker {
                Marker::Circle if p.front => Circle::new(at, 4, COLOR.filled()).into_dyn(),
                Marker::Circle => Circle::new(at, 4, COLOR).into_dyn(),
                Marker::Triangle => TriangleMarker::new(at, 6, COLOR.filled()).into_dyn(),
            }
        }))?;
        // Triangles are always filled.
        let is_hollow = |p: &&&Point| p.marker == Marker::Triangle && !p.front;
        let hollow = sorted.iter().filter(is_hollow);
        chart.draw_series(hollow.map(|p| TriangleMarker::new((p.x, p.y), 4, WHITE.filled())))?;
        let (columns, lines) = area.get_pixel_range();
        let pixel = |x: f64, y: f64| {
            let (x, y) = chart.backend_coord(&(x, y));
            (x - columns.start, y - lines.start)
        };
        let names: Vec<(&str, (i32, i32))> = sorted
            .iter()
            .map(|p| (p.name.as_str(), pixel(p.x, p.y)))
            .collect();
        let front: Vec<(i32, i32)> = front.iter().map(|p| pixel(p.0, p.1)).collect();
        draw_names(area, &names, &front)
    }
}

/// Returns pixels of a line, two apart or less.
fn pixels_of(line: &[(i32, i32)]) -> impl Iterator<Item = (i32, i32)> {
    line.windows(2).flat_map(|ends| {
        let (from, to) = (ends[0], ends[1]);
        let steps = ((to.0 - from.0).abs().max((to.1 - from.1).abs()) / 2).max(1);
        let at = move |from: i32, to: i32, k: i32| from + (to - from) * k / steps;
        (0..=steps).map(move |k| (at(from.0, to.0, k), at(from.1, to.1, k)))
    })
}

/// Draws the names of points beside their centres, given in pixels of `area`, and not on the front.
/// Names that are not right beside their point are joined with it.
fn draw_names<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    points: &[(&str, (i32, i32))],
    front: &[(i32, i32)],
) -> Drawn
where
    DB::ErrorType: 'static,
{
    let centres = points.iter().map(|point| point.1);
    let taken: Vec<(i32, i32)> = centres.chain(pixels_of(front)).collect();
    let width_of_area = area.dim_in_pixel().0 as i32;
    let style = (FONT, 11).into_text_style(area);
    let mut names: Vec<Name> = Vec::new();
    for (text, centre) in points {
        let width = area.estimate_text_size(text, &style)?.0 as i32;
        let at_left = 2 * centre.0 > width_of_area;
        let name = Name::near(*centre, width, at_left, &names, &taken);
        let (x, side) = if at_left {
            (name.right, HPos::Right)
        } else {
            (name.left, HPos::Left)
        };
        if (name.y - centre.1).abs() > Name::HEIGHT {
            let joint = vec![*centre, (x, name.y)];
            area.draw(&PathElement::new(joint, BLACK.mix(0.3).stroke_width(1)))?;
        }
        let style = style.pos(Pos::new(side, VPos::Center));
        area.draw(&Text::new(*text, (x, name.y), style))?;
        names.push(name);
    }
    Ok(())
}

impl Drawing for Panels<'_> {
    fn size(&self) -> (u32, u32) {
        let rows = self.panels.len().max(1).div_ceil(Self::COLUMNS) as u32;
        (
            Self::COLUMNS as u32 * Self::PANEL.0,
            Self::TITLE + rows * Self::PANEL.1,
        )
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let (title, rest) = area.split_vertically(Self::TITLE);
        title.draw(&Text::new(self.axes.title.to_owned(), (16, 12), (FONT, 20)))?;
        let rows = self.panels.len().max(1).div_ceil(Self::COLUMNS);
        let places = rest.split_evenly((rows, Self::COLUMNS));
        for (panel, place) in self.panels.iter().zip(&places) {
            self.draw_panel(place, panel)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers_in_the_range() {
        assert_eq!(ticks(60.0, 210.0), [70.0, 100.0, 150.0, 200.0]);
        assert_eq!(ticks(4.0, 12.0), [5.0, 7.0, 10.0]);
        assert_eq!(ticks(4.0, 1200.0), [10.0, 30.0, 100.0, 300.0, 1000.0]);
    }

    #[test]
    fn names_cover_neither_names_nor_points() {
        let points = [(10, 50), (40, 50), (10, 55)];
        let first = Name::near(points[0], 20, false, &[], &points);
        assert_eq!(
            (first.left, first.right, first.y),
            (17, 37, 39),
            "above the second point"
        );
        let second = Name::near(points[1], 20, true, &[], &points);
        assert_eq!((second.left, second.right), (13, 33));
        let third = Name::near(points[2], 20, false, &[first], &points);
        assert!(third.y >= 61, "{}", third.y);
    }

    #[test]
    fn lines_have_no_gaps() {
        let pixels: Vec<(i32, i32)> = pixels_of(&[(0, 0), (9, 3), (9, -20)]).collect();
        assert_eq!((pixels[0], pixels[pixels.len() - 1]), ((0, 0), (9, -20)));
        let is_near =
            |p: &[(i32, i32)]| (p[0].0 - p[1].0).abs() <= 3 && (p[0].1 - p[1].1).abs() <= 3;
        assert!(pixels.windows(2).all(is_near), "{pixels:?}");
    }

    #[test]
    fn labels_have_two_digits() {
        let labels = [0.123, 1.26, 15.8, 126.0].map(two_digits);
        assert_eq!(labels, ["0.12", "1.3", "16", "126"]);
    }
}
