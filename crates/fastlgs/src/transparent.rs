//! Finds transparent objects. Masks show where they are, and invisible Gaussians represent them.

use crate::Result;
use crate::objects::{self, Mapped, Mapper};
use fastlgs_core::gaussians::{TRANSPARENT_LOGIT, sigmoid};
use fastlgs_core::{Camera, Gaussians, LabelMap, SceneFolder};
use fastlgs_grid::hull::{self, Hull, Outline};
use fastlgs_raster::{Channels, Engine, View};
use std::collections::BTreeMap;
use std::ops::Range;

/// Longer side of the images in which transparent objects are searched, in pixels.
const HULL_SEARCH_SIDE: u32 = 480;
/// Largest number of views in the search; they are spread evenly over all views.
const MAX_SEARCH_VIEWS: usize = 200;
/// Opacity of a transparent Gaussian, as a logit.
const LOGIT: f32 = 1.25 * TRANSPARENT_LOGIT;
/// Transmittance from which a pixel counts as empty.
const EMPTY_TRANSMITTANCE: f32 = 0.5;

/// Returns whether a Gaussian is transparent.
pub fn is_transparent(scene: &Gaussians, gaussian: usize) -> bool {
    scene.opacity_logits[gaussian] <= TRANSPARENT_LOGIT
}

/// Returns the number of transparent Gaussians.
pub fn count(scene: &Gaussians) -> usize {
    (0..scene.len())
        .filter(|i| is_transparent(scene, *i))
        .count()
}

/// Removes the Gaussians for which `stays` is false.
fn retain(scene: &mut Gaussians, stays: impl Fn(&Gaussians, usize) -> bool) {
    let kept: Vec<usize> = (0..scene.len()).filter(|i| stays(scene, *i)).collect();
    if kept.len() < scene.len() {
        *scene = scene.select(&kept);
    }
}

/// Removes the transparent Gaussians from a scene and returns them.
pub fn take_transparent(scene: &mut Gaussians) -> Gaussians {
    let clear: Vec<usize> = (0..scene.len())
        .filter(|i| is_transparent(scene, *i))
        .collect();
    let taken = scene.select(&clear);
    retain(scene, |scene, i| !is_transparent(scene, i));
    taken
}

/// Removes transparent Gaussians that belong to no object.
pub fn remove_unowned(scene: &mut Gaussians) {
    retain(scene, |scene, i| {
        !is_transparent(scene, i) || scene.object_ids[i] > 0
    });
}

/// Maps masks to objects as [`Mapper::map`] does, transparent objects included. Writes the object
/// maps.
pub fn map(mapper: &mut Mapper, scene: &mut Gaussians) -> Result<Mapped> {
    remove_faint(scene);
    let mapped = mapper.map(scene)?;
    let lists = mapped.chosen.lists();
    let mut left = Vec::with_capacity(mapper.cameras.len());
    let (folder, min_support) = (mapper.folder, mapper.config.objects.min_support);
    mapper.write_maps(scene, &mapped, |camera, shown| {
        left.push(unexplained(folder, camera, shown, &lists, min_support)?);
        Ok(())
    })?;
    let Some(with_clear) = add_transparent_objects(mapper, scene, left)? else {
        return Ok(mapped);
    };
    mapper.write_maps(scene, &with_clear, |_, _| Ok(()))?;
    Ok(with_clear)
}

/// Removes Gaussians with an opacity below 1/255: transparent ones of an earlier run, and faded
/// ones.
fn remove_faint(scene: &mut Gaussians) {
    retain(scene, |scene, i| {
        255.0 * sigmoid(scene.opacity_logits[i]) >= 1.0
    });
}

/// Adds transparent Gaussians where `unexplained` masks of the views agree, and maps the objects
/// again. Returns `None` if no transparent object is found.
fn add_transparent_objects(
    mapper: &mut Mapper,
    scene: &mut Gaussians,
    unexplained: Vec<Vec<bool>>,
) -> Result<Option<Mapped>> {
    let hulls = hulls(mapper, scene, unexplained)?;
    if hulls.is_empty() {
        return Ok(None);
    }
    let (solid_count, before) = (scene.len(), scene.object_ids.clone());
    let mut hull_gaussians: Vec<Range<usize>> = hulls
        .iter()
        .map(|hull| add_hull_gaussians(scene, hull))
        .collect();
    loop {
        let mapped = mapper.map(scene)?;
        let lists = mapped.chosen.lists();
        let lists: Vec<&[u16]> = scene
            .object_ids
            .iter()
            .map(|id| lists[usize::from(*id)].as_slice())
            .collect();
        let kept: Vec<Vec<usize>> = hull_gaussians
            .iter()
            .map(|places| gaussians_of_object(&lists, places.clone()))
            .collect();
        let all: Vec<usize> = (0..solid_count)
            .chain(kept.iter().flatten().copied())
            .collect();
        tracing::debug!(
            hulls = hull_gaussians.len(),
            put = scene.len() - solid_count,
            kept = all.len() - solid_count,
            "transparent Gaussians"
        );
        if all.len() == scene.len() {
            return Ok(Some(mapped));
        }
        *scene = scene.select(&all);
        if all.len() == solid_count {
            scene.object_ids = before;
            return Ok(None);
        }
        // Without the removed Gaussians, those behind them may belong to other objects.
        let following = |end: &mut usize, kept: &Vec<usize>| {
            *end += kept.len();
            Some(*end - kept.len()..*end)
        };
        hull_gaussians = kept.iter().scan(solid_count, following).collect();
    }
}

/// Returns the pixels of a view that lie in masks, none of which matches an object. The result is
/// scaled to at most [`HULL_SEARCH_SIDE`] pixels. `object_map` is that of the view. `lists` holds the
/// objects of each id.
fn unexplained(
    folder: &SceneFolder,
    camera: &Camera,
    object_map: &LabelMap,
    lists: &[Vec<u16>],
    min_support: f32,
) -> Result<Vec<bool>> {
    let pixels = hull::unexplained(
        &objects::atoms(folder, camera)?,
        object_map,
        lists,
        min_support,
    );
    let small = camera.shrunk_to(HULL_SEARCH_SIDE);
    let at = |k: u32, from: u32, to: u32| ((2 * k + 1) * from / (2 * to)) as usize;
    let columns = |x| at(x, camera.width, small.width);
    let rows =
        (0..small.height).map(|y| camera.width as usize * at(y, camera.height, small.height));
    Ok(rows
        .flat_map(|row| (0..small.width).map(move |x| row + columns(x)))
        .map(|pixel| pixels[pixel])
        .collect())
}

/// Returns the visual hulls of unexplained masks; none if fewer than `min_views` views have any.
fn hulls(mapper: &mut Mapper, scene: &Gaussians, unexplained: Vec<Vec<bool>>) -> Result<Vec<Hull>> {
    let min_views = mapper.config.objects.min_views;
    if unexplained
        .iter()
        .filter(|view| view.contains(&true))
        .count()
        < min_views
    {
        return Ok(Vec::new());
    }
    mapper.load(scene)?;
    let (training, antialias) = (mapper.cameras, mapper.config.antialias);
    let outline = |(camera, inside): (&Camera, Vec<bool>)| -> Result<Outline> {
        let camera = camera.shrunk_to(HULL_SEARCH_SIDE);
        let depth = depth(mapper.engine, scene, &camera, antialias)?;
        Ok(Outline {
            camera,
            inside,
            depth,
        })
    };
    let every = training.len().div_ceil(MAX_SEARCH_VIEWS);
    let views = training
        .iter()
        .zip(unexplained)
        .step_by(every)
        .map(outline)
        .collect::<Result<Vec<_>>>()?;
    Ok(hull::hulls(&views, min_views))
}

/// Renders the depth of each pixel; infinite where the pixel is empty.
fn depth(
    engine: &mut dyn Engine,
    scene: &Gaussians,
    camera: &Camera,
    antialias: bool,
) -> Result<Vec<f32>> {
    let view = View::new(camera, scene.len(), 0)
        .with_antialias(antialias)
        .with_depth_as_feature();
    let frame = engine.render(view, Channels::Feature)?;
    Ok(frame.depth(EMPTY_TRANSMITTANCE))
}

/// Adds the transparent Gaussians of a hull to a scene, and returns their indices.
fn add_hull_gaussians(scene: &mut Gaussians, hull: &Hull) -> Range<usize> {
    let first = scene.len();
    for place in &hull.points {
        scene.push_sphere(*place, 0.5 * hull.spacing, sigmoid(LOGIT), [0.5; 3]);
        scene.opacity_logits[scene.means.len() - 1] = LOGIT;
    }
    first..scene.len()
}

/// Returns the Gaussians of a hull that belong to its object; none if it has no object. `hull`
/// holds the indices of its Gaussians. Hull and object must each contain more than half of the
/// other. `lists` holds the objects of each Gaussian.
fn gaussians_of_object(lists: &[&[u16]], hull: Range<usize>) -> Vec<usize> {
    let mut held: BTreeMap<u16, usize> = BTreeMap::new();
    hull.clone()
        .flat_map(|place| lists[place])
        .for_each(|object| *held.entry(*object).or_default() += 1);
    // Nested objects can each contain more than half of the hull: take the smallest.
    let all = |object: u16| lists.iter().filter(|list| list.contains(&object)).count();
    let most = held
        .into_iter()
        .filter(|(_, common)| 2 * common > hull.len())
        .map(|(object, common)| (all(object), common, object));
    let object = most
        .min()
        .filter(|(all, common, _)| 2 * common > *all)
        .map(|found| found.2);
    object.map_or_else(Vec::new, |object| {
        hull.filter(|place| lists[*place].contains(&object))
            .collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Run, Silent};
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};
    use glam::{Vec2, Vec3};

    /// Returns twelve cameras around an invisible pane, inside a sphere of solid Gaussians. Only
    /// the masks show the pane.
    fn scene(folder: &SceneFolder) -> (Gaussians, Vec<Camera>) {
        let mut scene = Gaussians::default();
        for k in 0..4000 {
            let (turn, y) = (2.399_963 * k as f32, 1.0 - (2 * k + 1) as f32 / 4000.0);
            let around = (1.0 - y * y).sqrt() * Vec2::from_angle(turn);
            scene.push_sphere(5.0 * Vec3::new(around.x, y, around.y), 0.2, 0.95, [0.5; 3]);
        }
        let cameras = (0..12).map(|k| {
            let around = 3.0 * Vec2::from_angle(std::f32::consts::TAU * k as f32 / 12.0);
            Camera::look_at(
                &format!("{k:02}.png"),
                Vec3::new(around.x, 0.4, around.y),
                Vec3::ZERO,
                Vec3::Y,
                160,
                120,
                0.8,
            )
        });
        let cameras: Vec<Camera> = cameras.collect();
        for camera in &cameras {
            let half = Vec3::new(0.5, 0.5, 0.05);
            let to_world = camera.world_to_camera.inverse();
            let pane = RunLengths::from_fn(160, 120, |x, y| {
                let direction = to_world
                    .transform_vector3(camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)));
                let [a, b] = [-half, half].map(|corner| (corner - camera.centre()) / direction);
                a.min(b).max_element() < a.max(b).min_element()
            });
            MaskList {
                masks: vec![Mask::new(Level::Whole, pane)],
                ..MaskList::new(160, 120)
            }
            .save(&folder.masks_path(&camera.name))
            .unwrap();
        }
        (scene, cameras)
    }

    #[test]
    fn an_invisible_pane_with_masks_becomes_an_object() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let (mut scene, cameras) = scene(&folder);
        let wall = scene.clone();
        let run = Run {
            seed: 0,
            device: "cpu",
            progress: &Silent,
        };
        let mut engine = fastlgs_raster::CpuEngine::new();
        let mut mapper = Mapper {
            folder: &folder,
            cameras: &cameras,
            config: objects::MappingConfig {
                objects: fastlgs_grid::objects::SelectionConfig::default(),
                antialias: false,
            },
            engine: &mut engine,
            run: &run,
        };
        let mapped = mapper.map(&mut scene).unwrap();
        let min_support = mapper.config.objects.min_support;
        assert!(
            mapped.chosen.support.is_empty(),
            "no part of the wall is in most of the masks"
        );
        let left = |camera: &Camera| {
            unexplained(
                &folder,
                camera,
                &LabelMap::new(160, 120),
                &mapped.chosen.lists(),
                min_support,
            )
            .unwrap()
        };
        let left = cameras.iter().map(left).collect();
        let mapped = add_transparent_objects(&mut mapper, &mut scene, left)
            .unwrap()
            .expect("a pane");
        let supports: Vec<f32> = mapped
            .chosen
            .support
            .iter()
            .map(|support| support.iou)
            .collect();
        assert!(supports.len() == 1 && supports[0] > 0.7, "{supports:?}");
        assert_eq!(scene.means[..wall.len()], wall.means);
        assert!(scene.len() > wall.len() && count(&scene) == scene.len() - wall.len());
        assert!(
            scene.object_ids[wall.len()..].iter().all(|id| *id > 0),
            "Gaussians without an object are removed"
        );
        let mut rest = scene.clone();
        let taken = take_transparent(&mut rest);
        assert_eq!(
            (rest.means, taken.means.as_slice()),
            (wall.means.clone(), &scene.means[wall.len()..])
        );
        *scene.object_ids.last_mut().unwrap() = 0;
        let all = scene.len();
        remove_unowned(&mut scene);
        assert_eq!(scene.len(), all - 1);
        remove_faint(&mut scene);
        assert_eq!(scene.means, wall.means);
    }
}
