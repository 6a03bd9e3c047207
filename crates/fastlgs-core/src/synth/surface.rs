//! What surfaces look like: pictures, grain, mirrors and glass.

use glam::Vec3;
use image::RgbImage;
use std::sync::Arc;

/// The look of a solid.
#[derive(Clone, Debug)]
pub enum Surface {
    /// Two colours (0..1) mixed by noise of `grain` bumps along the shape's half extent, so that there is something to match.
    Grain { colors: [Vec3; 2], grain: f32 },
    /// A football: around each corner of an icosahedron a black pentagon, and seams between white hexagons.
    Football,
    /// A picture on each side of a block.
    Picture(Arc<RgbImage>),
    /// A picture that repeats over the world's planes, with its tint and the times it repeats in a unit.
    Tiles { picture: Arc<RgbImage>, tint: Vec3, times: f32 },
    /// Reflects, with a tint.
    Mirror(Vec3),
    /// Reflects at grazing angles and bends light that passes, with a tint.
    Glass(Vec3),
}

impl Surface {
    /// A colour with faint grain.
    pub fn plain(color: Vec3) -> Self {
        Self::grained(color, 3.0)
    }

    /// A colour with marked grain.
    pub fn grained(color: Vec3, grain: f32) -> Self {
        Self::Grain { colors: [color * 0.55, (color * 1.15).min(Vec3::ONE)], grain }
    }

    /// Colour (0..1) at a point before light; `local` in the unstretched shape, `normal` and `world` in the world.
    pub fn color(&self, local: Vec3, world: Vec3, normal: Vec3) -> Vec3 {
        match self {
            Self::Grain { colors, grain } => {
                let noise = noise(local * *grain) * 0.6 + noise(local * *grain * 2.7 + 7.0) * 0.4;
                colors[0].lerp(colors[1], noise)
            }
            Self::Football => football(local.normalize_or_zero()),
            Self::Picture(picture) => {
                let p = local;
                // The face is the axis along which the point lies farthest out.
                let (u, v) = match p.abs() {
                    a if a.y >= a.x && a.y >= a.z => (p.x, p.z),
                    a if a.x >= a.z => (-p.z * p.x.signum(), p.y),
                    _ => (p.x * p.z.signum(), p.y),
                };
                sample(picture, 0.5 + 0.5 * u, 0.5 - 0.5 * v)
            }
            Self::Tiles { picture, tint, times } => {
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

/// Colour of a football in a direction from its middle.
fn football(direction: Vec3) -> Vec3 {
    let golden = 0.5 * (1.0 + 5f32.sqrt());
    let signs = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
    let around =
        |a: f32, b: f32| signs.map(|(s, t)| [Vec3::new(0.0, s * a, t * b), Vec3::new(s * a, t * b, 0.0), Vec3::new(t * b, 0.0, s * a)]);
    // Middles of the pentagons, and of the hexagons between three of them.
    let pentagons = around(1.0, golden);
    let hexagons = around(1.0 / golden, golden);
    let cubes = signs.map(|(s, t)| [Vec3::new(s, t, -1.0), Vec3::new(s, t, 1.0), Vec3::ZERO]);
    let mut near: Vec<f32> = [hexagons, cubes].concat().as_flattened().iter().map(|h| h.normalize_or_zero().dot(direction)).collect();
    near.sort_by(|a, b| b.total_cmp(a));
    let pentagon = pentagons.as_flattened().iter().map(|p| p.normalize().dot(direction)).fold(-1.0, f32::max);
    match (pentagon, near[0] - near[1]) {
        (pentagon, _) if pentagon > 0.94 => Vec3::splat(0.06),
        (_, seam) if seam < 0.012 => Vec3::splat(0.35),
        _ => Vec3::splat(0.94),
    }
}

/// Bilinear, repeating texture sample in 0..1; (0, 0) is the upper left.
fn sample(picture: &RgbImage, u: f32, v: f32) -> Vec3 {
    let (w, h) = (picture.width(), picture.height());
    let (x, y) = (u.rem_euclid(1.0) * w as f32 - 0.5, v.rem_euclid(1.0) * h as f32 - 0.5);
    let at = |i: f32, j: f32| {
        let p = picture.get_pixel((i.max(0.0) as u32).min(w - 1), (j.max(0.0) as u32).min(h - 1));
        Vec3::from(p.0.map(f32::from))
    };
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    at(i, j).lerp(at(i + 1.0, j), fx).lerp(at(i, j + 1.0).lerp(at(i + 1.0, j + 1.0), fx), fy) / 255.0
}

/// Smooth noise in 0..1, one bump a unit.
fn noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let f = f * f * (3.0 - 2.0 * f);
    let corner = |x: f32, y: f32, z: f32| {
        let [x, y, z] = (cell + Vec3::new(x, y, z)).to_array().map(|v| v as i32 as u32);
        // A cheap integer hash; only its look counts.
        let mut h = x.wrapping_mul(0x8da6_b343) ^ y.wrapping_mul(0xd816_3841) ^ z.wrapping_mul(0xcb1a_b31f);
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
        let values: Vec<f32> = (0..4000).map(|k| noise(Vec3::new(k as f32 * 0.01, 0.3, 0.7))).collect();
        assert!(values.windows(2).all(|w| (w[0] - w[1]).abs() < 0.03));
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(values.iter().any(|v| *v < 0.25) && values.iter().any(|v| *v > 0.75));
    }
}
