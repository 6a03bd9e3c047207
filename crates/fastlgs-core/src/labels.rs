//! Hand-drawn evaluation labels in the LERF-OVS layout: one JSON a view with polygons.

use crate::{Error, Result, fs};
use serde::Deserialize;
use std::path::Path;

#[derive(Deserialize)]
struct File {
    info: Info,
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Info {
    name: String,
    width: u32,
    height: u32,
}

#[derive(Deserialize)]
struct Object {
    category: String,
    segmentation: Vec<[f64; 2]>,
}

/// One labelled object of a view; parts with the same category are united.
#[derive(Clone, Debug)]
pub struct Label {
    /// The text that names it.
    pub category: String,
    /// Polygons in pixels of the labelled photo.
    pub polygons: Vec<Vec<[f64; 2]>>,
}

/// The labels of one view.
#[derive(Clone, Debug)]
pub struct LabelledView {
    /// Name of the photo.
    pub name: String,
    /// Width of the labelled photo.
    pub width: u32,
    /// Height of the labelled photo.
    pub height: u32,
    /// Its objects.
    pub labels: Vec<Label>,
}

impl LabelledView {
    /// Mask of a label at the given size.
    pub fn mask(&self, label: &Label, width: u32, height: u32) -> Vec<bool> {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        let mut mask = vec![false; (width * height) as usize];
        for polygon in &label.polygons {
            let scaled: Vec<[f64; 2]> = polygon.iter().map(|p| [p[0] * sx, p[1] * sy]).collect();
            fill(&scaled, width, height, &mut mask);
        }
        mask
    }
}

/// Sets the pixels whose centre lies inside the polygon (even-odd rule).
fn fill(polygon: &[[f64; 2]], width: u32, height: u32, mask: &mut [bool]) {
    for row in 0..height {
        let y = f64::from(row) + 0.5;
        let mut crossings: Vec<f64> = Vec::new();
        for (i, a) in polygon.iter().enumerate() {
            let b = polygon[(i + 1) % polygon.len()];
            if (a[1] <= y) != (b[1] <= y) {
                crossings.push(a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]));
            }
        }
        crossings.sort_by(f64::total_cmp);
        for span in crossings.chunks_exact(2) {
            let from = (span[0] - 0.5).ceil().max(0.0) as u32;
            let to = (span[1] - 0.5).ceil().clamp(0.0, f64::from(width)) as u32;
            for x in from..to.max(from) {
                mask[(row * width + x) as usize] = true;
            }
        }
    }
}

/// Reads every `*.json` of a folder, sorted by file name.
///
/// # Errors
/// An empty folder, damaged JSON, an empty polygon.
pub fn load(folder: &Path) -> Result<Vec<LabelledView>> {
    let entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
    let mut files: Vec<_> = entries.flatten().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "json")).collect();
    files.sort();
    if files.is_empty() {
        return Err(Error::Invalid(format!("{}: no label files (*.json)", folder.display())));
    }
    files.iter().map(|path| load_view(path)).collect()
}

fn load_view(path: &Path) -> Result<LabelledView> {
    let file: File = fs::read_json(path)?;
    if file.info.width == 0 || file.info.height == 0 {
        return Err(Error::format(path, "the labelled photo has no size"));
    }
    let mut view = LabelledView { name: file.info.name, width: file.info.width, height: file.info.height, labels: Vec::new() };
    for object in file.objects {
        let finite = object.segmentation.iter().flatten().all(|v| v.is_finite());
        if object.segmentation.len() < 3 || !finite {
            return Err(Error::format(path, format!("the polygon of '{}' has fewer than three finite points", object.category)));
        }
        match view.labels.iter_mut().find(|l| l.category == object.category) {
            Some(label) => label.polygons.push(object.segmentation),
            None => view.labels.push(Label { category: object.category, polygons: vec![object.segmentation] }),
        }
    }
    Ok(view)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_fills_its_pixels() {
        let mut mask = vec![false; 100];
        fill(&[[2.0, 3.0], [6.0, 3.0], [6.0, 5.0], [2.0, 5.0]], 10, 10, &mut mask);
        assert_eq!(mask.iter().filter(|m| **m).count(), 8);
        assert!(mask[32] && mask[45] && !mask[46] && !mask[52]);
    }
}
