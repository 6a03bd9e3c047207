//! Writes charts as SVG and PNG.

mod heat_map;
mod lines;
mod panels;

pub use heat_map::{Cell, HeatMap};
pub use lines::{Line, Lines};
pub use panels::{Marker, Panel, Panels, Point};

use anyhow::{Context, Result, anyhow};
use fastlgs_core::image_io;
use image::RgbImage;
use plotters::coord::Shift;
use plotters::prelude::*;
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

/// Height of a line of the note below a chart, in pixels.
const NOTE_LINE: u32 = 14;

/// Splits a note into lines that fit into a width in pixels.
fn note_lines(note: &str, width: u32) -> Vec<String> {
    // A letter of the note is at most 6 pixels wide in the mean.
    let letters = (width as usize).saturating_sub(16) / 6;
    let mut lines = vec![String::new()];
    for word in note.split(' ') {
        let line = lines.last_mut().expect("a line");
        if line.is_empty() {
            line.push_str(word);
        } else if line.len() + 1 + word.len() <= letters {
            *line += " ";
            *line += word;
        } else {
            lines.push(word.to_owned());
        }
    }
    lines
}

/// Returns the size of a drawing with its note, in pixels.
fn size_with_note(drawing: &impl Drawing, note: &str) -> (u32, u32) {
    let (width, height) = drawing.size();
    let lines = note_lines(note, width).len() as u32;
    (width, height + NOTE_LINE * lines + 6)
}

/// Returns a drawing as SVG, with a note below it.
///
/// # Errors
/// The drawing fails.
pub fn svg(drawing: &impl Drawing, note: &str) -> Result<String> {
    register_font();
    let mut svg = String::new();
    let canvas = SVGBackend::with_string(&mut svg, size_with_note(drawing, note));
    on_white(canvas, drawing, note).map_err(failed)?;
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
    let svg = svg(drawing, "")?;
    fastlgs_core::fs::write_atomic(&folder.join(format!("{name}.svg")), |file| {
        std::io::Write::write_all(file, svg.as_bytes())
    })?;
    let (width, height) = size_with_note(drawing, "");
    let mut pixels = vec![0; (3 * width * height) as usize];
    let canvas = BitMapBackend::with_buffer(&mut pixels, (width, height));
    on_white(canvas, drawing, "").map_err(failed)?;
    let picture = RgbImage::from_raw(width, height, pixels).context("a chart's pixels")?;
    Ok(image_io::save_png(
        &folder.join(format!("{name}.png")),
        picture,
    )?)
}

fn on_white<DB: DrawingBackend>(backend: DB, drawing: &impl Drawing, note: &str) -> Drawn
where
    DB::ErrorType: 'static,
{
    let area = backend.into_drawing_area();
    area.fill(&WHITE)?;
    let (width, height) = drawing.size();
    let (chart, foot) = area.split_vertically(height);
    drawing.draw(&chart)?;
    for (k, line) in note_lines(note, width).into_iter().enumerate() {
        foot.draw(&Text::new(
            line,
            (8, 2 + NOTE_LINE as i32 * k as i32),
            (FONT, 10),
        ))?;
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_is_split_into_lines_that_fit() {
        assert_eq!(
            note_lines("one two three", 16 + 6 * 7),
            ["one two", "three"]
        );
        assert_eq!(note_lines("", 100), [""]);
    }

    #[test]
    fn charts_are_written_in_both_forms() {
        let folder = tempfile::tempdir().expect("a folder");
        let point = |x, y: f64| Point {
            name: "spot".to_owned(),
            x,
            y,
            ranges: [(x, x), (y, y)],
            marker: Marker::Triangle,
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
        let drawn = svg(&Panels { axes, panels }, "seeds: 0").expect("drawn");
        for text in ["spot", "panel", "title", "seeds: 0"] {
            assert!(drawn.contains(text), "{text}");
        }
        let empty = Panels {
            axes,
            panels: Vec::new(),
        };
        svg(&empty, "").expect("drawn");
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
