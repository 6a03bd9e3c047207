//! Low-dimensional codes: one lattice cell of side K^(-1/d) for each of K objects (paper, semantic
//! feature grid).

use fastlgs_core::rng::Rng;
use glam::{IVec3, Vec3};

/// Code dimension d.
const DIMENSION: u32 = 3;
/// Scale of the paper's distances: it compares codes on 0..255 instead of 0..1.
pub const SCALE: f32 = 255.0;

/// Returns the number of cells along each axis of the smallest cubic lattice with at least `count`
/// cells.
fn side(count: usize) -> i32 {
    (1i32..)
        .find(|s| s.pow(DIMENSION) as usize >= count)
        .unwrap_or(1)
}

/// Returns codes in (0, 1)^3 for the objects 1..=count: cell centres of the smallest cubic lattice
/// that holds them.
///
/// The order is random with `seed`. Consecutive objects are often neighbours in the picture; a
/// random order rarely gives them neighbouring codes.
pub fn lattice(count: usize, seed: u64) -> Vec<Vec3> {
    let side = side(count);
    let mut cells: Vec<IVec3> = (0..side.pow(DIMENSION))
        .map(|k| IVec3::new(k % side, k / side % side, k / side / side))
        .collect();
    Rng::new(seed, "codes").shuffle(&mut cells);
    cells
        .iter()
        .take(count)
        .map(|c| (c.as_vec3() + 0.5) / side as f32)
        .collect()
}

/// Returns the paper's Dis_gf: the Euclidean distance on the 0..255 scale.
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
