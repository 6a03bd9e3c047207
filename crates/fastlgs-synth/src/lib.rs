//! Generates scenes with exact poses, depths, instance masks and part trees by ray tracing. A seed
//! determines the scene.
//!
//! World axes: x and z span the floor y = 0, y points up. Units are about metres.

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

use fastlgs_core::{Camera, LabelMap};
use glam::{Mat3, Vec2, Vec3};
use hierarchy::Hierarchy;
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use solid::{Shape, Solid};
use surface::Surface;

/// An object or a part of one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneObject {
    /// Name, unique in its world.
    pub name: String,
    /// Id of the object that contains it; 0 for none.
    pub parent: u16,
}

/// The inside of a box that encloses the scene.
struct Backdrop {
    half_extents: Vec3,
    floor: Surface,
    walls: Surface,
    ceiling: Surface,
}

/// A generated scene with its cameras.
pub struct World {
    /// Objects and parts. The id of an object is its index plus 1.
    pub objects: Vec<SceneObject>,
    /// The views, sorted by name.
    pub cameras: Vec<Camera>,
    /// Exposure factor of each view, for each channel.
    exposures: Vec<Vec3>,
    solids: Vec<Solid>,
    tree: Hierarchy,
    backdrop: Backdrop,
}

/// An exact rendering of one view.
pub struct View {
    /// Rendered image.
    pub photo: RgbImage,
    /// Id of the smallest object or part at each pixel; 0 for the background.
    pub instances: LabelMap,
    /// Depth of each pixel: distance along the viewing axis.
    pub depth: Vec<f32>,
}

/// Nearest hit of a ray.
struct Hit {
    thing: u16,
    t: f32,
    color: Vec3,
}

/// Largest number of reflections and refractions that are traced.
const BOUNCES: u32 = 4;

/// Refractive index of glass.
const GLASS: f32 = 1.35;

impl World {
    /// Renders view `index` with `samples` x `samples` rays for each pixel. Object ids and depth
    /// are those of the ray through the pixel centre.
    pub fn render(&self, index: usize, samples: u32) -> View {
        let (camera, exposure) = (&self.cameras[index], self.exposures[index]);
        let to_world = Mat3::from_mat4(camera.world_to_camera).transpose();
        let (eye, w) = (camera.centre(), camera.width);
        // The direction has a depth of 1 in the camera, so the ray parameter t is the depth.
        let trace = |pixel: Vec2| self.trace(eye, to_world * camera.ray(pixel), BOUNCES);
        let pixels: Vec<_> = (0..w * camera.height)
            .into_par_iter()
            .map(|p| {
                let corner = Vec2::new((p % w) as f32, (p / w) as f32);
                let centre = trace(corner + 0.5);
                let mut sum = Vec3::ZERO;
                for s in 0..samples * samples {
                    let offset = (Vec2::new((s % samples) as f32, (s / samples) as f32) + 0.5)
                        / samples as f32;
                    sum += trace(corner + offset).color;
                }
                let color = 255.0 * exposure * sum / (samples * samples) as f32;
                (
                    centre.thing,
                    centre.t,
                    Rgb(color.to_array().map(|v| (v.clamp(0.0, 255.0) + 0.5) as u8)),
                )
            })
            .collect();
        View {
            photo: RgbImage::from_fn(w, camera.height, |x, y| pixels[(y * w + x) as usize].2),
            instances: LabelMap {
                width: w,
                height: camera.height,
                labels: pixels.iter().map(|p| p.0).collect(),
            },
            depth: pixels.iter().map(|p| p.1).collect(),
        }
    }

    /// Removes an object and its parts, to render what they hide. Ids of other objects do not
    /// change. Returns whether the object exists.
    pub fn remove(&mut self, name: &str) -> bool {
        let Some(number) = (1..)
            .zip(&self.objects)
            .find(|(_, thing)| thing.name == name)
            .map(|(number, _)| number)
        else {
            return false;
        };
        self.solids
            .retain(|solid| !containing_ids(&self.objects, solid.object).any(|id| id == number));
        self.tree = Hierarchy::new(&self.solids);
        true
    }

    /// Returns the names of all objects that have not been removed.
    pub fn names(&self) -> Vec<&str> {
        let there = |number: u16| {
            self.solids
                .iter()
                .any(|solid| containing_ids(&self.objects, solid.object).any(|id| id == number))
        };
        (1..)
            .zip(&self.objects)
            .filter(|(number, _)| there(*number))
            .map(|(_, thing)| thing.name.as_str())
            .collect()
    }

    /// Returns the nearest hit of a ray, with its shaded colour.
    fn trace(&self, origin: Vec3, direction: Vec3, bounces: u32) -> Hit {
        let Some((index, hit)) = self.tree.nearest(&self.solids, origin, direction) else {
            return self.backdrop.hit(origin, direction);
        };
        let solid = &self.solids[index];
        let point = origin + hit.t * direction;
        let color = match &solid.surface {
            _ if bounces == 0 => Vec3::splat(0.5),
            Surface::Mirror(tint) => {
                *tint
                    * self
                        .trace(point, reflect(direction, hit.normal), bounces - 1)
                        .color
            }
            Surface::Glass(tint) => self.through_glass(
                solid,
                point,
                direction.normalize(),
                hit.normal,
                *tint,
                bounces - 1,
            ),
            surface => surface.color(hit.local, point, hit.normal) * light(hit.normal),
        };
        Hit {
            thing: solid.object,
            t: hit.t,
            color,
        }
    }

    /// Returns the colour of glass: reflected and refracted light, mixed by Schlick's approximation
    /// of the Fresnel equations. Ignores solids inside the glass.
    fn through_glass(
        &self,
        solid: &Solid,
        point: Vec3,
        direction: Vec3,
        normal: Vec3,
        tint: Vec3,
        bounces: u32,
    ) -> Vec3 {
        let facing = -direction.dot(normal);
        let straight = ((GLASS - 1.0) / (GLASS + 1.0)).powi(2);
        let mirrored = straight + (1.0 - straight) * (1.0 - facing.clamp(0.0, 1.0)).powi(5);
        let inside = refract(direction, normal, 1.0 / GLASS).unwrap_or(direction);
        let (exit, out) = match solid.hit(point, inside) {
            Some(exit) => (
                point + exit.t * inside,
                refract(inside, -exit.normal, GLASS).unwrap_or(inside),
            ),
            None => (point, direction),
        };
        let behind = self.trace(exit, out, bounces).color;
        let before = self.trace(point, reflect(direction, normal), bounces).color;
        tint * behind.lerp(before, mirrored)
    }
}

impl Backdrop {
    fn hit(&self, origin: Vec3, direction: Vec3) -> Hit {
        let centre = Vec3::Y * self.half_extents.y;
        let inside = Solid {
            shape: Shape::Block,
            centre,
            half: self.half_extents,
            rotation: Mat3::IDENTITY,
            surface: self.walls.clone(),
            object: 0,
        };
        let Some([_, exit]) = inside.crossings(origin, direction) else {
            return Hit {
                thing: 0,
                t: f32::INFINITY,
                color: Vec3::ZERO,
            };
        };
        let point = origin + exit.t * direction;
        let surface = match exit.normal.y {
            y if y < -0.5 => &self.floor,
            y if y > 0.5 => &self.ceiling,
            _ => &self.walls,
        };
        let shade = 0.75 + 0.25 * exit.normal.y.abs();
        Hit {
            thing: 0,
            t: exit.t,
            color: surface.color(point, point, exit.normal) * shade,
        }
    }
}

/// Yields an object's id and the ids of all objects that contain it, from small to large.
fn containing_ids(things: &[SceneObject], id: u16) -> impl Iterator<Item = u16> {
    let above = |id: &u16| Some(things[usize::from(*id) - 1].parent).filter(|p| *p > 0);
    std::iter::successors(Some(id).filter(|id| *id > 0), above)
}

/// Returns the brightness of a surface under light from above and from the side, 0.64 to 1.
fn light(normal: Vec3) -> f32 {
    0.82 + 0.18 * normal.dot(Vec3::new(0.4, 0.8, 0.3).normalize())
}

fn reflect(direction: Vec3, normal: Vec3) -> Vec3 {
    direction - 2.0 * direction.dot(normal) * normal
}

/// Refracts a unit direction by Snell's law; `None` at total internal reflection. `ratio` is the
/// refractive index in front of the surface over the one behind it.
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
        assert!(
            (bent.length() - 1.0).abs() < 1e-5 && (bent.x - 0.4).abs() < 1e-5,
            "sin 0.6 becomes 0.4: {bent}"
        );
        assert!(refract(down, Vec3::Y, 2.0).is_none(), "total reflection");
        assert_eq!(reflect(down, Vec3::Y), Vec3::new(0.6, 0.8, 0.0));
    }

    /// A mirror shows the ball behind the camera, but its pixels have the id of the mirror.
    #[test]
    fn mirrors_and_depths() {
        let surface = Surface::Mirror(Vec3::ONE);
        let wall = Solid {
            shape: Shape::Block,
            centre: Vec3::new(0.0, 1.0, 3.0),
            half: Vec3::new(2.0, 1.0, 0.1),
            rotation: Mat3::IDENTITY,
            surface,
            object: 1,
        };
        let red = Surface::Grain {
            colors: [Vec3::X; 2],
            grain: 1.0,
        };
        let ball = Solid {
            shape: Shape::Ball,
            centre: Vec3::new(0.0, 1.0, -3.0),
            half: Vec3::splat(0.5),
            rotation: Mat3::IDENTITY,
            surface: red,
            object: 2,
        };
        let grey = || Surface::Grain {
            colors: [Vec3::splat(0.5); 2],
            grain: 1.0,
        };
        let solids = vec![wall, ball];
        let camera = Camera::look_at(
            "0.png",
            Vec3::new(0.0, 1.0, 0.0),
            Vec3::new(0.0, 1.0, 3.0),
            Vec3::Y,
            21,
            21,
            0.8,
        );
        let world = World {
            objects: Vec::new(),
            cameras: vec![camera],
            exposures: vec![Vec3::ONE],
            tree: Hierarchy::new(&solids),
            solids,
            backdrop: Backdrop {
                half_extents: Vec3::splat(8.0),
                floor: grey(),
                walls: grey(),
                ceiling: grey(),
            },
        };
        let view = world.render(0, 1);
        let middle = 10 * 21 + 10;
        assert_eq!(view.instances.labels[middle], 1);
        assert!((view.depth[middle] - 2.9).abs() < 1e-3);
        let color = view.photo.get_pixel(10, 10).0;
        assert!(
            color[0] > 150 && color[1] == 0,
            "the mirror shows the red ball behind the camera: {color:?}"
        );
        assert!(!view.instances.labels.contains(&2));
    }
}
