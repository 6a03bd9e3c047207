//! Line charts.

use super::{Axes, Drawing, Drawn, titled};
use plotters::coord::Shift;
use plotters::prelude::*;

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
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?;
        Ok(())
    }
}
