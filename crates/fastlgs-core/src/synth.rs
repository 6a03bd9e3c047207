//! Generated scenes with exact poses, depths and instance masks: textured boxes in a room, ray-traced.

use crate::rng::Rng;
use crate::{Camera, Error, LabelMap, Result, exr_image, fs, image_io};
use glam::{Mat3, Vec2, Vec3};
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use serde_json::json;
use std::path::Path;

/// A box that stands on the floor and shows a picture on each side.
struct Block {
    name: &'static str,
    picture: RgbImage,
    centre: Vec3,
    half: Vec3,
    /// World to block.
    turn: Mat3,
}

/// A room with textured blocks.
pub struct Room {
    blocks: Vec<Block>,
    floor: RgbImage,
    walls: RgbImage,
}

/// Half extents of the room; the floor is y = 0, y up.
const ROOM: Vec3 = Vec3::new(5.0, 2.0, 5.0);

/// Pictures that the room needs, by file name: all of them ship with scikit-image.
pub const PICTURES: [(&str, &str); 4] =
    [("cat", "chelsea.png"), ("coffee", "coffee.png"), ("rocket", "rocket.jpg"), ("astronaut", "astronaut.png")];
/// Textures of floor and walls.
pub const TEXTURES: [&str; 2] = ["gravel.png", "brick.png"];

/// One exact view.
pub struct View {
    /// Colours.
    pub photo: RgbImage,
    /// Instance of each pixel: 0 is the room, block k is k + 1.
    pub instances: LabelMap,
    /// Distance along the viewing axis.
    pub depth: Vec<f32>,
}

impl Room {
    /// Places the blocks on a ring, turned at random.
    ///
    /// # Errors
    /// When a picture is missing from `pictures`.
    pub fn new(pictures: &Path, seed: u64) -> Result<Self> {
        let load = |file: &str| {
            let path = pictures.join(file);
            if !path.is_file() {
                return Err(Error::Invalid(format!("{}: the picture is missing; run 'fastlgs models install-offline'", path.display())));
            }
            image_io::load_rgb(&path)
        };
        let mut rng = Rng::new(seed, "synth room");
        let blocks = PICTURES.iter().enumerate().map(|(k, &(name, file))| {
            let angle = std::f32::consts::TAU * (k as f32 + 0.25 * rng.uniform()) / PICTURES.len() as f32;
            let picture = load(file)?;
            let aspect = picture.width() as f32 / picture.height() as f32;
            let height = rng.range(0.42, 0.55);
            let half = Vec3::new(height * aspect.min(1.3), height, height * aspect.min(1.3));
            let centre = Vec3::new(1.15 * angle.cos(), half.y, 1.15 * angle.sin());
            let turn = Mat3::from_rotation_y(rng.range(-0.6, 0.6) - angle);
            Ok(Block { name, picture, centre, half, turn })
        });
        Ok(Self { blocks: blocks.collect::<Result<_>>()?, floor: load(TEXTURES[0])?, walls: load(TEXTURES[1])? })
    }

    /// Names of the instances 1, 2, ...
    pub fn names(&self) -> Vec<&'static str> {
        self.blocks.iter().map(|b| b.name).collect()
    }

    /// `count` cameras on a wavy ring, looking at the middle.
    pub fn cameras(count: usize, width: u32, height: u32) -> Vec<Camera> {
        (0..count)
            .map(|k| {
                let angle = std::f32::consts::TAU * k as f32 / count as f32;
                let eye = Vec3::new(3.4 * angle.cos(), 1.5 + 0.35 * (3.0 * angle).sin(), 3.4 * angle.sin());
                Camera::look_at(&format!("{k:03}.png"), eye, Vec3::new(0.0, 0.35, 0.0), Vec3::Y, width, height, 0.85)
            })
            .collect()
    }

    /// Renders a view with `samples` x `samples` rays a pixel; instance and depth are those of the centre ray.
    pub fn render(&self, camera: &Camera, samples: u32) -> View {
        let to_world = Mat3::from_mat4(camera.world_to_camera).transpose();
        let (eye, w) = (camera.centre(), camera.width);
        let trace = |pixel: Vec2| self.trace(eye, to_world * camera.ray(pixel));
        let pixels: Vec<_> = (0..w * camera.height)
            .into_par_iter()
            .map(|p| {
                let corner = Vec2::new((p % w) as f32, (p / w) as f32);
                let (instance, depth, _) = trace(corner + 0.5);
                let mut sum = Vec3::ZERO;
                for s in 0..samples * samples {
                    let offset = (Vec2::new((s % samples) as f32, (s / samples) as f32) + 0.5) / samples as f32;
                    sum += trace(corner + offset).2;
                }
                let color = sum / (samples * samples) as f32;
                (instance, depth, Rgb(color.to_array().map(|v| (v.clamp(0.0, 255.0) + 0.5) as u8)))
            })
            .collect();
        View {
            photo: RgbImage::from_fn(w, camera.height, |x, y| pixels[(y * w + x) as usize].2),
            instances: LabelMap { width: w, height: camera.height, labels: pixels.iter().map(|p| p.0).collect() },
            depth: pixels.iter().map(|p| p.1).collect(),
        }
    }

    /// Nearest hit of a ray whose direction has depth 1: instance, depth, colour (0..255).
    fn trace(&self, eye: Vec3, direction: Vec3) -> (u16, f32, Vec3) {
        let (t, normal) = slab(eye - Vec3::Y * ROOM.y, direction, ROOM).1;
        let hit = eye + t * direction;
        let color = if normal.y > 0.5 {
            sample(&self.floor, hit.x * 0.5, hit.z * 0.5)
        } else if normal.y < -0.5 {
            Vec3::new(225.0, 222.0, 214.0)
        } else {
            let along = if normal.x.abs() > 0.5 { hit.z } else { hit.x };
            sample(&self.walls, along * 0.4, -hit.y * 0.4) * Vec3::new(1.0, 0.9, 0.82)
        };
        let mut best = (0u16, t, color * (0.75 + 0.25 * normal.y.abs()));
        for (k, block) in self.blocks.iter().enumerate() {
            let (o, d) = (block.turn * (eye - block.centre), block.turn * direction);
            let ((t, normal), (exit, _)) = slab(o, d, block.half);
            if t > 0.0 && t < exit && t < best.1 {
                let p = (o + t * d) / block.half;
                let (u, v) = if normal.x.abs() > 0.5 { (-p.z * normal.x, p.y) } else { (p.x * normal.z, p.y) };
                let (u, v) = if normal.y.abs() > 0.5 { (p.x, p.z) } else { (u, v) };
                let texture = sample(&block.picture, 0.5 + 0.5 * u, 0.5 - 0.5 * v);
                let world_normal = block.turn.transpose() * normal;
                let light = 0.82 + 0.18 * world_normal.dot(Vec3::new(0.4, 0.8, 0.3).normalize());
                best = (k as u16 + 1, t, texture * light);
            }
        }
        best
    }
}

/// Entry and exit of a ray through the box [-half, half]: distance and the normal that faces the ray.
fn slab(o: Vec3, d: Vec3, half: Vec3) -> ((f32, Vec3), (f32, Vec3)) {
    let (mut enter, mut exit) = ((f32::NEG_INFINITY, Vec3::ZERO), (f32::INFINITY, Vec3::ZERO));
    for k in 0..3 {
        let inverse = 1.0 / d[k];
        let (a, b) = ((-half[k] - o[k]) * inverse, (half[k] - o[k]) * inverse);
        let mut normal = Vec3::ZERO;
        normal[k] = -d[k].signum();
        if a.min(b) > enter.0 {
            enter = (a.min(b), normal);
        }
        if a.max(b) < exit.0 {
            exit = (a.max(b), normal);
        }
    }
    if enter.0 > exit.0 { ((f32::INFINITY, Vec3::ZERO), (f32::NEG_INFINITY, Vec3::ZERO)) } else { (enter, exit) }
}

/// Bilinear, repeating texture sample; (0, 0) is the upper left.
fn sample(picture: &RgbImage, u: f32, v: f32) -> Vec3 {
    let (w, h) = (picture.width(), picture.height());
    let (x, y) = (u.rem_euclid(1.0) * w as f32 - 0.5, v.rem_euclid(1.0) * h as f32 - 0.5);
    let at = |i: f32, j: f32| {
        let p = picture.get_pixel((i.max(0.0) as u32).min(w - 1), (j.max(0.0) as u32).min(h - 1));
        Vec3::from(p.0.map(f32::from))
    };
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    at(i, j).lerp(at(i + 1.0, j), fx).lerp(at(i, j + 1.0).lerp(at(i + 1.0, j + 1.0), fx), fy)
}

/// Writes PHOTOS: `images/`, `transforms.json`, `masks/` (16-bit instances), `depth/` (EXR) and `labels/` of every
/// `holdout`-th view.
///
/// # Errors
/// The system's refusal.
pub fn write(out: &Path, room: &Room, cameras: &[Camera], holdout: usize, mut done: impl FnMut()) -> Result<()> {
    let mut frames = Vec::new();
    for (index, camera) in cameras.iter().enumerate() {
        let view = room.render(camera, 2);
        let name = &camera.name;
        image_io::save_png(&out.join("images").join(name), view.photo.clone())?;
        view.instances.save(&out.join("masks").join(format!("{name}.png")))?;
        let depth = out.join("depth").join(format!("{name}.exr"));
        exr_image::write(&depth, camera.width as usize, camera.height as usize, &[("Z", &view.depth)])?;
        if crate::scene_folder::is_held_out(index, holdout) {
            write_labels(out, room, camera, &view.instances)?;
        }
        let flip = glam::Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
        let camera_to_world = (camera.world_to_camera.inverse() * flip).transpose().to_cols_array_2d();
        frames.push(json!({ "file_path": format!("images/{name}"), "transform_matrix": camera_to_world }));
        done();
    }
    let first = &cameras[0];
    let names: Vec<_> = room.names().into_iter().enumerate().map(|(k, n)| json!({ "instance": k + 1, "name": n })).collect();
    fs::write_json(&out.join("instances.json"), &names)?;
    // Written last: its presence says that the folder is whole.
    let transforms = json!({
        "fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height, "frames": frames,
    });
    fs::write_json(&out.join("transforms.json"), &transforms)
}

/// Exact labels in the LERF-OVS layout: one rectangle for each run of pixels in a row.
fn write_labels(out: &Path, room: &Room, camera: &Camera, instances: &LabelMap) -> Result<()> {
    let names = room.names();
    let mut objects = Vec::new();
    for y in 0..instances.height {
        let mut x = 0;
        while x < instances.width {
            let (id, start) = (instances.at(x, y), x);
            while x < instances.width && instances.at(x, y) == id {
                x += 1;
            }
            if id > 0 {
                let (x0, x1, y0, y1) = (start, x, y, y + 1);
                objects.push(json!({ "category": names[usize::from(id) - 1], "segmentation": [[x0, y0], [x1, y0], [x1, y1], [x0, y1]] }));
            }
        }
    }
    let stem = Path::new(&camera.name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let info = json!({ "name": camera.name, "width": camera.width, "height": camera.height });
    fs::write_json(&out.join("labels").join(format!("{stem}.json")), &json!({ "info": info, "objects": objects }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_enter_boxes_where_they_should() {
        let ((t, normal), (exit, _)) = slab(Vec3::new(-3.0, 0.1, 0.2), Vec3::X, Vec3::ONE);
        assert!((t - 2.0).abs() < 1e-5 && (exit - 4.0).abs() < 1e-5 && normal == Vec3::NEG_X);
        assert!(slab(Vec3::new(-3.0, 5.0, 0.0), Vec3::X, Vec3::ONE).0.0.is_infinite());
    }
}
