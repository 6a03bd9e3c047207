//! Reads labels of LERF-OVS: one JSON file of polygons per view. Polygons of one category form one
//! label.

use super::{Label, LabelledView, Region};
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

/// Reads the labels of a view from its JSON file.
pub fn view(path: &Path) -> Result<LabelledView> {
    let file: File = fs::read_json(path)?;
    if file.info.width == 0 || file.info.height == 0 {
        return Err(Error::format(path, "the width or height in 'info' is 0"));
    }
    let mut labels: Vec<(String, Vec<Vec<[f64; 2]>>)> = Vec::new();
    for object in file.objects {
        let finite = object.segmentation.iter().flatten().all(|v| v.is_finite());
        if object.segmentation.len() < 3 || !finite {
            return Err(Error::format(
                path,
                format!(
                    "the polygon of '{}' has fewer than three points or one that is not finite",
                    object.category
                ),
            ));
        }
        match labels.iter_mut().find(|l| l.0 == object.category) {
            Some(label) => label.1.push(object.segmentation),
            None => labels.push((object.category, vec![object.segmentation])),
        }
    }
    let labels = labels
        .into_iter()
        .map(|(category, polygons)| Label {
            category,
            region: Region::Polygons(polygons),
        })
        .collect();
    Ok(LabelledView {
        name: file.info.name,
        width: file.info.width,
        height: file.info.height,
        labels,
    })
}
