//! Heat maps.

use super::{Drawing, Drawn, FONT};
use plotters::coord::Shift;
use plotters::prelude::*;

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
    pub(super) const NAME: i32 = 330;
    const COLUMN: i32 = 92;
    pub(super) const HEAD: i32 = 64;
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
