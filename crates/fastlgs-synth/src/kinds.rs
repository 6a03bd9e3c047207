//! The kinds of generated scenes. Most kinds contain one difficulty for reconstruction or
//! segmentation.

use super::furniture;
use super::hierarchy::Hierarchy;
use super::props::{self, BuildFn, Look, Piece};
use super::solid::{Shape, Solid};
use super::surface::Surface;
use super::walks::{CORE, CORRIDOR, Ring, corridor_path, turns, walk};
use super::{Backdrop, SceneObject, World};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Error, Result, image_io};
use glam::{Mat3, Vec3};
use std::f32::consts::{FRAC_PI_2, TAU};
use std::path::Path;
use std::sync::Arc;

/// Names of the room's objects and the files of their pictures. All pictures ship with
/// scikit-image.
pub const PICTURES: [(&str, &str); 4] = [
    ("cat", "chelsea.png"),
    ("coffee", "coffee.png"),
    ("rocket", "rocket.jpg"),
    ("astronaut", "astronaut.png"),
];
/// Textures of the room's floor and walls.
pub const TEXTURES: [&str; 2] = ["gravel.png", "brick.png"];

/// Kind of a generated scene; [`KINDS`] describes each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Kind {
    Room,
    Study,
    Bare,
    Table,
    Twins,
    Nested,
    Containers,
    Thin,
    Mirror,
    Glass,
    Dark,
    Sparse,
    Long,
    Big,
}

/// All kinds, each with its name and a description for users.
pub const KINDS: [(&str, Kind, &str); 14] = [
    (
        "room",
        Kind::Room,
        "four blocks with pictures of a cat, coffee, a rocket and an astronaut in a brick room",
    ),
    (
        "study",
        Kind::Study,
        "a furnished room: a table with small objects, a bookcase, a television and other furniture",
    ),
    (
        "bare",
        Kind::Bare,
        "a room with bare walls, photographed by a person who turns more than they move",
    ),
    ("table", Kind::Table, "twelve different objects on a table"),
    (
        "twins",
        Kind::Twins,
        "three pairs of identical objects, side by side",
    ),
    ("nested", Kind::Nested, "objects with parts that have parts"),
    (
        "containers",
        Kind::Containers,
        "cups on saucers, chests with drawers and bottles with labels",
    ),
    ("thin", Kind::Thin, "wires, spokes and leaves"),
    (
        "mirror",
        Kind::Mirror,
        "objects in front of a mirror, and a mirrored ball",
    ),
    (
        "glass",
        Kind::Glass,
        "objects behind a glass pane and a glass ball",
    ),
    (
        "dark",
        Kind::Dark,
        "the table with exposure and white balance that vary between views",
    ),
    (
        "sparse",
        Kind::Sparse,
        "the table, seen in only a few views (8 by default)",
    ),
    (
        "long",
        Kind::Long,
        "a walk along a corridor that forms a closed loop",
    ),
    ("big", Kind::Big, "a thousand objects"),
];

/// Colours of objects, by name.
const COLORS: [(&str, Vec3); 12] = [
    ("red", Vec3::new(0.85, 0.12, 0.12)),
    ("blue", Vec3::new(0.15, 0.3, 0.85)),
    ("green", Vec3::new(0.15, 0.6, 0.2)),
    ("yellow", Vec3::new(0.95, 0.85, 0.15)),
    ("purple", Vec3::new(0.5, 0.2, 0.65)),
    ("orange", Vec3::new(0.95, 0.5, 0.1)),
    ("white", Vec3::new(0.92, 0.92, 0.9)),
    ("pink", Vec3::new(0.95, 0.5, 0.65)),
    ("brown", Vec3::new(0.45, 0.28, 0.15)),
    ("turquoise", Vec3::new(0.2, 0.75, 0.7)),
    ("black", Vec3::new(0.1, 0.1, 0.12)),
    ("grey", Vec3::new(0.5, 0.5, 0.52)),
];

/// Height of the table top in metres.
const TABLE_HEIGHT: f32 = 0.75;

impl Kind {
    /// Returns the kind with a name.
    pub fn of(name: &str) -> Option<Self> {
        KINDS.iter().find(|k| k.0 == name).map(|k| k.1)
    }

    /// Returns the default number of photos.
    pub fn views(self) -> usize {
        match self {
            Self::Sparse => 8,
            Self::Long => 200,
            Self::Big | Self::Bare => 60,
            _ => 40,
        }
    }

    /// Builds the scene with `views` cameras of `size` (width, height) pixels. `pictures` is the
    /// folder with [`PICTURES`] and [`TEXTURES`]; only [`Kind::Room`] reads it.
    ///
    /// # Errors
    /// A picture is missing or damaged.
    pub fn world(
        self,
        pictures: &Path,
        views: usize,
        size: (u32, u32),
        seed: u64,
    ) -> Result<World> {
        let mut build = Builder::new(seed);
        let ring = Ring {
            radius: 2.9,
            height: 1.75,
            wave: 0.35,
            target: Vec3::Y * (TABLE_HEIGHT + 0.12),
            fov: 0.85,
        };
        let mut cameras = ring.cameras(views, size);
        let mut exposures = vec![Vec3::ONE; views];
        match self {
            Self::Room => return room(pictures, views, size, seed),
            Self::Study => {
                build.furnish(&furniture::study());
                let ring = Ring {
                    radius: 3.3,
                    height: 1.6,
                    wave: 0.3,
                    target: Vec3::Y * 0.65,
                    fov: 0.8,
                };
                cameras = ring.cameras(views, size);
            }
            Self::Bare => {
                build.bare_room();
                cameras = turns(views, size);
            }
            Self::Table | Self::Sparse => build.dozen(),
            Self::Dark => {
                build.dozen();
                exposures = (0..views).map(|k| drift(k as f32 / views as f32)).collect();
            }
            Self::Twins => build.twins(),
            Self::Nested => build.nested(),
            Self::Containers => build.containers(),
            Self::Thin => build.thin(),
            Self::Mirror => build.mirrors(),
            Self::Glass => build.glass(),
            Self::Long => {
                build.corridor();
                cameras = walk(views, size);
            }
            Self::Big => {
                build.thousand();
                let ring = Ring {
                    radius: 6.0,
                    height: 4.2,
                    wave: 0.5,
                    target: Vec3::ZERO,
                    fov: 0.9,
                };
                cameras = ring.cameras(views, size);
            }
        }
        let half = if self == Self::Long {
            CORRIDOR
        } else {
            Vec3::new(7.5, 3.0, 7.5)
        };
        let wall = |a: [f32; 3], b: [f32; 3], grain: f32| Surface::Grain {
            colors: [a.into(), b.into()],
            grain,
        };
        let backdrop = Backdrop {
            half_extents: half,
            floor: wall([0.35, 0.3, 0.25], [0.6, 0.53, 0.45], 3.0),
            walls: wall([0.5, 0.55, 0.6], [0.75, 0.78, 0.78], 1.6),
            ceiling: wall([0.8, 0.8, 0.78], [0.88, 0.88, 0.86], 1.0),
        };
        Ok(build.finish(cameras, exposures, backdrop))
    }
}

/// Returns the exposure factor of each channel at `along`, 0 to 1. Brightness falls from 1 to about
/// 1/3 and recovers twice; the colour changes from warm to cold once.
fn drift(along: f32) -> Vec3 {
    let level = 0.67 + 0.33 * (2.0 * TAU * along).cos();
    let warmth = 0.12 * (TAU * along).sin();
    Vec3::new(1.0 + warmth, 1.0, 1.0 - warmth) * level
}

/// Material of the pieces with the object's own colour.
#[derive(Clone, Copy)]
enum Material {
    Grain(Vec3),
    Mirror,
    Glass,
}

/// Builds a world object by object.
struct Builder {
    objects: Vec<SceneObject>,
    solids: Vec<Solid>,
    rng: Rng,
}

/// Position, scale and rotation of an object.
struct Place {
    at: Vec3,
    scale: f32,
    yaw: f32,
}

impl Builder {
    fn new(seed: u64) -> Self {
        Self {
            objects: Vec::new(),
            solids: Vec::new(),
            rng: Rng::new(seed, "synth things"),
        }
    }

    /// Returns the id of the object with a name and parent. Creates the object if it does not
    /// exist.
    fn object_id(&mut self, name: &str, parent: u16) -> u16 {
        let thing = SceneObject {
            name: name.to_owned(),
            parent,
        };
        let known = self.objects.iter().position(|t| *t == thing);
        let place = known.unwrap_or_else(|| {
            self.objects.push(thing);
            self.objects.len() - 1
        });
        place as u16 + 1
    }

    /// Adds an object. With `parts`, its parts become objects named "NAME's PART".
    fn add(
        &mut self,
        name: &str,
        pieces: Vec<Piece>,
        material: Material,
        place: &Place,
        parts: bool,
    ) {
        let whole = self.object_id(name, 0);
        let to_world = Mat3::from_rotation_y(place.yaw);
        for piece in pieces {
            let path = if parts { piece.part.as_slice() } else { &[] };
            let thing = path.iter().fold(whole, |parent, part| {
                self.object_id(&format!("{name}'s {part}"), parent)
            });
            let own = Mat3::from_rotation_z(piece.tilt[0]) * Mat3::from_rotation_x(piece.tilt[1]);
            let surface = match (piece.look, material) {
                (Look::Fixed(color), _) => Surface::plain(color),
                (Look::Painted(color), _) => Surface::Grain {
                    colors: [color * 0.93, (color * 1.03).min(Vec3::ONE)],
                    grain: 2.0,
                },
                (Look::Football, _) => Surface::Football,
                (Look::Own(factor), Material::Grain(color)) => {
                    Surface::grained(color * factor, 2.2)
                }
                (Look::Own(_), Material::Mirror) => Surface::Mirror(Vec3::splat(0.92)),
                (Look::Own(_), Material::Glass) => Surface::Glass(Vec3::new(0.9, 0.97, 0.95)),
            };
            self.solids.push(Solid {
                shape: piece.shape,
                centre: place.at + place.scale * (to_world * piece.centre),
                half: place.scale * piece.half,
                rotation: (to_world * own).transpose(),
                surface,
                object: thing,
            });
        }
    }

    fn table(&mut self) {
        let slab = |centre: Vec3, half: Vec3, thing: u16| Solid {
            shape: Shape::Block,
            centre,
            half,
            rotation: Mat3::IDENTITY,
            surface: Surface::Grain {
                colors: [Vec3::new(0.4, 0.25, 0.13), Vec3::new(0.66, 0.45, 0.26)],
                grain: 6.0,
            },
            object: thing,
        };
        let table = self.object_id("wooden table", 0);
        self.solids.push(slab(
            Vec3::Y * (TABLE_HEIGHT - 0.04),
            Vec3::new(1.35, 0.04, 1.35),
            table,
        ));
        for (x, z) in [(-1.2, -1.2), (-1.2, 1.2), (1.2, -1.2), (1.2, 1.2)] {
            self.solids.push(slab(
                Vec3::new(x, 0.5 * (TABLE_HEIGHT - 0.08), z),
                Vec3::new(0.06, 0.5 * (TABLE_HEIGHT - 0.08), 0.06),
                table,
            ));
        }
    }

    /// Returns a place on a circle on the table with a random rotation. `turn` is the position on
    /// the circle as a fraction of a full turn.
    fn on_table(&mut self, radius: f32, turn: f32, scale: f32) -> Place {
        let (s, c) = (TAU * turn).sin_cos();
        Place {
            at: Vec3::new(radius * c, TABLE_HEIGHT, radius * s),
            scale,
            yaw: self.rng.range(0.0, TAU),
        }
    }

    /// Adds each catalogue entry once, with random colours and positions.
    fn dozen(&mut self) {
        self.table();
        let mut colors = COLORS;
        self.rng.shuffle(&mut colors);
        let mut order: Vec<usize> = (0..props::CATALOGUE.len()).collect();
        self.rng.shuffle(&mut order);
        for (k, entry) in order.into_iter().enumerate() {
            let (name, make) = props::CATALOGUE[entry];
            let (color_name, color) = colors[entry];
            let place = if k < 4 {
                self.on_table(0.42, k as f32 / 4.0, 0.42)
            } else {
                self.on_table(1.02, k as f32 / 8.0, 0.42)
            };
            self.add(
                &format!("{color_name} {name}"),
                make(),
                Material::Grain(color),
                &place,
                false,
            );
        }
    }

    fn furnish(&mut self, furniture: &[furniture::Placed]) {
        for item in furniture {
            let place = Place {
                at: item.at.into(),
                scale: 1.0,
                yaw: item.yaw,
            };
            let material = Material::Grain(item.color);
            self.add(item.name, (item.make)(), material, &place, false);
        }
    }

    /// Adds a room whose floor, ceiling and walls are objects of one colour each, and its furniture.
    fn bare_room(&mut self) {
        const THICKNESS: f32 = 0.05;
        let half = furniture::BARE_ROOM;
        let sides = [
            ("floor", Vec3::NEG_Y, Vec3::new(0.55, 0.47, 0.4)),
            ("ceiling", Vec3::Y, Vec3::splat(0.95)),
            ("north wall", Vec3::NEG_Z, Vec3::new(0.9, 0.89, 0.86)),
            ("south wall", Vec3::Z, Vec3::new(0.9, 0.89, 0.86)),
            ("west wall", Vec3::NEG_X, Vec3::new(0.82, 0.84, 0.86)),
            ("east wall", Vec3::X, Vec3::new(0.82, 0.84, 0.86)),
        ];
        for (name, outwards, color) in sides {
            let object = self.object_id(name, 0);
            let across = outwards.abs();
            self.solids.push(Solid {
                shape: Shape::Block,
                centre: Vec3::Y * half.y + outwards * (half + THICKNESS),
                half: half * (Vec3::ONE - across) + THICKNESS * across,
                rotation: Mat3::IDENTITY,
                surface: Surface::Grain {
                    colors: [color; 2],
                    grain: 1.0,
                },
                object,
            });
        }
        self.furnish(&furniture::bare_room());
    }

    fn twins(&mut self) {
        self.table();
        let pairs: [(&str, BuildFn, usize, f32); 3] = [
            ("mug", props::mug, 0, 0.0),
            ("lamp", props::lamp, 1, 1.0),
            ("ball", || props::CATALOGUE[1].1(), 3, 2.0),
        ];
        for (name, make, color, third) in pairs {
            let (s, c) = (TAU * third / 3.0).sin_cos();
            for (twin, side) in [(1, -1.0), (2, 1.0)] {
                // The pair is side by side as seen from the centre of the table.
                let at = Vec3::new(
                    0.75 * c - side * 0.27 * s,
                    TABLE_HEIGHT,
                    0.75 * s + side * 0.27 * c,
                );
                let place = Place {
                    at,
                    scale: 0.5,
                    yaw: 0.0,
                };
                self.add(
                    &format!("{} {name} {twin}", COLORS[color].0),
                    make(),
                    Material::Grain(COLORS[color].1),
                    &place,
                    false,
                );
            }
        }
    }

    fn nested(&mut self) {
        let things: [(&str, BuildFn, usize); 6] = [
            ("cart", props::cart, 0),
            ("cabinet", props::cabinet, 8),
            ("lamp", props::lamp, 9),
            ("cart", props::cart, 1),
            ("cabinet", props::cabinet, 2),
            ("mug", props::mug, 5),
        ];
        self.with_parts(&things);
    }

    /// Adds six objects with named parts on a circle on the table.
    fn with_parts(&mut self, things: &[(&str, BuildFn, usize); 6]) {
        self.table();
        for (k, &(name, make, color)) in things.iter().enumerate() {
            let turn = k as f32 / 6.0;
            // Drawers face outwards.
            let place = Place {
                yaw: FRAC_PI_2 - TAU * turn,
                ..self.on_table(0.88, turn, 0.55)
            };
            self.add(
                &format!("{} {name}", COLORS[color].0),
                make(),
                Material::Grain(COLORS[color].1),
                &place,
                true,
            );
        }
    }

    fn containers(&mut self) {
        let things: [(&str, BuildFn, usize); 6] = [
            ("coffee set", props::cup_and_saucer, 0),
            ("chest", props::chest, 8),
            ("bottle", props::labelled_bottle, 2),
            ("tea set", props::cup_and_saucer, 1),
            ("trunk", props::chest, 4),
            ("flask", props::labelled_bottle, 5),
        ];
        self.with_parts(&things);
    }

    fn thin(&mut self) {
        self.table();
        let things: [(&str, BuildFn, usize); 6] = [
            ("wire cube", props::wire_frame, 0),
            ("spoked wheel", props::spoked_wheel, 11),
            ("plant", props::plant, 8),
            ("wire cube", props::wire_frame, 1),
            ("spoked wheel", props::spoked_wheel, 5),
            ("plant", props::plant, 4),
        ];
        for (k, (name, make, color)) in things.into_iter().enumerate() {
            let place = self.on_table(0.8, k as f32 / 6.0, 0.65);
            self.add(
                &format!("{} {name}", COLORS[color].0),
                make(),
                Material::Grain(COLORS[color].1),
                &place,
                false,
            );
        }
    }

    /// Adds these catalogue entries on the outer circle of the table. Entry `k` is at `k` eighths
    /// of the circle.
    fn around(&mut self, places: &[usize]) {
        self.table();
        for &k in places {
            let ((name, make), (color_name, color)) = (props::CATALOGUE[k], COLORS[k]);
            let place = self.on_table(0.95, k as f32 / 8.0, 0.45);
            self.add(
                &format!("{color_name} {name}"),
                make(),
                Material::Grain(color),
                &place,
                false,
            );
        }
    }

    fn mirrors(&mut self) {
        self.around(&[0, 1, 3, 4, 5, 7]);
        self.add(
            "mirror",
            props::slab(),
            Material::Mirror,
            &Place {
                at: Vec3::Y * TABLE_HEIGHT,
                scale: 0.75,
                yaw: 0.3,
            },
            false,
        );
        let place = self.on_table(0.95, 0.25, 0.5);
        self.add(
            "mirrored ball",
            props::CATALOGUE[1].1(),
            Material::Mirror,
            &place,
            false,
        );
    }

    fn glass(&mut self) {
        self.around(&[0, 1, 3, 4, 5, 7]);
        self.add(
            "glass pane",
            props::slab(),
            Material::Glass,
            &Place {
                at: Vec3::Y * TABLE_HEIGHT,
                scale: 0.75,
                yaw: 0.3,
            },
            false,
        );
        let place = self.on_table(0.95, 0.25, 0.5);
        self.add(
            "glass ball",
            props::CATALOGUE[1].1(),
            Material::Glass,
            &place,
            false,
        );
    }

    fn corridor(&mut self) {
        let walls = Surface::Grain {
            colors: [Vec3::new(0.6, 0.5, 0.4), Vec3::new(0.85, 0.76, 0.66)],
            grain: 9.0,
        };
        let centre = Vec3::Y * CORE.y;
        self.solids.push(Solid {
            shape: Shape::Block,
            centre,
            half: CORE,
            rotation: Mat3::IDENTITY,
            surface: walls,
            object: 0,
        });
        for k in 0..24 {
            let ((name, make), (color_name, color)) =
                (props::CATALOGUE[k % 12], COLORS[(k + k / 12 * 5) % 12]);
            let out = if k % 2 == 0 { 1.18 } else { 0.8 };
            let place = Place {
                at: corridor_path((k as f32 + 0.5) / 24.0) * out,
                scale: 0.75,
                yaw: self.rng.range(0.0, TAU),
            };
            self.add(
                &format!("{color_name} {name}"),
                make(),
                Material::Grain(color),
                &place,
                false,
            );
        }
    }

    fn thousand(&mut self) {
        for k in 0..1000 {
            let (name, make) = props::CATALOGUE[self.rng.below(12)];
            let (color_name, color) = COLORS[self.rng.below(12)];
            let at = Vec3::new((k % 40) as f32 - 19.5, 0.0, (k / 40) as f32 - 12.0)
                * Vec3::new(0.25, 0.0, 0.3);
            let jitter = Vec3::new(
                self.rng.range(-0.02, 0.02),
                0.0,
                self.rng.range(-0.04, 0.04),
            );
            let place = Place {
                at: at + jitter,
                scale: self.rng.range(0.17, 0.21),
                yaw: self.rng.range(0.0, TAU),
            };
            self.add(
                &format!("{color_name} {name} {}", k + 1),
                make(),
                Material::Grain(color),
                &place,
                false,
            );
        }
    }

    fn finish(self, cameras: Vec<Camera>, exposures: Vec<Vec3>, backdrop: Backdrop) -> World {
        World {
            tree: Hierarchy::new(&self.solids),
            objects: self.objects,
            cameras,
            exposures,
            solids: self.solids,
            backdrop,
        }
    }
}

/// Builds the room: textured blocks on a circle, with random rotations.
fn room(pictures: &Path, views: usize, size: (u32, u32), seed: u64) -> Result<World> {
    let load = |file: &str| {
        let path = pictures.join(file);
        if !path.is_file() {
            return Err(Error::Invalid(format!(
                "{}: the picture is missing; run 'fastlgs models install-offline'",
                path.display()
            )));
        }
        Ok(Arc::new(image_io::load_rgb(&path)?))
    };
    let mut rng = Rng::new(seed, "synth room");
    let mut build = Builder::new(seed);
    for (k, (name, file)) in PICTURES.into_iter().enumerate() {
        let angle = TAU * (k as f32 + 0.25 * rng.uniform()) / PICTURES.len() as f32;
        let picture = load(file)?;
        let aspect = picture.width() as f32 / picture.height() as f32;
        let height = rng.range(0.42, 0.55);
        let half = Vec3::new(height * aspect.min(1.3), height, height * aspect.min(1.3));
        let centre = Vec3::new(1.15 * angle.cos(), half.y, 1.15 * angle.sin());
        let turn = Mat3::from_rotation_y(rng.range(-0.6, 0.6) - angle);
        let thing = build.object_id(name, 0);
        build.solids.push(Solid {
            shape: Shape::Block,
            centre,
            half,
            rotation: turn,
            surface: Surface::Picture(picture),
            object: thing,
        });
    }
    let [floor, walls] = TEXTURES;
    let backdrop = Backdrop {
        half_extents: Vec3::new(5.0, 2.0, 5.0),
        floor: Surface::Tiles {
            picture: load(floor)?,
            tint: Vec3::ONE,
            repeats_per_unit: 0.5,
        },
        walls: Surface::Tiles {
            picture: load(walls)?,
            tint: Vec3::new(1.0, 0.9, 0.82),
            repeats_per_unit: 0.4,
        },
        ceiling: Surface::Grain {
            colors: [Vec3::new(0.882, 0.871, 0.839); 2],
            grain: 1.0,
        },
    };
    let ring = Ring {
        radius: 3.4,
        height: 1.5,
        wave: 0.35,
        target: Vec3::new(0.0, 0.35, 0.0),
        fov: 0.85,
    };
    Ok(build.finish(ring.cameras(views, size), vec![Vec3::ONE; views], backdrop))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nearly every object is visible in some view, and names are unique.
    #[test]
    fn nearly_all_objects_are_visible_and_names_are_unique() {
        for (name, kind, _) in KINDS.into_iter().filter(|k| k.1 != Kind::Room) {
            let views = if kind == Kind::Long { 40 } else { 6 };
            let size = if kind == Kind::Big {
                (320, 240)
            } else {
                (120, 90)
            };
            let world = kind.world(Path::new(""), views, size, 0).expect("a world");
            let names: std::collections::BTreeSet<&str> =
                world.objects.iter().map(|t| t.name.as_str()).collect();
            assert_eq!(names.len(), world.objects.len(), "{name}");
            let mut seen = vec![false; world.objects.len() + 1];
            for view in 0..views {
                let view = world.render(view, 1);
                view.instances
                    .labels
                    .iter()
                    .for_each(|l| seen[usize::from(*l)] = true);
                assert!(
                    view.depth.iter().all(|d| *d > 0.0 && d.is_finite()),
                    "{name}"
                );
            }
            // An object with parts is visible through its parts. With few views, other objects hide
            // some of the smallest ones.
            let hidden = (1..seen.len())
                .filter(|&k| !seen[k] && !world.objects.iter().any(|t| usize::from(t.parent) == k))
                .count();
            assert!(
                hidden * 10 <= world.objects.len(),
                "{name}: {hidden} of {} objects are not visible in any view",
                world.objects.len()
            );
        }
    }

    #[test]
    fn the_same_seed_makes_the_same_photo() {
        let photo = |seed| {
            Kind::Table
                .world(Path::new(""), 3, (60, 45), seed)
                .expect("a world")
                .render(1, 2)
                .photo
        };
        assert_eq!(photo(4), photo(4));
        assert_ne!(photo(4), photo(5));
    }
}
