//! Line charts with logarithmic axes, as SVG.

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

/// Draws the lines; atomically.
pub fn write(path: &Path, axes: &Axes, lines: &[Line]) -> Result<()> {
    let mut svg = String::new();
    draw(&mut svg, axes, lines).map_err(|e| anyhow!("{}: the chart cannot be drawn: {e}", path.display()))?;
    Ok(fastlgs_core::fs::write_atomic(path, |file| std::io::Write::write_all(file, svg.as_bytes()))?)
}

fn draw(svg: &mut String, axes: &Axes, lines: &[Line]) -> Result<(), Box<dyn std::error::Error>> {
    let points = || lines.iter().flat_map(|l| &l.points).filter(|p| p.0 > 0.0 && p.1 > 0.0);
    // Half an octave of room around the points.
    let range = |of: fn(&(f64, f64)) -> f64| {
        let (low, high) = points().map(of).fold((f64::INFINITY, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
        if low.is_finite() { low / 1.5..high * 1.5 } else { 1.0..10.0 }
    };
    let area = SVGBackend::with_string(svg, (860, 560)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .caption(axes.title, ("sans-serif", 20))
        .margin(16)
        .x_label_area_size(44)
        .y_label_area_size(60)
        .build_cartesian_2d(range(|p| p.0).log_scale(), range(|p| p.1).log_scale())?;
    chart.configure_mesh().x_desc(axes.x).y_desc(axes.y).draw()?;
    for (k, line) in lines.iter().enumerate() {
        let color = Palette99::pick(k).to_rgba();
        let series = LineSeries::new(line.points.iter().copied(), color.stroke_width(2)).point_size(3);
        let entry = chart.draw_series(series)?.label(&line.name);
        entry.legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3)).draw()?;
    area.present()?;
    drop(chart);
    Ok(())
}
