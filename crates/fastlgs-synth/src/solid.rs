//! Solids for ray tracing: balls, blocks, cylinders and cones, scaled and rotated.

use super::surface::Surface;
use glam::{Mat3, Vec3};

/// A shape with half extents of 1 around the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// The unit ball.
    Ball,
    /// The cube [-1, 1]^3.
    Block,
    /// Cylinder of radius 1 around the y axis, from y = -1 to 1.
    Cylinder,
    /// Cone around the y axis: radius 1 at y = -1, tip at y = 1.
    Cone,
}

/// A scaled and rotated shape in the world.
#[derive(Clone, Debug)]
pub struct Solid {
    /// Shape before scaling and rotation.
    pub shape: Shape,
    /// Centre in the world.
    pub centre: Vec3,
    /// Half extents along the solid's own axes.
    pub half: Vec3,
    /// Rotation from the world to the solid's own axes.
    pub rotation: Mat3,
    /// Appearance.
    pub surface: Surface,
    /// Id of the object that it belongs to; 0 for the background.
    pub object: u16,
}

/// A point where a ray crosses the surface of a solid.
#[derive(Clone, Copy, Debug)]
pub struct Crossing {
    /// Ray parameter: the point is origin + t * direction.
    pub t: f32,
    /// Outward unit normal in the world.
    pub normal: Vec3,
    /// The point in the coordinates of the unscaled shape.
    pub local: Vec3,
}

/// Smallest ray parameter of a hit, so that a ray does not hit the surface that it starts from.
const MIN_HIT_T: f32 = 1e-3;

impl Solid {
    /// Returns where a ray enters and leaves the solid, in this order; `None` if it misses. Both
    /// ray parameters may be negative.
    pub fn crossings(&self, origin: Vec3, direction: Vec3) -> Option<[Crossing; 2]> {
        let o = self.rotation * (origin - self.centre) / self.half;
        let d = self.rotation * direction / self.half;
        let pair = match self.shape {
            Shape::Block => block(o, d),
            Shape::Ball => {
                quadric(o, d, Vec3::ONE, Vec3::ZERO, -1.0).map(|ts| ts.map(|t| (t, o + t * d)))
            }
            Shape::Cylinder => between_planes(
                o,
                d,
                quadric(o, d, Vec3::new(1.0, 0.0, 1.0), Vec3::ZERO, -1.0),
                |p| Vec3::new(p.x, 0.0, p.z),
            ),
            // x^2 + z^2 = ((1 - y) / 2)^2
            Shape::Cone => {
                let sides = quadric(
                    o,
                    d,
                    Vec3::new(1.0, -0.25, 1.0),
                    Vec3::new(0.0, 0.5, 0.0),
                    -0.25,
                );
                cone(o, d, sides)
            }
        }?;
        let crossing = |(t, normal): (f32, Vec3)| {
            let world = (self.rotation.transpose() * (normal / self.half)).normalize_or_zero();
            Crossing {
                t,
                normal: world,
                local: o + t * d,
            }
        };
        Some(pair.map(crossing))
    }

    /// Returns the first crossing in front of the origin. It is the exit if the ray starts inside
    /// the solid.
    pub fn hit(&self, origin: Vec3, direction: Vec3) -> Option<Crossing> {
        self.crossings(origin, direction)?
            .into_iter()
            .find(|c| c.t > MIN_HIT_T)
    }

    /// Returns the minimum and maximum corner of the bounding box in the world.
    pub fn bounds(&self) -> [Vec3; 2] {
        let axes = self.rotation.transpose();
        let reach = axes.x_axis.abs() * self.half.x
            + axes.y_axis.abs() * self.half.y
            + axes.z_axis.abs() * self.half.z;
        [self.centre - reach, self.centre + reach]
    }
}

/// Returns entry and exit of the cube [-1, 1]^3, each with its ray parameter and outward normal.
fn block(o: Vec3, d: Vec3) -> Option<[(f32, Vec3); 2]> {
    let (mut enter, mut exit) = ((f32::NEG_INFINITY, Vec3::ZERO), (f32::INFINITY, Vec3::ZERO));
    for k in 0..3 {
        let (a, b) = ((-1.0 - o[k]) / d[k], (1.0 - o[k]) / d[k]);
        let mut normal = Vec3::ZERO;
        normal[k] = d[k].signum();
        if a.min(b) > enter.0 {
            enter = (a.min(b), -normal);
        }
        if a.max(b) < exit.0 {
            exit = (a.max(b), normal);
        }
    }
    (enter.0 < exit.0).then_some([enter, exit])
}

/// Returns both roots t of `weight . p^2 + slope . p + constant = 0` with `p = o + t d`, in
/// ascending order; `None` without real roots.
fn quadric(o: Vec3, d: Vec3, weight: Vec3, slope: Vec3, constant: f32) -> Option<[f32; 2]> {
    let a = (weight * d).dot(d);
    let b = 2.0 * (weight * o).dot(d) + slope.dot(d);
    let c = (weight * o).dot(o) + slope.dot(o) + constant;
    let root = b * b - 4.0 * a * c;
    if root < 0.0 || a == 0.0 {
        return None;
    }
    // The numerically stable form of the quadratic formula: it avoids cancellation.
    let q = -0.5 * (b + b.signum() * root.sqrt());
    let (s, t) = (q / a, c / q);
    Some([s.min(t), s.max(t)])
}

/// Returns the two crossings of a cylinder between the planes y = -1 and y = 1. `sides` are the
/// crossings of the infinite cylinder.
fn between_planes(
    o: Vec3,
    d: Vec3,
    sides: Option<[f32; 2]>,
    normal: impl Fn(Vec3) -> Vec3,
) -> Option<[(f32, Vec3); 2]> {
    let [low, high] = match sides {
        Some(ts) => ts,
        None if o.x * o.x + o.z * o.z < 1.0 => [f32::NEG_INFINITY, f32::INFINITY],
        None => return None,
    };
    let (a, b) = ((-1.0 - o.y) / d.y, (1.0 - o.y) / d.y);
    let side = |t: f32| (t, normal(o + t * d));
    let enter = if a.min(b) > low {
        (a.min(b), Vec3::Y * -d.y.signum())
    } else {
        side(low)
    };
    let exit = if a.max(b) < high {
        (a.max(b), Vec3::Y * d.y.signum())
    } else {
        side(high)
    };
    (enter.0 < exit.0).then_some([enter, exit])
}

/// Returns the two crossings of a cone. `sides` are the crossings of the infinite double cone; only
/// those between base and tip count.
fn cone(o: Vec3, d: Vec3, sides: Option<[f32; 2]>) -> Option<[(f32, Vec3); 2]> {
    let mut found: Vec<(f32, Vec3)> = Vec::with_capacity(3);
    for t in sides.into_iter().flatten() {
        let p = o + t * d;
        if (-1.0..1.0).contains(&p.y) {
            found.push((t, Vec3::new(p.x, 0.25 * (1.0 - p.y), p.z)));
        }
    }
    let t = (-1.0 - o.y) / d.y;
    let p = o + t * d;
    if p.x * p.x + p.z * p.z < 1.0 {
        found.push((t, Vec3::NEG_Y));
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn solid(shape: Shape) -> Solid {
        let surface = Surface::plain(Vec3::ONE);
        Solid {
            shape,
            centre: Vec3::new(1.0, 2.0, 3.0),
            half: Vec3::new(0.5, 1.0, 2.0),
            rotation: Mat3::IDENTITY,
            surface,
            object: 1,
        }
    }

    #[test]
    fn crossings_have_the_exact_distances() {
        // A ray along x through the centre: the half extent is 0.5. A cone has half its radius
        // there.
        for (shape, reach) in [
            (Shape::Ball, 0.5),
            (Shape::Block, 0.5),
            (Shape::Cylinder, 0.5),
            (Shape::Cone, 0.25),
        ] {
            let [enter, exit] = solid(shape)
                .crossings(Vec3::new(-3.0, 2.0, 3.0), Vec3::X)
                .expect("a hit");
            assert!(
                (enter.t - (4.0 - reach)).abs() < 1e-5 && (exit.t - (4.0 + reach)).abs() < 1e-5,
                "{shape:?} {enter:?} {exit:?}"
            );
            assert!(
                enter.normal.x < -0.5 && exit.normal.x > 0.5,
                "{shape:?} {enter:?}"
            );
            assert!(
                solid(shape)
                    .crossings(Vec3::new(-3.0, 5.0, 3.0), Vec3::X)
                    .is_none(),
                "{shape:?}"
            );
        }
        // A ray from above hits the tip of the cone and the top of the other shapes.
        for (shape, t) in [
            (Shape::Ball, 3.0),
            (Shape::Block, 3.0),
            (Shape::Cylinder, 3.0),
            (Shape::Cone, 3.0),
        ] {
            let hit = solid(shape)
                .hit(Vec3::new(1.001, 6.0, 3.0), Vec3::NEG_Y)
                .expect("a hit");
            assert!((hit.t - t).abs() < 0.02, "{shape:?} {hit:?}");
        }
        assert_eq!(
            solid(Shape::Block).bounds(),
            [Vec3::new(0.5, 1.0, 1.0), Vec3::new(1.5, 3.0, 5.0)]
        );
    }

    #[test]
    fn a_ray_that_starts_inside_hits_from_inside() {
        let hit = solid(Shape::Ball)
            .hit(Vec3::new(1.0, 2.0, 3.0), Vec3::Y)
            .expect("a hit");
        assert!((hit.t - 1.0).abs() < 1e-5 && hit.normal.y > 0.9);
    }
}
