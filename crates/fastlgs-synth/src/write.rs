//! Writes a generated scene as a folder of photos.

use super::{SceneObject, World, containing_ids};
use fastlgs_core::mask_list::{Mask, RunLengths};
use fastlgs_core::{Camera, Error, LabelMap, Level, MaskList, Result, exr_image, fs, image_io};
use serde_json::json;
use std::path::Path;

/// Format of the exact masks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Masks {
    /// Label maps (16-bit) of three levels: `masks/`, `masks/part/` and `masks/subpart/`.
    Levels,
    /// Lists of overlapping masks, all with the level `whole`: `masks/NAME.json`.
    Lists,
}

/// An object is labelled in a view if its area there is at least 1/`MIN_AREA_DIVISOR` of its
/// largest area in any view. A person would not outline smaller slivers, which are often one pixel
/// wide.
const MIN_AREA_DIVISOR: usize = 100;

/// File with the names of the objects. It is written first and marks a folder of generated photos.
const INSTANCES: &str = "instances.json";

/// Returns an error if the folder contains anything but generated photos, which must neither be
/// mixed with other photos nor replace them.
fn check_output(out: &Path) -> Result<()> {
    #[derive(serde::Deserialize)]
    struct Instance {
        #[serde(rename = "instance")]
        _instance: usize,
        #[serde(rename = "parent")]
        _parent: usize,
    }
    let is_ours = fs::read_json::<Vec<Instance>>(&out.join(INSTANCES)).is_ok();
    let is_empty = out
        .read_dir()
        .map_or(true, |mut entries| entries.next().is_none());
    if is_ours || is_empty {
        return Ok(());
    }
    Err(Error::Invalid(format!(
        "{}: the folder is not empty and does not contain generated photos; choose a new folder",
        out.display()
    )))
}

/// Writes PHOTOS: `images/`, `transforms.json`, exact masks, `depth/` (EXR), and `labels/` of every
/// `holdout`-th view. Calls `done` after each view.
///
/// # Errors
/// A file cannot be written, or `out` contains other files than generated photos.
pub fn write(
    out: &Path,
    world: &World,
    holdout: usize,
    masks: Masks,
    mut done: impl FnMut(),
) -> Result<()> {
    check_output(out)?;
    let instances = world
        .objects
        .iter()
        .enumerate()
        .map(|(k, t)| json!({ "instance": k + 1, "name": t.name, "parent": t.parent }));
    fs::write_json(&out.join(INSTANCES), &instances.collect::<Vec<_>>())?;
    let mut frames = Vec::new();
    let (mut labelled, mut max_areas) = (Vec::new(), vec![0; world.objects.len()]);
    for (index, camera) in world.cameras.iter().enumerate() {
        let view = world.render(index, 2);
        let name = &camera.name;
        image_io::save_png(&out.join("images").join(name), view.photo.clone())?;
        match masks {
            Masks::Levels => {
                for (level, folder) in ["masks", "masks/part", "masks/subpart"]
                    .into_iter()
                    .enumerate()
                {
                    let labels = view
                        .instances
                        .labels
                        .iter()
                        .map(|id| at_level(&world.objects, *id, level))
                        .collect();
                    LabelMap {
                        labels,
                        ..view.instances
                    }
                    .save(&out.join(folder).join(format!("{name}.png")))?;
                }
            }
            Masks::Lists => overlapping(&world.objects, &view.instances)
                .save(&out.join("masks").join(format!("{name}.json")))?,
        }
        let depth = out.join("depth").join(format!("{name}.exr"));
        exr_image::write(
            &depth,
            camera.width as usize,
            camera.height as usize,
            &[("Z", &view.depth)],
        )?;
        let areas = areas(&world.objects, &view.instances);
        max_areas
            .iter_mut()
            .zip(&areas)
            .for_each(|(most, area)| *most = *area.max(most));
        if fastlgs_core::scene_folder::is_held_out(index, holdout) {
            labelled.push((camera, view.instances, areas));
        }
        let flip = glam::Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
        let camera_to_world = (camera.world_to_camera.inverse() * flip)
            .transpose()
            .to_cols_array_2d();
        frames.push(
            json!({ "file_path": format!("images/{name}"), "transform_matrix": camera_to_world }),
        );
        done();
    }
    for (camera, instances, areas) in &labelled {
        write_labels(
            out,
            &world.objects,
            camera,
            instances,
            &slivers(areas, &max_areas),
        )?;
    }
    let first = &world.cameras[0];
    // Written last: its presence shows that the folder is complete.
    let transforms = json!({
        "fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height, "frames": frames,
    });
    fs::write_json(&out.join("transforms.json"), &transforms)
}

/// Returns the object that contains `id` at a level: 0 whole, 1 part, 2 subpart. Returns `id`
/// itself if it is above that level, and 0 for the background.
fn at_level(things: &[SceneObject], id: u16, level: usize) -> u16 {
    let chain: Vec<u16> = containing_ids(things, id).collect();
    chain
        .iter()
        .rev()
        .nth(level)
        .or(chain.first())
        .copied()
        .unwrap_or(0)
}

/// Returns the mask of each visible object and part. The mask of an object includes its parts.
fn overlapping(things: &[SceneObject], instances: &LabelMap) -> MaskList {
    let mut list = MaskList::new(instances.width, instances.height);
    for own in 1..=things.len() as u16 {
        let inside: Vec<bool> = (0..=things.len() as u16)
            .map(|id| containing_ids(things, id).any(|c| c == own))
            .collect();
        let runs = RunLengths::from_fn(instances.width, instances.height, |x, y| {
            inside[usize::from(instances.at(x, y))]
        });
        if runs.area() > 0 {
            list.masks.push(Mask::new(Level::Whole, runs));
        }
    }
    list
}

/// Returns the area of each object in pixels, including its parts.
fn areas(things: &[SceneObject], instances: &LabelMap) -> Vec<usize> {
    let mut areas = vec![0; things.len()];
    instances.labels.iter().for_each(|id| {
        containing_ids(things, *id).for_each(|own| areas[usize::from(own) - 1] += 1)
    });
    areas
}

/// Returns for each object whether its area is a sliver: less than 1/`MIN_AREA_DIVISOR` of its
/// largest area in any view (`max_areas`).
fn slivers(areas: &[usize], max_areas: &[usize]) -> Vec<bool> {
    areas
        .iter()
        .zip(max_areas)
        .map(|(area, most)| MIN_AREA_DIVISOR * area < *most)
        .collect()
}

/// Writes exact labels of objects and parts in the LERF-OVS layout. Each horizontal run of pixels
/// becomes a rectangle.
fn write_labels(
    out: &Path,
    things: &[SceneObject],
    camera: &Camera,
    instances: &LabelMap,
    sliver: &[bool],
) -> Result<()> {
    let mut objects = Vec::new();
    for (k, thing) in things.iter().enumerate().filter(|(k, _)| !sliver[*k]) {
        let own = k as u16 + 1;
        let inside =
            |x: u32, y: u32| containing_ids(things, instances.at(x, y)).any(|id| id == own);
        for y in 0..instances.height {
            let mut x = 0;
            while x < instances.width {
                let (within, start) = (inside(x, y), x);
                while x < instances.width && inside(x, y) == within {
                    x += 1;
                }
                if within {
                    let (x0, x1, y0, y1) = (start, x, y, y + 1);
                    objects.push(json!({ "category": thing.name, "segmentation": [[x0, y0], [x1, y0], [x1, y1], [x0, y1]] }));
                }
            }
        }
    }
    let stem = Path::new(&camera.name)
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let info = json!({ "name": camera.name, "width": camera.width, "height": camera.height });
    fs::write_json(
        &out.join("labels").join(format!("{stem}.json")),
        &json!({ "info": info, "objects": objects }),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_and_areas_follow_the_part_tree() {
        let thing = |name: &str, parent| SceneObject {
            name: name.to_owned(),
            parent,
        };
        let things = [
            thing("cart", 0),
            thing("wheel", 1),
            thing("hub", 2),
            thing("ball", 0),
        ];
        assert_eq!(
            [0, 1, 2].map(|level| at_level(&things, 3, level)),
            [1, 2, 3]
        );
        assert_eq!(
            [0, 1, 2].map(|level| at_level(&things, 4, level)),
            [4, 4, 4]
        );
        assert_eq!(at_level(&things, 0, 1), 0);
        // One pixel each of the background, the cart, its wheel, the hub and the ball.
        let map = LabelMap {
            width: 5,
            height: 1,
            labels: vec![0, 1, 2, 3, 4],
        };
        let of_masks: Vec<usize> = overlapping(&things, &map)
            .masks
            .iter()
            .map(|m| m.runs.area())
            .collect();
        assert_eq!(
            (of_masks, areas(&things, &map)),
            (vec![3, 2, 1, 1], vec![3, 2, 1, 1])
        );
        assert_eq!(
            slivers(&[3, 2, 1, 0], &[301, 200, 1, 0]),
            [true, false, false, false]
        );
    }
}
