//! Evaluation labels: polygons of LERF-OVS, and masks of 3D-OVS and SPIn-NeRF.

mod lerf;
mod masks;

use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// One labelled object of a view.
#[derive(Clone, Debug)]
pub struct Label {
    /// Name of the object.
    pub category: String,
    /// Pixels of the object in the labelled photo.
    pub region: Region,
}

/// A region of a labelled photo.
#[derive(Clone, Debug)]
pub enum Region {
    /// Union of polygons, with vertices in pixels.
    Polygons(Vec<Vec<[f64; 2]>>),
    /// One value per pixel, in row-major order.
    Mask(Vec<bool>),
}

/// The labels of one view.
#[derive(Clone, Debug)]
pub struct LabelledView {
    /// Name of the photo; without extension in the mask layouts.
    pub name: String,
    /// Width of the labelled photo in pixels.
    pub width: u32,
    /// Height of the labelled photo in pixels.
    pub height: u32,
    /// Labelled objects of the view.
    pub labels: Vec<Label>,
}

impl LabelledView {
    /// Returns the mask of a label at the given size.
    pub fn mask(&self, label: &Label, width: u32, height: u32) -> Vec<bool> {
        let (sx, sy) = (
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        let polygons = match &label.region {
            Region::Mask(mask) => {
                // Index of the source pixel that contains the centre of a target pixel.
                let from = |k: u32, n: u32, of: u32| {
                    ((2 * u64::from(k) + 1) * u64::from(of) / (2 * u64::from(n))) as usize
                };
                let row = |y: u32| from(y, height, self.height) * self.width as usize;
                return (0..width * height)
                    .map(|p| mask[row(p / width) + from(p % width, width, self.width)])
                    .collect();
            }
            Region::Polygons(polygons) => polygons,
        };
        let mut mask = vec![false; (width * height) as usize];
        for polygon in polygons {
            let scaled: Vec<[f64; 2]> = polygon.iter().map(|p| [p[0] * sx, p[1] * sy]).collect();
            fill(&scaled, width, height, &mut mask);
        }
        mask
    }

    /// Returns bounding boxes `[left, top, right, bottom]` of a label at the given size: one for
    /// each polygon, or one for a mask.
    pub fn boxes(&self, label: &Label, width: u32, height: u32) -> Vec<[f64; 4]> {
        let (sx, sy) = (
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        let around = |points: &mut dyn Iterator<Item = [f64; 2]>| {
            points.fold(
                [
                    f64::INFINITY,
                    f64::INFINITY,
                    f64::NEG_INFINITY,
                    f64::NEG_INFINITY,
                ],
                |b, [x, y]| {
                    [
                        b[0].min(x * sx),
                        b[1].min(y * sy),
                        b[2].max(x * sx),
                        b[3].max(y * sy),
                    ]
                },
            )
        };
        match &label.region {
            Region::Polygons(polygons) => polygons
                .iter()
                .map(|p| around(&mut p.iter().copied()))
                .collect(),
            Region::Mask(mask) => {
                let w = self.width as usize;
                let corners = |p: usize| {
                    let (x, y) = ((p % w) as f64, (p / w) as f64);
                    [[x, y], [x + 1.0, y + 1.0]]
                };
                vec![around(
                    &mut (0..mask.len()).filter(|p| mask[*p]).flat_map(corners),
                )]
            }
        }
    }
}

/// Sets the pixels whose centre lies inside the polygon (even-odd rule).
pub(crate) fn fill(polygon: &[[f64; 2]], width: u32, height: u32, mask: &mut [bool]) {
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

/// Reads a folder of labels. Its files determine the layout:
///
/// * LERF-OVS: one JSON file of polygons per view (`*.json`).
/// * 3D-OVS: `classes.txt` and `VIEW/CLASS.png`, in the folder or in `segmentations/` below it.
/// * SPIn-NeRF: one black-and-white image per view (`VIEW.png`), all of one object. Its name is
///   `text`, or else the name of the folder.
///
/// Views are sorted by file name.
///
/// # Errors
/// An empty folder, damaged files, a class that no view shows, or a view without a label.
pub fn load(folder: &Path, text: Option<&str>) -> Result<Vec<LabelledView>> {
    let segmentations = folder.join("segmentations");
    let three_d_ovs = [folder, &segmentations]
        .into_iter()
        .find(|f| f.join("classes.txt").is_file());
    let with_extension = |ending: &str| -> Result<Vec<PathBuf>> {
        let entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
        let mut files: Vec<_> = entries
            .flatten()
            .map(|e| e.path())
            .filter(|p| p.extension().is_some_and(|e| e == ending))
            .collect();
        files.sort();
        Ok(files)
    };
    let (polygons, pictures) = (with_extension("json")?, with_extension("png")?);
    let views = match three_d_ovs {
        Some(folder) => masks::three_d_ovs(folder)?,
        None if !polygons.is_empty() => polygons
            .iter()
            .map(|path| lerf::view(path))
            .collect::<Result<_>>()?,
        None => masks::spin_nerf(folder, &pictures, text)?,
    };
    if views.is_empty() {
        return Err(Error::Invalid(format!(
            "{}: no labels found; expected *.json (LERF-OVS), classes.txt with VIEW/CLASS.png (3D-OVS), or VIEW.png (SPIn-NeRF)",
            folder.display()
        )));
    }
    if let Some(bare) = views.iter().find(|v| v.labels.is_empty()) {
        return Err(Error::Invalid(format!(
            "{}: the view '{}' has no label; label it or remove it",
            folder.display(),
            bare.name
        )));
    }
    Ok(views)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_fills_its_pixels() {
        let mut mask = vec![false; 100];
        fill(
            &[[2.0, 3.0], [6.0, 3.0], [6.0, 5.0], [2.0, 5.0]],
            10,
            10,
            &mut mask,
        );
        assert_eq!(mask.iter().filter(|m| **m).count(), 8);
        assert!(mask[32] && mask[45] && !mask[46] && !mask[52]);
    }

    #[test]
    fn masks_scale_by_pixel_centres_and_have_boxes() {
        let mask: Vec<bool> = (0..16)
            .map(|p| (1..3).contains(&(p % 4)) && p / 4 == 2)
            .collect();
        let label = Label {
            category: "a".to_owned(),
            region: Region::Mask(mask),
        };
        let view = LabelledView {
            name: String::new(),
            width: 4,
            height: 4,
            labels: Vec::new(),
        };
        let double = view.mask(&label, 8, 8);
        let count = double.iter().filter(|m| **m).count();
        assert!(count == 8 && double[4 * 8 + 2] && double[5 * 8 + 5] && !double[6 * 8 + 2]);
        assert_eq!(view.boxes(&label, 8, 8), [[2.0, 4.0, 6.0, 6.0]]);
        let polygon = Label {
            category: "b".to_owned(),
            region: Region::Polygons(vec![vec![[1.0, 1.0], [3.0, 1.0], [3.0, 2.0]]]),
        };
        assert_eq!(view.boxes(&polygon, 4, 8), [[1.0, 2.0, 3.0, 4.0]]);
    }
}
