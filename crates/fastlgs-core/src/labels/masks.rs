//! Reads labels as mask images: one per class and view (3D-OVS), or one per view (SPIn-NeRF).

use super::{Label, LabelledView, Region};
use crate::mask_image::MaskImage;
use crate::{Error, Result, fs};
use std::path::{Path, PathBuf};

/// Returns the file name without its extension.
fn stem(path: &Path) -> String {
    path.file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// Reads a mask and its size; `None` for a mask that is black everywhere.
fn mask(path: &Path) -> Result<((u32, u32), Option<Region>)> {
    let mask = MaskImage::load(path)?;
    Ok((
        (mask.width, mask.height),
        (mask.area() > 0).then_some(Region::Mask(mask.inside)),
    ))
}

/// Reads labels of 3D-OVS: `VIEW/CLASS.png` for the classes in `classes.txt`, one per line. A class
/// that a view does not show has no image or a black one. An image of an unlisted class is an
/// error, and so is a class that no view shows.
pub fn three_d_ovs(folder: &Path) -> Result<Vec<LabelledView>> {
    let list = folder.join("classes.txt");
    let text =
        String::from_utf8(fs::read(&list)?).map_err(|_| Error::format(&list, "not UTF-8 text"))?;
    let classes: Vec<&str> = text
        .lines()
        .map(str::trim)
        .filter(|c| !c.is_empty())
        .collect();
    if classes.is_empty() {
        return Err(Error::format(
            &list,
            "it lists no classes; write one class name per line",
        ));
    }
    let mut views: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(Error::io(folder))?
        .flatten()
        .map(|e| e.path())
        .collect();
    views.retain(|p| p.is_dir());
    views.sort();
    let mut seen = vec![false; classes.len()];
    let mut out = Vec::new();
    for path in views {
        let view = view_of_classes(&path, &list, &classes)?;
        for (class, seen) in classes.iter().zip(&mut seen) {
            *seen |= view.labels.iter().any(|label| label.category == *class);
        }
        out.push(view);
    }
    match seen.iter().position(|s| !s) {
        Some(never) if !out.is_empty() => Err(Error::format(
            &list,
            format!("no view shows the class '{}'", classes[never]),
        )),
        _ => Ok(out),
    }
}

/// Reads the folder of a view, which has a mask for each class that the view shows.
fn view_of_classes(path: &Path, list: &Path, classes: &[&str]) -> Result<LabelledView> {
    let entries = std::fs::read_dir(path).map_err(Error::io(path))?;
    let mut pictures: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    pictures.retain(|p| p.extension().is_some_and(|e| e == "png"));
    pictures.sort();
    let name = path.file_name().unwrap_or_default();
    let mut view = LabelledView {
        name: name.to_string_lossy().into_owned(),
        width: 0,
        height: 0,
        labels: Vec::new(),
    };
    for picture in pictures {
        let category = stem(&picture);
        if !classes.contains(&category.as_str()) {
            let reason = format!("'{category}' is not a class in {}", list.display());
            return Err(Error::format(&picture, reason));
        }
        let (size, region) = mask(&picture)?;
        if !view.labels.is_empty() && size != (view.width, view.height) {
            return Err(Error::format(
                &picture,
                "its size differs from that of the view's other masks",
            ));
        }
        (view.width, view.height) = size;
        if let Some(region) = region {
            view.labels.push(Label { category, region });
        }
    }
    Ok(view)
}

/// Reads labels of SPIn-NeRF: each image is the mask of the one labelled object in the view of the
/// same name. Views with a black mask are left out.
pub fn spin_nerf(
    folder: &Path,
    pictures: &[PathBuf],
    text: Option<&str>,
) -> Result<Vec<LabelledView>> {
    let category = text.map_or_else(|| stem(folder), str::to_owned);
    let mut out = Vec::new();
    for picture in pictures {
        let ((width, height), region) = mask(picture)?;
        let label = |region| Label {
            category: category.clone(),
            region,
        };
        out.extend(region.map(|region| LabelledView {
            name: stem(picture),
            width,
            height,
            labels: vec![label(region)],
        }));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::super::load;
    use super::*;
    use crate::image_io;
    use image::{GrayImage, Luma};

    fn picture(path: &Path, white: u32) {
        let picture = GrayImage::from_fn(6, 4, |x, _| Luma([if x < white { 255 } else { 0 }]));
        image_io::save_png(path, picture).unwrap();
    }

    #[test]
    fn layout_of_3d_ovs() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("segmentations");
        picture(&root.join("04/red bag.png"), 2);
        picture(&root.join("04/camera.png"), 3);
        picture(&root.join("10/red bag.png"), 0);
        picture(&root.join("10/camera.png"), 1);
        std::fs::write(root.join("classes.txt"), "camera\nred bag\n").unwrap();
        let views = load(dir.path(), None).unwrap();
        let found: Vec<(&str, Vec<&str>)> = views
            .iter()
            .map(|v| {
                (
                    v.name.as_str(),
                    v.labels.iter().map(|l| l.category.as_str()).collect(),
                )
            })
            .collect();
        assert_eq!(
            found,
            [("04", vec!["camera", "red bag"]), ("10", vec!["camera"])],
            "a black mask is not a label"
        );
        assert_eq!(
            views[0]
                .mask(&views[0].labels[1], 6, 4)
                .iter()
                .filter(|m| **m)
                .count(),
            8
        );
        std::fs::write(root.join("classes.txt"), "camera\nred bag\nbanana\n").unwrap();
        assert!(
            load(dir.path(), None)
                .unwrap_err()
                .to_string()
                .contains("banana")
        );
        std::fs::write(root.join("classes.txt"), "camera\n").unwrap();
        assert!(
            load(dir.path(), None)
                .unwrap_err()
                .to_string()
                .contains("red bag")
        );
    }

    #[test]
    fn layout_of_spin_nerf() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("fortress");
        picture(&folder.join("IMG_1.png"), 3);
        picture(&folder.join("IMG_2.png"), 0);
        let views = load(&folder, None).unwrap();
        assert_eq!(
            (
                views.len(),
                views[0].name.as_str(),
                views[0].labels[0].category.as_str()
            ),
            (1, "IMG_1", "fortress")
        );
        assert_eq!(
            load(&folder, Some("a stone fortress")).unwrap()[0].labels[0].category,
            "a stone fortress"
        );
        let empty = dir.path().join("empty");
        std::fs::create_dir(&empty).unwrap();
        assert!(
            load(&empty, None)
                .unwrap_err()
                .to_string()
                .contains("3D-OVS")
        );
    }
}
