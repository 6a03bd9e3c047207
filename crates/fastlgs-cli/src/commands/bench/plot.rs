//! Charts as SVG: lines over logarithmic axes, and spots over logarithmic time.

use anyhow::{Result, anyhow};
use plotters::prelude::*;
use std::path::Path;

/// What a chart says beside its lines.
pub struct Axes<'a> {
    pub title: &'a str,
    pub x: &'a str,
    pub y: &'a str,
}

/// A named line.
pub struct Line {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

/// Draws on a white sheet and writes it, atomically.
fn save(path: &Path, draw: impl FnOnce(&Area) -> Drawn) -> Result<()> {
    let mut svg = String::new();
    let drawn = (|| -> Drawn {
        let area = SVGBackend::with_string(&mut svg, (860, 560)).into_drawing_area();
        area.fill(&WHITE)?;
        draw(&area)?;
        Ok(area.present()?)
    })();
    drawn.map_err(|e| anyhow!("{}: the chart cannot be drawn: {e}", path.display()))?;
    Ok(fastlgs_core::fs::write_atomic(path, |file| std::io::Write::write_all(file, svg.as_bytes()))?)
}

/// A chart with its title and room for the axes.
fn titled<'a, 'b>(area: &'a Area<'b>, axes: &Axes) -> ChartBuilder<'a, 'b, SVGBackend<'b>> {
    let mut chart = ChartBuilder::on(area);
    chart.caption(axes.title, ("sans-serif", 20)).margin(16).x_label_area_size(44).y_label_area_size(60);
    chart
}

/// Draws the lines.
pub fn write(path: &Path, axes: &Axes, lines: &[Line]) -> Result<()> {
    save(path, |area| draw(area, axes, lines))
}

fn draw(area: &Area, axes: &Axes, lines: &[Line]) -> Drawn {
    let points = || lines.iter().flat_map(|l| &l.points).filter(|p| p.0 > 0.0 && p.1 > 0.0);
    // Half an octave of room around the points.
    let range = |of: fn(&(f64, f64)) -> f64| {
        let (low, high) = points().map(of).fold((f64::INFINITY, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
        if low.is_finite() { low / 1.5..high * 1.5 } else { 1.0..10.0 }
    };
    let mut chart = titled(area, axes).build_cartesian_2d(range(|p| p.0).log_scale(), range(|p| p.1).log_scale())?;
    chart.configure_mesh().x_desc(axes.x).y_desc(axes.y).draw()?;
    for (k, line) in lines.iter().enumerate() {
        let color = Palette99::pick(k).to_rgba();
        let series = LineSeries::new(line.points.iter().copied(), color.stroke_width(2)).point_size(3);
        let entry = chart.draw_series(series)?.label(&line.name);
        entry.legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3)).draw()?;
    Ok(())
}

/// A spot of a scatter chart.
pub struct Spot {
    /// Spots of one series share a colour.
    pub series: String,
    pub name: String,
    pub x: f64,
    pub y: f64,
    /// Whether no other spot of its series is better both ways.
    pub front: bool,
}

/// Draws named spots over logarithmic x and y from 0 to 1; those of the front are filled and joined.
pub fn scatter(path: &Path, axes: &Axes, spots: &[Spot]) -> Result<()> {
    save(path, |area| draw_spots(area, axes, spots))
}

fn draw_spots(area: &Area, axes: &Axes, spots: &[Spot]) -> Drawn {
    let (low, high) = spots.iter().fold((f64::INFINITY, 0.0f64), |(l, h), s| (l.min(s.x), h.max(s.x)));
    let range = if low.is_finite() { low.max(0.01) / 1.5..high.max(0.02) * 3.0 } else { 1.0..10.0 };
    let mut chart = titled(area, axes).build_cartesian_2d(range.log_scale(), 0.0..1.0f64)?;
    chart.configure_mesh().x_desc(axes.x).y_desc(axes.y).draw()?;
    let series: std::collections::BTreeSet<&String> = spots.iter().map(|s| &s.series).collect();
    for (k, name) in series.into_iter().enumerate() {
        let color = Palette99::pick(k).to_rgba();
        let own: Vec<&Spot> = spots.iter().filter(|s| s.series == *name).collect();
        let mut front: Vec<(f64, f64)> = own.iter().filter(|s| s.front).map(|s| (s.x, s.y)).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        let line = chart.draw_series(LineSeries::new(front, color.stroke_width(1)))?.label(name);
        line.legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
        chart.draw_series(own.iter().enumerate().map(|(k, s)| {
            let style = if s.front { color.filled() } else { color.stroke_width(1) };
            // Names of spots that lie close together stay apart.
            let beside = (7, 12 * (k as i32 % 3) - 18);
            EmptyElement::at((s.x, s.y)) + Circle::new((0, 0), 4, style) + Text::new(s.name.clone(), beside, ("sans-serif", 12))
        }))?;
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3)).draw()?;
    Ok(())
}
