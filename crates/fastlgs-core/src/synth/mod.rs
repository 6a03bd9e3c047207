//! Generated scenes with exact poses, depths, instance masks and part trees, ray-traced from one seed.
//!
//! World axes: x and z along the floor y = 0, y up; units are about metres.

mod furniture;
mod hierarchy;
mod kinds;
mod props;
mod solid;
mod surface;
mod walks;
mod write;

pub use kinds::{KINDS, Kind, PICTURES, TEXTURES};
pub use write::{Masks, write};

use crate::{Camera, LabelMap};
use glam::{Mat3, Vec2, Vec3};
use hierarchy::Hierarchy;
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use solid::{Shape, Solid};
use surface::Surface;

/// Something with a name: an object, or a part of one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Thing {
    /// The text that names it; no two things of a world share one.
    pub name: String,
    /// The thing that it is a part of, by number; 0 for none.
    pub parent: u16,
}

/// Inside of a box in which everything stands.
struct Backdrop {
    half: Vec3,
    floor: Surface,
    walls: Surface,
    ceiling: Surface,
}

/// Everything that can be seen, and from where.
pub struct World {
    /// Things 1, 2, ...: the first is number 1.
    pub things: Vec<Thing>,
    /// The views, sorted by name.
    pub cameras: Vec<Camera>,
    /// Factor of each view's colours, per channel.
    exposures: Vec<Vec3>,
    solids: Vec<Solid>,
    tree: Hierarchy,
    backdrop: Backdrop,
}

/// One exact view.
pub struct View {
    /// Colours.
    pub photo: RgbImage,
    /// Smallest thing at each pixel by number; 0 is background.
    pub instances: LabelMap,
    /// Distance along the viewing axis.
    pub depth: Vec<f32>,
}

/// What a ray meets.
struct Hit {
    thing: u16,
    t: f32,
    color: Vec3,
}

/// Reflections and refractions that are followed.
const BOUNCES: u32 = 4;

/// Refractive index of glass.
const GLASS: f32 = 1.35;

impl World {
    /// Renders view `index` with `samples` x `samples` rays a pixel; instance and depth are those of the centre ray.
    pub fn render(&self, index: usize, samples: u32) -> View {
        let (camera, exposure) = (&self.cameras[index], self.exposures[index]);
        let to_world = Mat3::from_mat4(camera.world_to_camera).transpose();
        let (eye, w) = (camera.centre(), camera.width);
        // The direction's depth is 1, so that multiples of it are depths.
        let trace = |pixel: Vec2| self.trace(eye, to_world * camera.ray(pixel), BOUNCES);
        let pixels: Vec<_> = (0..w * camera.height)
            .into_par_iter()
            .map(|p| {
                let corner = Vec2::new((p % w) as f32, (p / w) as f32);
                let centre = trace(corner + 0.5);
                let mut sum = Vec3::ZERO;
                for s in 0..samples * samples {
                    let offset = (Vec2::new((s % samples) as f32, (s / samples) as f32) + 0.5) / samples as f32;
                    sum += trace(corner + offset).color;
                }
                let color = 255.0 * exposure * sum / (samples * samples) as f32;
                (centre.thing, centre.t, Rgb(color.to_array().map(|v| (v.clamp(0.0, 255.0) + 0.5) as u8)))
            })
            .collect();
        View {
            photo: RgbImage::from_fn(w, camera.height, |x, y| pixels[(y * w + x) as usize].2),
            instances: LabelMap { width: w, height: camera.height, labels: pixels.iter().map(|p| p.0).collect() },
            depth: pixels.iter().map(|p| p.1).collect(),
        }
    }

    /// Takes a thing and its parts away: the truth of what lay behind them. Numbers of things stay. Whether there was one of that name.
    pub fn remove(&mut self, name: &str) -> bool {
        let Some(number) = (1..).zip(&self.things).find(|(_, thing)| thing.name == name).map(|(number, _)| number) else { return false };
        self.solids.retain(|solid| !chain(&self.things, solid.thing).any(|id| id == number));
        self.tree = Hierarchy::new(&self.solids);
        true
    }

    /// Names of the things that are there: not of those that were taken away.
    pub fn names(&self) -> Vec<&str> {
        let there = |number: u16| self.solids.iter().any(|solid| chain(&self.things, solid.thing).any(|id| id == number));
        (1..).zip(&self.things).filter(|(number, _)| there(*number)).map(|(_, thing)| thing.name.as_str()).collect()
    }

    /// Nearest hit of a ray.
    fn trace(&self, origin: Vec3, direction: Vec3, bounces: u32) -> Hit {
        let Some((index, hit)) = self.tree.nearest(&self.solids, origin, direction) else { return self.backdrop.hit(origin, direction) };
        let solid = &self.solids[index];
        let point = origin + hit.t * direction;
        let color = match &solid.surface {
            _ if bounces == 0 => Vec3::splat(0.5),
            Surface::Mirror(tint) => *tint * self.trace(point, reflect(direction, hit.normal), bounces - 1).color,
            Surface::Glass(tint) => self.through_glass(solid, point, direction.normalize(), hit.normal, *tint, bounces - 1),
            surface => surface.color(hit.local, point, hit.normal) * light(hit.normal),
        };
        Hit { thing: solid.thing, t: hit.t, color }
    }

    /// Colour of glass: what it mirrors and what stands behind, by Schlick's approximation of Fresnel's law. Nothing stands in it.
    fn through_glass(&self, solid: &Solid, point: Vec3, direction: Vec3, normal: Vec3, tint: Vec3, bounces: u32) -> Vec3 {
        let facing = -direction.dot(normal);
        let straight = ((GLASS - 1.0) / (GLASS + 1.0)).powi(2);
        let mirrored = straight + (1.0 - straight) * (1.0 - facing.clamp(0.0, 1.0)).powi(5);
        let inside = refract(direction, normal, 1.0 / GLASS).unwrap_or(direction);
        let (exit, out) = match solid.hit(point, inside) {
            Some(exit) => (point + exit.t * inside, refract(inside, -exit.normal, GLASS).unwrap_or(inside)),
            None => (point, direction),
        };
        let behind = self.trace(exit, out, bounces).color;
        let before = self.trace(point, reflect(direction, normal), bounces).color;
        tint * behind.lerp(before, mirrored)
    }
}

impl Backdrop {
    fn hit(&self, origin: Vec3, direction: Vec3) -> Hit {
        let centre = Vec3::Y * self.half.y;
        let inside = Solid { shape: Shape::Block, centre, half: self.half, turn: Mat3::IDENTITY, surface: self.walls.clone(), thing: 0 };
        let Some([_, exit]) = inside.crossings(origin, direction) else {
            return Hit { thing: 0, t: f32::INFINITY, color: Vec3::ZERO };
        };
        let point = origin + exit.t * direction;
        let surface = match exit.normal.y {
            y if y < -0.5 => &self.floor,
            y if y > 0.5 => &self.ceiling,
            _ => &self.walls,
        };
        let shade = 0.75 + 0.25 * exit.normal.y.abs();
        Hit { thing: 0, t: exit.t, color: surface.color(point, point, exit.normal) * shade }
    }
}

/// A thing and all that contain it, from small to large.
fn chain(things: &[Thing], id: u16) -> impl Iterator<Item = u16> {
    let above = |id: &u16| Some(things[usize::from(*id) - 1].parent).filter(|p| *p > 0);
    std::iter::successors(Some(id).filter(|id| *id > 0), above)
}

/// Light from above and from the side; nothing is black.
fn light(normal: Vec3) -> f32 {
    0.82 + 0.18 * normal.dot(Vec3::new(0.4, 0.8, 0.3).normalize())
}

fn reflect(direction: Vec3, normal: Vec3) -> Vec3 {
    direction - 2.0 * direction.dot(normal) * normal
}

/// Snell's law for a unit direction; nothing at total reflection. `ratio` is the index before over the index behind the surface.
fn refract(direction: Vec3, normal: Vec3, ratio: f32) -> Option<Vec3> {
    let cosine = -direction.dot(normal);
    let rest = 1.0 - ratio * ratio * (1.0 - cosine * cosine);
    (rest >= 0.0).then(|| ratio * direction + (ratio * cosine - rest.sqrt()) * normal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_bends_by_snells_law() {
        let down = Vec3::new(0.6, -0.8, 0.0);
        let bent = refract(down, Vec3::Y, 1.0 / 1.5).expect("passes");
        assert!((bent.length() - 1.0).abs() < 1e-5 && (bent.x - 0.4).abs() < 1e-5, "sin 0.6 becomes 0.4: {bent}");
        assert!(refract(down, Vec3::Y, 2.0).is_none(), "total reflection");
        assert_eq!(reflect(down, Vec3::Y), Vec3::new(0.6, 0.8, 0.0));
    }

    /// A block before a mirror is seen twice, but only its own pixels are its instance.
    #[test]
    fn mirrors_and_depths() {
        let surface = Surface::Mirror(Vec3::ONE);
        let wall = Solid {
            shape: Shape::Block,
            centre: Vec3::new(0.0, 1.0, 3.0),
            half: Vec3::new(2.0, 1.0, 0.1),
            turn: Mat3::IDENTITY,
            surface,
            thing: 1,
        };
        let red = Surface::Grain { colors: [Vec3::X; 2], grain: 1.0 };
        let ball = Solid {
            shape: Shape::Ball,
            centre: Vec3::new(0.0, 1.0, -3.0),
            half: Vec3::splat(0.5),
            turn: Mat3::IDENTITY,
            surface: red,
            thing: 2,
        };
        let grey = || Surface::Grain { colors: [Vec3::splat(0.5); 2], grain: 1.0 };
        let solids = vec![wall, ball];
        let camera = Camera::look_at("0.png", Vec3::new(0.0, 1.0, 0.0), Vec3::new(0.0, 1.0, 3.0), Vec3::Y, 21, 21, 0.8);
        let world = World {
            things: Vec::new(),
            cameras: vec![camera],
            exposures: vec![Vec3::ONE],
            tree: Hierarchy::new(&solids),
            solids,
            backdrop: Backdrop { half: Vec3::splat(8.0), floor: grey(), walls: grey(), ceiling: grey() },
        };
        let view = world.render(0, 1);
        let middle = 10 * 21 + 10;
        assert_eq!(view.instances.labels[middle], 1);
        assert!((view.depth[middle] - 2.9).abs() < 1e-3);
        let color = view.photo.get_pixel(10, 10).0;
        assert!(color[0] > 150 && color[1] == 0, "the mirror shows the red ball behind the camera: {color:?}");
        assert!(!view.instances.labels.contains(&2));
    }
}
