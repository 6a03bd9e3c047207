//! Appearance of surfaces: grain, pictures, mirrors and glass.

use glam::Vec3;
use image::RgbImage;
use std::sync::Arc;

/// Appearance of a solid.
#[derive(Clone, Debug)]
pub enum Surface {
    /// Two colours (0 to 1) mixed by noise, so that surfaces have detail to match. `grain` is the
    /// number of noise cells along the half extent of the shape.
    Grain { colors: [Vec3; 2], grain: f32 },
    /// A football: black pentagons at the corners of an icosahedron, and white hexagons with seams
    /// between them.
    Football,
    /// A picture on each face of a block.
    Picture(Arc<RgbImage>),
    /// A repeating picture on axis-aligned planes of the world. `tint` is a factor on its colours;
    /// `repeats_per_unit` is the number of repetitions in one world unit.
    Tiles {
        picture: Arc<RgbImage>,
        tint: Vec3,
        repeats_per_unit: f32,
    },
    /// A mirror with a tint.
    Mirror(Vec3),
    /// Tinted glass: it refracts light and reflects more at grazing angles.
    Glass(Vec3),
}

impl Surface {
    /// Creates a surface of one colour with 3 noise cells along the half extent.
    pub fn plain(color: Vec3) -> Self {
        Self::grained(color, 3.0)
    }

    /// Creates a surface with shades of one colour (0.55 to 1.15 times) and `grain` noise cells
    /// along the half extent.
    pub fn grained(color: Vec3, grain: f32) -> Self {
        Self::Grain {
            colors: [color * 0.55, (color * 1.15).min(Vec3::ONE)],
            grain,
        }
    }

    /// Returns the unlit colour (0 to 1) at a point. `local` is the point in the coordinates of the
    /// unscaled shape; `world` and `normal` are in the world.
    pub fn color(&self, local: Vec3, world: Vec3, normal: Vec3) -> Vec3 {
        match self {
            Self::Grain { colors, grain } => {
                let noise = noise(local * *grain) * 0.6 + noise(local * *grain * 2.7 + 7.0) * 0.4;
                colors[0].lerp(colors[1], noise)
            }
            Self::Football => football(local.normalize_or_zero()),
            Self::Picture(picture) => {
                let p = local;
                // The largest coordinate determines the face of the block.
                let (u, v) = match p.abs() {
                    a if a.y >= a.x && a.y >= a.z => (p.x, p.z),
                    a if a.x >= a.z => (-p.z * p.x.signum(), p.y),
                    _ => (p.x * p.z.signum(), p.y),
                };
                sample(picture, 0.5 + 0.5 * u, 0.5 - 0.5 * v)
            }
            Self::Tiles {
                picture,
                tint,
                repeats_per_unit: times,
            } => {
                let (u, v) = if normal.y.abs() > 0.5 {
                    (world.x, world.z)
                } else if normal.x.abs() > 0.5 {
                    (world.z, -world.y)
                } else {
                    (world.x, -world.y)
                };
                sample(picture, u * times, v * times) * *tint
            }
            Self::Mirror(tint) | Self::Glass(tint) => *tint,
        }
    }
}

/// Returns the colour of a football in a direction from its centre.
fn football(direction: Vec3) -> Vec3 {
    let golden = 0.5 * (1.0 + 5f32.sqrt());
    let signs = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
    let around = |a: f32, b: f32| {
        signs.map(|(s, t)| {
            [
                Vec3::new(0.0, s * a, t * b),
                Vec3::new(s * a, t * b, 0.0),
                Vec3::new(t * b, 0.0, s * a),
            ]
        })
    };
    // Centres of the 12 pentagons and of the 20 hexagons.
    let pentagons = around(1.0, golden);
    let hexagons = around(1.0 / golden, golden);
    let cubes = signs.map(|(s, t)| [Vec3::new(s, t, -1.0), Vec3::new(s, t, 1.0), Vec3::ZERO]);
    let mut near: Vec<f32> = [hexagons, cubes]
        .concat()
        .as_flattened()
        .iter()
        .map(|h| h.normalize_or_zero().dot(direction))
        .collect();
    near.sort_by(|a, b| b.total_cmp(a));
    let pentagon = pentagons
        .as_flattened()
        .iter()
        .map(|p| p.normalize().dot(direction))
        .fold(-1.0, f32::max);
    match (pentagon, near[0] - near[1]) {
        (pentagon, _) if pentagon > 0.94 => Vec3::splat(0.06),
        (_, seam) if seam < 0.012 => Vec3::splat(0.35),
        _ => Vec3::splat(0.94),
    }
}

/// Samples a repeating texture with bilinear interpolation. (u, v) = (0, 0) is the upper left
/// corner, (1, 1) the lower right. Returns a colour in 0 to 1.
fn sample(picture: &RgbImage, u: f32, v: f32) -> Vec3 {
    let (w, h) = (picture.width(), picture.height());
    let (x, y) = (
        u.rem_euclid(1.0) * w as f32 - 0.5,
        v.rem_euclid(1.0) * h as f32 - 0.5,
    );
    let at = |i: f32, j: f32| {
        let p = picture.get_pixel(
            (i.max(0.0) as u32).min(w - 1),
            (j.max(0.0) as u32).min(h - 1),
        );
        Vec3::from(p.0.map(f32::from))
    };
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    at(i, j)
        .lerp(at(i + 1.0, j), fx)
        .lerp(at(i, j + 1.0).lerp(at(i + 1.0, j + 1.0), fx), fy)
        / 255.0
}

/// Returns smooth value noise in 0 to 1 with one lattice cell per unit.
fn noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let f = f * f * (3.0 - 2.0 * f);
    let corner = |x: f32, y: f32, z: f32| {
        let [x, y, z] = (cell + Vec3::new(x, y, z))
            .to_array()
            .map(|v| v as i32 as u32);
        // A simple integer hash. Its statistical quality does not matter.
        let mut h =
            x.wrapping_mul(0x8da6_b343) ^ y.wrapping_mul(0xd816_3841) ^ z.wrapping_mul(0xcb1a_b31f);
        h = (h ^ (h >> 13)).wrapping_mul(0x5bd1_e995);
        (h ^ (h >> 15)) as f32 / u32::MAX as f32
    };
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let face = |z: f32| {
        let row = |y: f32| mix(corner(0.0, y, z), corner(1.0, y, z), f.x);
        mix(row(0.0), row(1.0), f.y)
    };
    mix(face(0.0), face(1.0), f.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_and_fills_its_range() {
        let values: Vec<f32> = (0..4000)
            .map(|k| noise(Vec3::new(k as f32 * 0.01, 0.3, 0.7)))
            .collect();
        assert!(values.windows(2).all(|w| (w[0] - w[1]).abs() < 0.03));
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(values.iter().any(|v| *v < 0.25) && values.iter().any(|v| *v > 0.75));
    }
}
