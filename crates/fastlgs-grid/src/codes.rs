//! Low-dimensional codes: one lattice cell of side K^(-1/d) for each object (paper, semantic feature grid).

use fastlgs_core::rng::Rng;
use glam::{IVec3, Vec3};

/// Code dimension d.
const DIMENSION: u32 = 3;
/// Scale of the paper's distances: codes in (0, 1) are compared on (0, 255).
pub const SCALE: f32 = 255.0;

/// Cells along each side of the smallest cubic lattice that holds so many.
fn side(count: usize) -> i32 {
    (1i32..).find(|s| s.pow(DIMENSION) as usize >= count).unwrap_or(1)
}

/// Codes in (0, 1)^3 of objects 1..=count: centres of the cells of the smallest cubic lattice that holds them, dealt out in seeded random order, so
/// that objects found one after the other, which are often neighbours in the picture, do not get neighbouring codes.
pub fn lattice(count: usize, seed: u64) -> Vec<Vec3> {
    let side = side(count);
    let mut cells: Vec<IVec3> = (0..side.pow(DIMENSION)).map(|k| IVec3::new(k % side, k / side % side, k / side / side)).collect();
    Rng::new(seed, "codes").shuffle(&mut cells);
    cells.iter().take(count).map(|c| (c.as_vec3() + 0.5) / side as f32).collect()
}

/// The paper's Dis_gf: Euclidean distance on the 0..255 scale.
pub fn distance(feature: Vec3, code: Vec3) -> f32 {
    SCALE * feature.distance(code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_distinct_and_as_far_apart_as_the_lattice() {
        for count in [1, 8, 9, 100] {
            let codes = lattice(count, 1);
            assert_eq!(codes.len(), count);
            let side = (count as f32).cbrt().ceil();
            for (i, a) in codes.iter().enumerate() {
                assert!(a.min_element() > 0.0 && a.max_element() < 1.0);
                assert!(codes[..i].iter().all(|b| a.distance(*b) > 0.999 / side));
            }
        }
        assert_eq!(lattice(20, 7), lattice(20, 7));
    }
}
