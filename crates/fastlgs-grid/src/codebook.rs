//! Finds the code nearest to a rendered feature, with a grid of cells over the unit cube.
//!
//! A picture needs a million look-ups among up to thousands of codes.

use crate::codes::{SCALE, distance};
use crate::grid::Grid;
use glam::{IVec3, Vec3};

/// The codes of an object table, sorted by cell of the unit cube.
pub struct Codebook {
    /// Number of cells along each axis.
    side: i32,
    /// For each cell: index of its first code in `codes`, with a final end index.
    first: Vec<u32>,
    /// Object ids with their codes, sorted by cell.
    codes: Vec<(u16, Vec3)>,
}

impl Codebook {
    /// Sorts the codes of all objects into cells.
    pub fn of(grid: &Grid) -> Self {
        // About one code for each cell.
        let side = (grid.objects.len() as f32).cbrt().ceil().max(1.0) as i32;
        let mut codes: Vec<(u16, Vec3)> = grid.objects.iter().map(|o| (o.id, o.code)).collect();
        codes.sort_by_key(|(id, code)| (cell_index(cell(*code, side), side), *id));
        let begin = |k: i32| {
            codes.partition_point(|c| cell_index(cell(c.1, side), side) < k as usize) as u32
        };
        Self {
            side,
            first: (0..=side.pow(3)).map(begin).collect(),
            codes,
        }
    }

    /// Returns the object whose code is nearest to `feature`, and the paper's distance Dis_gf
    /// (0..255 scale). Ties go to the smaller id.
    ///
    /// Returns object 0 (none) if the origin is at least as near. Training pulls pixels outside all
    /// masks towards the origin.
    pub fn owner(&self, feature: Vec3) -> (u16, f32) {
        let nothing = (0, distance(feature, Vec3::ZERO));
        self.nearest(feature, |_| true)
            .filter(|found| found.1 < nothing.1)
            .unwrap_or(nothing)
    }

    /// Returns the smallest distance between two codes on the 0..255 scale; [`SCALE`] if there is
    /// only one code.
    pub fn spacing(&self) -> f32 {
        let other = |&(id, code): &(u16, Vec3)| {
            self.nearest(code, |other| other != id)
                .map_or(SCALE, |found| found.1)
        };
        self.codes.iter().map(other).fold(SCALE, f32::min)
    }

    /// Returns the nearest code among the ids that `counts` accepts, with its distance.
    fn nearest(&self, feature: Vec3, counts: impl Fn(u16) -> bool) -> Option<(u16, f32)> {
        let middle = cell(feature, self.side);
        let mut best: Option<(u16, f32)> = None;
        for ring in 0..self.side {
            // Lower bound of the distance to codes in this ring and beyond.
            let least = SCALE * (ring - 1) as f32 / self.side as f32;
            if best.is_some_and(|found| found.1 <= least) {
                break;
            }
            for cell in self.ring(middle, ring) {
                let place = cell_index(cell, self.side);
                for &(id, code) in
                    &self.codes[self.first[place] as usize..self.first[place + 1] as usize]
                {
                    let found = (id, distance(feature, code));
                    let nearer = best
                        .is_none_or(|best| found.1 < best.1 || found.1 == best.1 && id < best.0);
                    if counts(id) && nearer {
                        best = Some(found);
                    }
                }
            }
        }
        best
    }

    /// Iterates over the cells whose largest offset from `middle` along an axis is `ring`.
    fn ring(&self, middle: IVec3, ring: i32) -> impl Iterator<Item = IVec3> {
        let last = self.side - 1;
        let along = move |k: i32| (k - ring).max(0)..=(k + ring).min(last);
        along(middle.z).flat_map(move |z| {
            along(middle.y).flat_map(move |y| {
                let inner = (z - middle.z).abs() < ring && (y - middle.y).abs() < ring;
                // In the inner rows, only the two ends lie on the ring.
                let step = if inner { (2 * ring).max(1) as usize } else { 1 };
                (middle.x - ring..=middle.x + ring)
                    .step_by(step)
                    .filter(move |x| (0..=last).contains(x))
                    .map(move |x| IVec3::new(x, y, z))
            })
        })
    }
}

/// Returns the cell of a feature, clamped to the cube.
fn cell(feature: Vec3, side: i32) -> IVec3 {
    (feature * side as f32)
        .floor()
        .as_ivec3()
        .clamp(IVec3::ZERO, IVec3::splat(side - 1))
}

fn cell_index(cell: IVec3, side: i32) -> usize {
    ((cell.z * side + cell.y) * side + cell.x) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codes::lattice;
    use crate::grid::Object;
    use fastlgs_core::rng::Rng;

    fn grid(codes: &[Vec3]) -> Grid {
        let object = |(k, code): (usize, &Vec3)| Object {
            id: k as u16 + 1,
            parent: 0,
            support: 1.0,
            code: *code,
            embeddings: Vec::new(),
            areas: Vec::new(),
            views: 1,
            detected: None,
        };
        Grid {
            objects: codes.iter().enumerate().map(object).collect(),
            ..Grid::default()
        }
    }

    #[test]
    fn owner_is_the_nearest_code() {
        let mut rng = Rng::new(3, "features");
        for count in [1, 2, 9, 100, 777] {
            let grid = grid(&lattice(count, 5));
            let book = Codebook::of(&grid);
            for _ in 0..300 {
                let feature = Vec3::from_array(std::array::from_fn(|_| rng.range(-0.3, 1.3)));
                let nothing = (0, distance(feature, Vec3::ZERO));
                let all = grid
                    .objects
                    .iter()
                    .map(|o| (o.id, distance(feature, o.code)));
                let nearest = std::iter::once(nothing)
                    .chain(all)
                    .min_by(|a, b| a.1.total_cmp(&b.1))
                    .expect("nothing, at least");
                assert_eq!(book.owner(feature).1, nearest.1, "{count} codes, {feature}");
            }
        }
    }

    #[test]
    fn spacing_is_the_smallest_distance_between_codes() {
        let codes = lattice(27, 1);
        assert!((Codebook::of(&grid(&codes)).spacing() - SCALE / 3.0).abs() < 1e-3);
        assert!(
            (Codebook::of(&grid(&codes[..2])).spacing() - distance(codes[0], codes[1])).abs()
                < 1e-3
        );
        assert_eq!(Codebook::of(&grid(&codes[..1])).spacing(), SCALE);
    }
}
