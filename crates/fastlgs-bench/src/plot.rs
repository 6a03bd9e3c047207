//! Writes charts as SVG and PNG.

use anyhow::{Context, Result, anyhow};
use fastlgs_core::image_io;
use image::RgbImage;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::path::Path;
use std::sync::Once;

/// Title of a chart and labels of its axes.
#[derive(Clone, Copy)]
pub struct Axes<'a> {
    pub title: &'a str,
    pub x: &'a str,
    pub y: &'a str,
}

/// A drawing for any backend of plotters.
pub trait Drawing {
    /// Width and height in pixels.
    fn size(&self) -> (u32, u32) {
        (860, 560)
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn
    where
        DB::ErrorType: 'static;
}

/// Result of a drawing; the error is that of the backend.
type Drawn = Result<(), Box<dyn std::error::Error>>;

/// The font of all charts.
const FONT: &str = "sans-serif";

fn register_font() {
    static FONTS: Once = Once::new();
    FONTS.call_once(|| {
        // Fails only for a damaged font. This font is part of the program.
        let _ = plotters::style::register_font(
            FONT,
            FontStyle::Normal,
            epaint_default_fonts::UBUNTU_LIGHT,
        );
    });
}

/// Returns a drawing as SVG.
///
/// # Errors
/// The drawing fails.
pub fn svg(drawing: &impl Drawing) -> Result<String> {
    register_font();
    let mut svg = String::new();
    on_white(SVGBackend::with_string(&mut svg, drawing.size()), drawing).map_err(failed)?;
    Ok(svg)
}

fn failed(error: Box<dyn std::error::Error>) -> anyhow::Error {
    anyhow!("drawing a chart failed: {error}")
}

/// Writes `NAME.svg` and `NAME.png` into `folder`, atomically.
///
/// # Errors
/// The drawing fails, or a file cannot be written.
pub fn save(folder: &Path, name: &str, drawing: &impl Drawing) -> Result<()> {
    let (width, height) = drawing.size();
    let svg = svg(drawing)?;
    fastlgs_core::fs::write_atomic(&folder.join(format!("{name}.svg")), |file| {
        std::io::Write::write_all(file, svg.as_bytes())
    })?;
    let mut pixels = vec![0; (3 * width * height) as usize];
    let canvas = BitMapBackend::with_buffer(&mut pixels, (width, height));
    on_white(canvas, drawing).map_err(failed)?;
    let picture = RgbImage::from_raw(width, height, pixels).context("a chart's pixels")?;
    Ok(image_io::save_png(
        &folder.join(format!("{name}.png")),
        picture,
    )?)
}

fn on_white<DB: DrawingBackend>(backend: DB, drawing: &impl Drawing) -> Drawn
where
    DB::ErrorType: 'static,
{
    let area = backend.into_drawing_area();
    area.fill(&WHITE)?;
    drawing.draw(&area)?;
    Ok(area.present()?)
}

/// Starts a chart with a title and margins for the axes.
fn titled<'a, 'b, DB: DrawingBackend>(
    area: &'a DrawingArea<DB, Shift>,
    axes: &Axes,
) -> ChartBuilder<'a, 'b, DB> {
    let mut chart = ChartBuilder::on(area);
    chart
        .caption(axes.title, (FONT, 20))
        .margin(16)
        .x_label_area_size(44)
        .y_label_area_size(60);
    chart
}

/// Draws the legend of a chart.
macro_rules! legend {
    ($chart:expr) => {
        $chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?
    };
}

/// A line with a name.
pub struct Line {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

/// A line chart with two logarithmic axes.
pub struct Lines<'a> {
    pub axes: Axes<'a>,
    pub lines: &'a [Line],
}

impl Drawing for Lines<'_> {
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let points = || {
            self.lines
                .iter()
                .flat_map(|l| &l.points)
                .filter(|p| p.0 > 0.0 && p.1 > 0.0)
        };
        // Margin of a factor 1.5 on each side.
        let range = |of: fn(&(f64, f64)) -> f64| {
            let (low, high) = points()
                .map(of)
                .fold((f64::INFINITY, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
            if low.is_finite() {
                low / 1.5..high * 1.5
            } else {
                1.0..10.0
            }
        };
        let mut chart = titled(area, &self.axes)
            .build_cartesian_2d(range(|p| p.0).log_scale(), range(|p| p.1).log_scale())?;
        chart
            .configure_mesh()
            .x_desc(self.axes.x)
            .y_desc(self.axes.y)
            .draw()?;
        for (k, line) in self.lines.iter().enumerate() {
            let color = Palette99::pick(k).to_rgba();
            let drawn = line
                .points
                .iter()
                .filter(|p| p.0 > 0.0 && p.1 > 0.0)
                .copied();
            let entry = chart
                .draw_series(LineSeries::new(drawn, color.stroke_width(2)).point_size(3))?
                .label(&line.name);
            entry.legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2))
            });
        }
        legend!(chart);
        Ok(())
    }
}

/// A point of a scatter chart.
#[derive(Clone)]
pub struct Point {
    pub name: String,
    pub x: f64,
    pub y: f64,
    /// Lowest and highest y, drawn as a bar.
    pub range: (f64, f64),
    /// Whether the point is on the Pareto front. Such points are filled and joined by a line.
    pub front: bool,
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

    /// Returns the place nearest to a point, at its left or right, that covers no other name and no
    /// point; beside the point if there is none.
    fn near(
        (x, y): (i32, i32),
        width: i32,
        at_left: bool,
        names: &[Self],
        points: &[(i32, i32)],
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
            let covers_point = |(x, y): &(i32, i32)| {
                (y - place.y).abs() < Self::HEIGHT && !is_beside(x - 4, x + 4)
            };
            !names.iter().any(covers_name) && !points.iter().any(covers_point)
        };
        shifts.map(at).find(is_free).unwrap_or_else(|| at(0))
    }
}

/// Returns round numbers of a range for a logarithmic axis; powers of ten if it is wide.
fn ticks(left: f64, right: f64) -> Vec<f64> {
    let decades = left.log10().floor() as i32..=right.log10().floor() as i32;
    let digits: &[f64] = if right > 100.0 * left {
        &[1.0]
    } else {
        &[1.0, 1.5, 2.0, 3.0, 5.0, 7.0]
    };
    let numbers = decades.flat_map(|k| digits.iter().map(move |n| n * 10f64.powi(k)));
    numbers.filter(|x| (left..=right).contains(x)).collect()
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
        let span = |values: &mut dyn Iterator<Item = f64>| {
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
                (l.min(v), h.max(v))
            });
            if low.is_finite() {
                (low, high)
            } else {
                (1.0, 2.0)
            }
        };
        let (left, right) = span(&mut points().map(|p| p.x));
        let (low, high) = span(&mut points().flat_map(|p| [p.range.0, p.range.1]));
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
        chart.draw_series(LineSeries::new(front, COLOR.stroke_width(1)))?;
        chart.draw_series(points().map(|p| {
            let ends = vec![(p.x, p.range.0), (p.x, p.range.1)];
            PathElement::new(ends, BLACK.mix(0.4).stroke_width(1))
        }))?;
        let mut sorted: Vec<&Point> = points().collect();
        sorted.sort_by(|a, b| b.y.total_cmp(&a.y).then(a.x.total_cmp(&b.x)));
        chart.draw_series(sorted.iter().map(|p| {
            let fill = if p.front {
                COLOR.filled()
            } else {
                COLOR.stroke_width(1)
            };
            Circle::new((p.x, p.y), 4, fill)
        }))?;
        let (columns, lines) = area.get_pixel_range();
        let centres: Vec<(i32, i32)> = sorted
            .iter()
            .map(|p| chart.backend_coord(&(p.x, p.y)))
            .map(|(x, y)| (x - columns.start, y - lines.start))
            .collect();
        let style = (FONT, 11).into_text_style(area);
        let mut names: Vec<Name> = Vec::new();
        for (point, centre) in sorted.iter().zip(&centres) {
            let width = area.estimate_text_size(&point.name, &style)?.0 as i32;
            let at_left = 2 * centre.0 > columns.len() as i32;
            let name = Name::near(*centre, width, at_left, &names, &centres);
            let (x, side) = if at_left {
                (name.right, HPos::Right)
            } else {
                (name.left, HPos::Left)
            };
            let style = style.pos(Pos::new(side, VPos::Center));
            area.draw(&Text::new(point.name.clone(), (x, name.y), style))?;
            names.push(name);
        }
        Ok(())
    }
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

/// A cell of a heat map.
#[derive(Clone)]
pub struct Cell {
    pub text: String,
    /// Shade from -1 (red, worse) over 0 (white, unchanged) to 1 (green, better). Grey if there is none.
    pub shade: Option<f64>,
}

/// A table with coloured cells.
pub struct HeatMap<'a> {
    pub title: &'a str,
    pub columns: &'a [&'a str],
    /// Name and cells of each row.
    pub rows: &'a [(String, Vec<Cell>)],
}

impl HeatMap<'_> {
    const ROW: i32 = 20;
    const NAME: i32 = 330;
    const COLUMN: i32 = 92;
    const HEAD: i32 = 64;
}

impl Drawing for HeatMap<'_> {
    fn size(&self) -> (u32, u32) {
        let width = Self::NAME + Self::COLUMN * self.columns.len() as i32 + 16;
        (
            width as u32,
            (Self::HEAD + Self::ROW * self.rows.len() as i32 + 12) as u32,
        )
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let column = |k: usize| Self::NAME + Self::COLUMN * k as i32;
        area.draw(&Text::new(self.title.to_owned(), (8, 10), (FONT, 18)))?;
        for (k, name) in self.columns.iter().enumerate() {
            area.draw(&Text::new(
                (*name).to_owned(),
                (column(k) + 4, Self::HEAD - 18),
                (FONT, 13),
            ))?;
        }
        for (row, (name, cells)) in self.rows.iter().enumerate() {
            let top = Self::HEAD + Self::ROW * row as i32;
            area.draw(&Text::new(name.clone(), (8, top + 4), (FONT, 13)))?;
            for (k, cell) in cells.iter().enumerate() {
                let depth = cell.shade.unwrap_or(0.0).clamp(-1.0, 1.0);
                let fade = |full: f64| (255.0 - depth.abs() * (255.0 - full)) as u8;
                let color = match cell.shade {
                    None => RGBColor(240, 240, 240),
                    Some(_) if depth < 0.0 => RGBColor(fade(225.0), fade(80.0), fade(70.0)),
                    Some(_) => RGBColor(fade(90.0), fade(180.0), fade(110.0)),
                };
                area.draw(&Rectangle::new(
                    [
                        (column(k), top),
                        (column(k) + Self::COLUMN - 2, top + Self::ROW - 2),
                    ],
                    color.filled(),
                ))?;
                area.draw(&Text::new(
                    cell.text.clone(),
                    (column(k) + 6, top + 3),
                    (FONT, 13),
                ))?;
            }
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
        assert_eq!(ticks(4.0, 1200.0), [10.0, 100.0, 1000.0]);
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
    fn labels_have_two_digits() {
        let labels = [0.123, 1.26, 15.8, 126.0].map(two_digits);
        assert_eq!(labels, ["0.12", "1.3", "16", "126"]);
    }

    #[test]
    fn charts_are_written_in_both_forms() {
        let folder = tempfile::tempdir().expect("a folder");
        let point = |x, y: f64| Point {
            name: "spot".to_owned(),
            x,
            y,
            range: (y, y),
            front: true,
        };
        let axes = Axes {
            title: "title",
            x: "x",
            y: "y",
        };
        let panel = |points| Panel {
            name: "panel".to_owned(),
            points,
        };
        let panels = vec![
            panel(vec![point(1.0, 0.5), point(10.0, f64::NAN)]),
            panel(Vec::new()),
        ];
        let drawn = svg(&Panels { axes, panels }).expect("drawn");
        assert!(drawn.contains("spot") && drawn.contains("panel") && drawn.contains("title"));
        svg(&Panels {
            axes,
            panels: Vec::new(),
        })
        .expect("drawn");
        let rows = [(
            "row".to_owned(),
            vec![Cell {
                text: "-3".to_owned(),
                shade: Some(-1.0),
            }],
        )];
        save(
            folder.path(),
            "heat",
            &HeatMap {
                title: "heat",
                columns: &["a"],
                rows: &rows,
            },
        )
        .expect("drawn");
        let svg = std::fs::read_to_string(folder.path().join("heat.svg")).expect("the SVG");
        assert!(svg.contains("row") && svg.contains("heat"));
        let picture = image_io::load_rgb(&folder.path().join("heat.png")).expect("the PNG");
        let red = picture
            .get_pixel(HeatMap::NAME as u32 + 80, HeatMap::HEAD as u32 + 10)
            .0;
        assert!(red[0] > 200 && red[1] < 100, "{red:?}");
        assert!(
            picture
                .pixels()
                .any(|p| p.0 == [0; 3] || p.0.iter().all(|v| *v < 100)),
            "the chart has text"
        );
    }
}
