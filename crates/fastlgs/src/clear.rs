//! Things that photos see through become objects as well: clear Gaussians, which show nothing, stand where masks say that such things are.

use crate::objects::{self, Config, Mapped};
use crate::{Result, Run};
use fastlgs_core::gaussians::{CLEAR, sigmoid};
use fastlgs_core::{Camera, Gaussians, SceneFolder};
use fastlgs_grid::hull::{self, Hull, Outline};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, View};
use std::collections::BTreeMap;
use std::ops::Range;

/// Longer side of the pictures in which things are looked for.
const SIDE: u32 = 480;
/// A clear Gaussian's logit of opacity.
const LOGIT: f32 = 1.25 * CLEAR;
/// Share of what passes through a pixel from which on nothing is seen there.
const NOTHING: f32 = 0.5;

/// How many clear Gaussians a scene has.
pub fn count(scene: &Gaussians) -> usize {
    scene.opacity_logits.iter().filter(|logit| **logit <= CLEAR).count()
}

/// Leaves out what shows nothing: earlier clear ones, and what faded.
pub fn forget(scene: &mut Gaussians) {
    let shows: Vec<usize> = (0..scene.len()).filter(|i| 255.0 * sigmoid(scene.opacity_logits[*i]) >= 1.0).collect();
    if shows.len() < scene.len() {
        *scene = scene.select(&shows);
    }
}

/// Puts clear Gaussians where masks that none of the objects found so far explain agree; returns the objects as they are found with these, and what they
/// are where there are none.
pub fn add(scene: &mut Gaussians, folder: &SceneFolder, training: &[Camera], mapped: Mapped, config: &Config, run: &Run) -> Result<Mapped> {
    let hulls = hulls(scene, folder, training, &mapped, config, run)?;
    if hulls.is_empty() {
        return Ok(mapped);
    }
    let shown = scene.len();
    let places: Vec<Range<usize>> = hulls.iter().map(|hull| put(scene, hull)).collect();
    let mut mapped = objects::map(scene, folder, training, config, run)?;
    let lists = mapped.chosen.lists();
    let lists: Vec<&[u16]> = scene.object_ids.iter().map(|id| lists[usize::from(*id)].as_slice()).collect();
    let own = places.into_iter().flat_map(|places| own(&lists, places));
    let kept: Vec<usize> = (0..shown).chain(own).collect();
    tracing::debug!(hulls = hulls.len(), put = scene.len() - shown, kept = kept.len() - shown, "clear Gaussians");
    if kept.len() < scene.len() {
        *scene = scene.select(&kept);
        mapped = objects::map(scene, folder, training, config, run)?;
    }
    Ok(mapped)
}

/// The hulls of what masks tell of and objects do not.
fn hulls(scene: &Gaussians, folder: &SceneFolder, training: &[Camera], mapped: &Mapped, config: &Config, run: &Run) -> Result<Vec<Hull>> {
    let (lists, mut inside) = (mapped.chosen.lists(), Vec::new());
    objects::render_maps(scene, training, &lists, config.antialias, run, |camera, shown| {
        let atoms = objects::atoms(folder, camera)?;
        inside.push(shrunk(camera, &hull::unexplained(&atoms, &shown, &lists, config.objects.min_support)));
        Ok(())
    })?;
    let telling = inside.iter().filter(|view| view.contains(&true)).count();
    if telling < config.objects.min_views {
        return Ok(Vec::new());
    }
    let mut engine = fastlgs_raster::open_engine(run.device)?;
    engine.set_state(&State::of(scene))?;
    let outline = |(camera, inside): (&Camera, Vec<bool>)| -> Result<Outline> {
        let camera = camera.shrunk_to(SIDE);
        let depth = depth(engine.as_mut(), scene, &camera, config.antialias)?;
        Ok(Outline { camera, inside, depth })
    };
    let views = training.iter().zip(inside).map(outline).collect::<Result<Vec<_>>>()?;
    Ok(hull::hulls(&views, config.objects.min_views))
}

/// The pixels of a view as a smaller picture of it has them.
fn shrunk(camera: &Camera, pixels: &[bool]) -> Vec<bool> {
    let small = camera.shrunk_to(SIDE);
    let at = |k: u32, from: u32, to: u32| ((2 * k + 1) * from / (2 * to)) as usize;
    let columns = |x| at(x, camera.width, small.width);
    let rows = (0..small.height).map(|y| camera.width as usize * at(y, camera.height, small.height));
    rows.flat_map(|row| (0..small.width).map(move |x| pixels[row + columns(x)])).collect()
}

/// Depth of what is seen at each pixel.
fn depth(engine: &mut dyn Engine, scene: &Gaussians, camera: &Camera, antialias: bool) -> Result<Vec<f32>> {
    let view = View { depth_as_feature: 1, antialias: u32::from(antialias), ..View::new(camera, scene.len(), 0) };
    let frame = engine.render(view, Channels::Feature)?;
    let of_pixel = |(z, through): (&f32, &f32)| if *through < NOTHING { z / (1.0 - through) } else { f32::INFINITY };
    Ok(frame.channels(3, 4).iter().zip(frame.channels(6, 7)).map(of_pixel).collect())
}

/// Adds the clear Gaussians of a thing; returns which they are.
fn put(scene: &mut Gaussians, hull: &Hull) -> Range<usize> {
    let first = scene.len();
    for place in &hull.places {
        scene.push_sphere(*place, 0.5 * hull.spacing, sigmoid(LOGIT), [0.5; 3]);
        scene.opacity_logits[scene.means.len() - 1] = LOGIT;
    }
    first..scene.len()
}

/// Those of a thing's places that lie in its object, if there is one: each holds most of the other. `lists` tells of each Gaussian's objects.
fn own(lists: &[&[u16]], places: Range<usize>) -> Vec<usize> {
    let mut held: BTreeMap<u16, usize> = BTreeMap::new();
    places.clone().flat_map(|place| lists[place]).for_each(|object| *held.entry(*object).or_default() += 1);
    let all = |object: u16| lists.iter().filter(|list| list.contains(&object)).count();
    let mutual = |(object, common): &(u16, usize)| 2 * common > places.len().max(all(*object));
    let object = held.into_iter().filter(mutual).max_by_key(|(_, common)| *common);
    object.map_or_else(Vec::new, |(object, _)| places.filter(|place| lists[*place].contains(&object)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};
    use glam::{Vec2, Vec3};

    /// Twelve cameras around a pane that is not there, on a sphere of solid Gaussians; masks have it.
    fn scene(folder: &SceneFolder) -> (Gaussians, Vec<Camera>) {
        let mut scene = Gaussians::default();
        for k in 0..4000 {
            let (turn, y) = (2.399_963 * k as f32, 1.0 - (2 * k + 1) as f32 / 4000.0);
            let around = (1.0 - y * y).sqrt() * Vec2::from_angle(turn);
            scene.push_sphere(5.0 * Vec3::new(around.x, y, around.y), 0.2, 0.95, [0.5; 3]);
        }
        let cameras = (0..12).map(|k| {
            let around = 3.0 * Vec2::from_angle(std::f32::consts::TAU * k as f32 / 12.0);
            Camera::look_at(&format!("{k:02}.png"), Vec3::new(around.x, 0.4, around.y), Vec3::ZERO, Vec3::Y, 160, 120, 0.8)
        });
        let cameras: Vec<Camera> = cameras.collect();
        for camera in &cameras {
            let half = Vec3::new(0.5, 0.5, 0.05);
            let to_world = camera.world_to_camera.inverse();
            let pane = RunLengths::of(160, 120, |x, y| {
                let direction = to_world.transform_vector3(camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)));
                let [a, b] = [-half, half].map(|corner| (corner - camera.centre()) / direction);
                a.min(b).max_element() < a.max(b).min_element()
            });
            MaskList { masks: vec![Mask::new(Level::Whole, pane)], ..MaskList::new(160, 120) }
                .save(&folder.masks_path(&camera.name))
                .unwrap();
        }
        (scene, cameras)
    }

    #[test]
    fn a_pane_that_shows_nothing_becomes_an_object() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let (mut scene, cameras) = scene(&folder);
        let (wall, config) = (scene.clone(), Config { objects: fastlgs_grid::objects::Config::default(), antialias: false });
        let run = Run { seed: 0, device: "cpu", progress: &Silent };
        let mapped = objects::map(&mut scene, &folder, &cameras, &config, &run).unwrap();
        assert!(mapped.chosen.support.is_empty(), "the wall is seen in each mask, and none of it in most");
        let mapped = add(&mut scene, &folder, &cameras, mapped, &config, &run).unwrap();
        let supports: Vec<f32> = mapped.chosen.support.iter().map(|support| support.iou).collect();
        assert!(supports.len() == 1 && supports[0] > 0.7, "{supports:?}");
        assert_eq!(scene.means[..wall.len()], wall.means);
        assert!(scene.len() > wall.len() && count(&scene) == scene.len() - wall.len());
        assert!(scene.object_ids[wall.len()..].iter().all(|id| *id > 0), "what belongs to nothing is left out");
        forget(&mut scene);
        assert_eq!(scene.means, wall.means);
    }
}
