//! Low-dimensional codes: one lattice cell of side K^(-1/d) for each object (paper, semantic feature grid).

use fastlgs_core::rng::Rng;
use glam::{IVec3, Vec3};
use std::collections::BTreeSet;

/// Code dimension d.
const DIMENSION: u32 = 3;
/// Scale of the paper's distances: codes in (0, 1) are compared on (0, 255).
pub const SCALE: f32 = 255.0;

/// Cells of the smallest cubic lattice that holds `count`, dealt out in seeded random order, so that objects found one after
/// the other, which are often neighbours in the picture, do not get neighbouring codes; and the lattice's side.
fn cells(count: usize, seed: u64) -> (Vec<IVec3>, i32) {
    let side = side(count);
    let mut cells: Vec<IVec3> = (0..side.pow(DIMENSION)).map(|k| IVec3::new(k % side, k / side % side, k / side / side)).collect();
    Rng::new(seed, "codes").shuffle(&mut cells);
    cells.truncate(count);
    (cells, side)
}

/// Cells along each side of the smallest cubic lattice that holds so many.
fn side(count: usize) -> i32 {
    (1i32..).find(|s| s.pow(DIMENSION) as usize >= count).unwrap_or(1)
}

fn centres(cells: &[IVec3], side: i32) -> Vec<Vec3> {
    cells.iter().map(|c| (c.as_vec3() + 0.5) / side as f32).collect()
}

/// Codes in (0, 1)^3 of objects 1..=count: centres of lattice cells.
pub fn lattice(count: usize, seed: u64) -> Vec<Vec3> {
    let (cells, side) = cells(count, seed);
    centres(&cells, side)
}

/// How far apart the codes of so many objects lie, on the 0..255 scale.
pub fn spacing(count: usize) -> f32 {
    SCALE / side(count) as f32
}

/// Rounds in which objects change their codes.
const ROUNDS: usize = 4;

/// As [`lattice`], but objects that touch in the pictures (`neighbours`, pairs of ids) get codes of which no blend comes near a
/// third object's: pixels at their border would show that one.
pub fn separated(count: usize, neighbours: &BTreeSet<(u16, u16)>, seed: u64) -> Vec<Vec3> {
    let (mut cells, side) = cells(count, seed);
    let taken: BTreeSet<[i32; 3]> = cells.iter().map(IVec3::to_array).collect();
    let mut near: Vec<Vec<usize>> = vec![Vec::new(); count];
    for (a, b) in neighbours.iter().map(|&(a, b)| (usize::from(a) - 1, usize::from(b) - 1)) {
        near[a].push(b);
        near[b].push(a);
    }
    // Exchanging two codes leaves the taken cells as they are, so only the pairs of those two objects change.
    let conflicts = |cells: &[IVec3], i: usize| near[i].iter().filter(|&&j| blends_into_a_third(cells[i], cells[j], &taken)).count();
    for _ in 0..ROUNDS {
        let mut changed = false;
        for i in 0..count {
            if conflicts(&cells, i) == 0 {
                continue;
            }
            let better = (0..count).filter(|j| *j != i).find(|&j| {
                let before = conflicts(&cells, i) + conflicts(&cells, j);
                cells.swap(i, j);
                let after = conflicts(&cells, i) + conflicts(&cells, j);
                cells.swap(i, j);
                after < before
            });
            if let Some(j) = better {
                cells.swap(i, j);
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    centres(&cells, side)
}

/// Whether a third taken cell lies on the way from one cell to another. What lies beside the way is at least 1 / length of it
/// cells away, which for lattices of up to a thousand objects is more than tau_ac.
fn blends_into_a_third(a: IVec3, b: IVec3, taken: &BTreeSet<[i32; 3]>) -> bool {
    let way = b - a;
    let steps = way.abs().to_array().into_iter().fold(0, gcd);
    (1..steps).any(|k| taken.contains(&(a + way / steps * k).to_array()))
}

fn gcd(a: i32, b: i32) -> i32 {
    if b == 0 { a } else { gcd(b, a % b) }
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

    /// The paper's tau_ac.
    const TAU_AC: f32 = 5.0;

    /// Share of the pairs whose blends come within tau_ac of a third code.
    fn colliding(codes: &[Vec3], pairs: &BTreeSet<(u16, u16)>) -> f64 {
        let hits = pairs.iter().filter(|&&(a, b)| {
            let (from, to) = (codes[usize::from(a) - 1], codes[usize::from(b) - 1]);
            let way = to - from;
            codes.iter().enumerate().any(|(k, c)| {
                let t = ((*c - from).dot(way) / way.length_squared()).clamp(0.0, 1.0);
                k + 1 != usize::from(a) && k + 1 != usize::from(b) && distance(from + t * way, *c) < TAU_AC
            })
        });
        hits.count() as f64 / pairs.len() as f64
    }

    #[test]
    fn blends_of_neighbours_stay_clear_of_other_codes() {
        for count in [60u16, 250] {
            // Objects in rows of 16, each of which touches the next one and those below.
            let pairs: BTreeSet<(u16, u16)> =
                (1..=count).flat_map(|a| [1, 15, 16, 17].map(|d| (a, a + d))).filter(|p| p.1 <= count).collect();
            let (plain, better) = (lattice(usize::from(count), 3), separated(usize::from(count), &pairs, 3));
            let [before, after] = [&plain, &better].map(|codes| colliding(codes, &pairs));
            println!("{count} objects: {before:.3} of the borders blend into a third code on the lattice, {after:.3} after exchanges");
            assert!(before > 0.05 && after < 0.1 * before, "{before} {after}");
            let sorted = |codes: &[Vec3]| codes.iter().map(|c| c.to_array().map(f32::to_bits)).collect::<BTreeSet<_>>();
            assert_eq!(sorted(&plain), sorted(&better), "the same codes, dealt out otherwise");
        }
    }
}
