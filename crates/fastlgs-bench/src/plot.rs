//! Writes charts as SVG and PNG.

use anyhow::{Context, Result, anyhow};
use fastlgs_core::image_io;
use image::RgbImage;
use plotters::coord::Shift;
use plotters::prelude::*;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Once;

/// Title of a chart and labels of its axes.
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

/// Writes `NAME.svg` and `NAME.png` into `folder`, atomically.
///
/// # Errors
/// The drawing fails, or a file cannot be written.
pub fn save(folder: &Path, name: &str, drawing: &impl Drawing) -> Result<()> {
    static FONTS: Once = Once::new();
    FONTS.call_once(|| {
        // Fails only for a damaged font. This font is part of the program.
        let _ = plotters::style::register_font(
            FONT,
            FontStyle::Normal,
            epaint_default_fonts::UBUNTU_LIGHT,
        );
    });
    let (width, height) = drawing.size();
    let path = folder.join(format!("{name}.svg"));
    let cannot = |e: Box<dyn std::error::Error>| {
        anyhow!("{}: drawing the chart failed: {e}", path.display())
    };
    let mut svg = String::new();
    on_white(SVGBackend::with_string(&mut svg, (width, height)), drawing).map_err(cannot)?;
    fastlgs_core::fs::write_atomic(&path, |file| {
        std::io::Write::write_all(file, svg.as_bytes())
    })?;
    let mut pixels = vec![0; (3 * width * height) as usize];
    on_white(
        BitMapBackend::with_buffer(&mut pixels, (width, height)),
        drawing,
    )
    .map_err(cannot)?;
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
    /// Points of one series share a colour.
    pub series: String,
    pub name: String,
    pub x: f64,
    pub y: f64,
    /// Whether the point is on the Pareto front. Such points are filled and joined by a line.
    pub front: bool,
}

/// A scatter chart with names and a logarithmic x axis.
pub struct Scatter<'a> {
    pub axes: Axes<'a>,
    pub spots: &'a [Point],
}

impl Drawing for Scatter<'_> {
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let spots = || self.spots.iter().filter(|s| s.x > 0.0 && s.y.is_finite());
        let span = |of: fn(&Point) -> f64| {
            spots()
                .map(of)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
                    (l.min(v), h.max(v))
                })
        };
        let ((left, right), (low, high)) = (span(|s| s.x), span(|s| s.y));
        let (x, y) = if left.is_finite() {
            // Values between 0 and 1 get the full range. The names need room to the right of their
            // points.
            let y = if low >= 0.0 && high <= 1.0 {
                0.0..1.0
            } else {
                low - 0.1 * (high - low + 1.0)..high + 0.1 * (high - low + 1.0)
            };
            (left / 1.5..right * 2.5, y)
        } else {
            (1.0..10.0, 0.0..1.0)
        };
        let mut chart = titled(area, &self.axes).build_cartesian_2d(x.log_scale(), y)?;
        chart
            .configure_mesh()
            .x_desc(self.axes.x)
            .y_desc(self.axes.y)
            .draw()?;
        let series: BTreeSet<&String> = spots().map(|s| &s.series).collect();
        for (k, name) in series.into_iter().enumerate() {
            let color = Palette99::pick(k).to_rgba();
            let own: Vec<&Point> = spots().filter(|s| s.series == *name).collect();
            let mut front: Vec<(f64, f64)> =
                own.iter().filter(|s| s.front).map(|s| (s.x, s.y)).collect();
            front.sort_by(|a, b| a.0.total_cmp(&b.0));
            let line = chart
                .draw_series(LineSeries::new(front, color.stroke_width(1)))?
                .label(name);
            line.legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2))
            });
            chart.draw_series(own.iter().enumerate().map(|(k, s)| {
                let style = if s.front {
                    color.filled()
                } else {
                    color.stroke_width(1)
                };
                // Shifts neighbouring names vertically, so that they do not overlap.
                let beside = (7, 12 * (k as i32 % 3) - 18);
                EmptyElement::at((s.x, s.y))
                    + Circle::new((0, 0), 4, style)
                    + Text::new(s.name.clone(), beside, (FONT, 12))
            }))?;
        }
        legend!(chart);
        Ok(())
    }
}

/// A cell of a heat map.
#[derive(Clone)]
pub struct Cell {
    pub text: String,
    /// Shade from -1 (red, worse) over 0 (white, unchanged) to 1 (green, better).
    pub shade: f64,
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
    const NAME: i32 = 250;
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
                let depth = cell.shade.clamp(-1.0, 1.0);
                let fade = |full: f64| (255.0 - depth.abs() * (255.0 - full)) as u8;
                let color = if depth < 0.0 {
                    RGBColor(fade(225.0), fade(80.0), fade(70.0))
                } else {
                    RGBColor(fade(90.0), fade(180.0), fade(110.0))
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
    fn charts_are_written_in_both_forms() {
        let folder = tempfile::tempdir().expect("a folder");
        let spot = |x, y| Point {
            series: "s".to_owned(),
            name: "spot".to_owned(),
            x,
            y,
            front: true,
        };
        let axes = || Axes {
            title: "title",
            x: "x",
            y: "y",
        };
        save(
            folder.path(),
            "spots",
            &Scatter {
                axes: axes(),
                spots: &[spot(1.0, 0.5), spot(10.0, f64::NAN)],
            },
        )
        .expect("drawn");
        save(
            folder.path(),
            "none",
            &Scatter {
                axes: axes(),
                spots: &[],
            },
        )
        .expect("drawn");
        let rows = [(
            "row".to_owned(),
            vec![Cell {
                text: "-3".to_owned(),
                shade: -1.0,
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
