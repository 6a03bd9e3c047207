//! Low-dimensional codes: one lattice cell of side K^(-1/d) for each object (paper, semantic feature grid).

use fastlgs_core::rng::Rng;
use glam::Vec3;

/// Code dimension d.
const DIMENSION: u32 = 3;
/// Scale of the paper's distances: codes in (0, 1) are compared on (0, 255).
pub const SCALE: f32 = 255.0;
/// Largest distance (on the 0..255 scale) at which a rendered feature belongs to a code (the paper's tau_ac).
pub const TAU_AC: f32 = 5.0;

/// Codes in (0, 1)^3 of objects 1..=count: centres of the cells of the smallest cubic lattice that holds them.
///
/// Cells are dealt out in seeded random order, so that objects found one after the other, which are often neighbours
/// in the picture, do not get neighbouring codes.
pub fn lattice(count: usize, seed: u64) -> Vec<Vec3> {
    let side = (1u32..).find(|s| s.pow(DIMENSION) as usize >= count).unwrap_or(1);
    let cell = |k: u32| Vec3::new((k % side) as f32, (k / side % side) as f32, (k / side / side) as f32);
    let mut cells: Vec<Vec3> = (0..side.pow(DIMENSION)).map(|k| (cell(k) + 0.5) / side as f32).collect();
    Rng::new(seed, "codes").shuffle(&mut cells);
    cells.truncate(count);
    cells
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
