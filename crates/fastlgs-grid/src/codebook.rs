//! Which code a rendered feature is nearest to, found by the cells of a cube: a picture asks a million times, and there may be thousands of codes.

use crate::codes::{SCALE, distance};
use crate::grid::Grid;
use glam::{IVec3, Vec3};

/// The codes of a grid, by the cells of a cube of side 1.
pub struct Codebook {
    /// Cells along each side.
    side: i32,
    /// By cell: where its codes begin; one more at the end.
    first: Vec<u32>,
    /// Objects with their codes, cell by cell.
    codes: Vec<(u16, Vec3)>,
}

impl Codebook {
    /// The codes of all objects.
    pub fn of(grid: &Grid) -> Self {
        // About a code a cell.
        let side = (grid.objects.len() as f32).cbrt().ceil().max(1.0) as i32;
        let mut codes: Vec<(u16, Vec3)> = grid.objects.iter().map(|o| (o.id, o.code)).collect();
        codes.sort_by_key(|(id, code)| (place(cell(*code, side), side), *id));
        let begin = |k: i32| codes.partition_point(|c| place(cell(c.1, side), side) < k as usize) as u32;
        Self { side, first: (0..=side.pow(3)).map(begin).collect(), codes }
    }

    /// The object whose code is nearest to a feature, with the paper's Dis_gf; of several the first. Object 0, which is none, where the origin is
    /// nearer: what no mask covers is trained towards it.
    pub fn owner(&self, feature: Vec3) -> (u16, f32) {
        let nothing = (0, distance(feature, Vec3::ZERO));
        self.nearest(feature, |_| true).filter(|found| found.1 < nothing.1).unwrap_or(nothing)
    }

    /// Least distance between two codes: how far a feature may be from its own. As if there were others beyond the cube where there is but one.
    pub fn spacing(&self) -> f32 {
        let other = |&(id, code): &(u16, Vec3)| self.nearest(code, |other| other != id).map_or(SCALE, |found| found.1);
        self.codes.iter().map(other).fold(SCALE, f32::min)
    }

    /// The nearest of the codes that `counts`.
    fn nearest(&self, feature: Vec3, counts: impl Fn(u16) -> bool) -> Option<(u16, f32)> {
        let middle = cell(feature, self.side);
        let mut best: Option<(u16, f32)> = None;
        for ring in 0..self.side {
            // Codes of this ring and those around it are at least so far away.
            let least = SCALE * (ring - 1) as f32 / self.side as f32;
            if best.is_some_and(|found| found.1 <= least) {
                break;
            }
            for cell in self.ring(middle, ring) {
                let place = place(cell, self.side);
                for &(id, code) in &self.codes[self.first[place] as usize..self.first[place + 1] as usize] {
                    let found = (id, distance(feature, code));
                    let nearer = best.is_none_or(|best| found.1 < best.1 || found.1 == best.1 && id < best.0);
                    if counts(id) && nearer {
                        best = Some(found);
                    }
                }
            }
        }
        best
    }

    /// The cells whose largest offset from `middle` along an axis is `ring`.
    fn ring(&self, middle: IVec3, ring: i32) -> impl Iterator<Item = IVec3> {
        let last = self.side - 1;
        let along = move |k: i32| (k - ring).max(0)..=(k + ring).min(last);
        along(middle.z).flat_map(move |z| {
            along(middle.y).flat_map(move |y| {
                let inner = (z - middle.z).abs() < ring && (y - middle.y).abs() < ring;
                // Inside of the ring only the two ends of a row are on it.
                let step = if inner { (2 * ring).max(1) as usize } else { 1 };
                (middle.x - ring..=middle.x + ring).step_by(step).filter(move |x| (0..=last).contains(x)).map(move |x| IVec3::new(x, y, z))
            })
        })
    }
}

/// The cell of a feature; those beyond the cube have the one beside them.
fn cell(feature: Vec3, side: i32) -> IVec3 {
    (feature * side as f32).floor().as_ivec3().clamp(IVec3::ZERO, IVec3::splat(side - 1))
}

fn place(cell: IVec3, side: i32) -> usize {
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
        };
        Grid { objects: codes.iter().enumerate().map(object).collect(), ..Grid::default() }
    }

    #[test]
    fn the_nearest_of_all_is_found() {
        let mut rng = Rng::new(3, "features");
        for count in [1, 2, 9, 100, 777] {
            let grid = grid(&lattice(count, 5));
            let book = Codebook::of(&grid);
            for _ in 0..300 {
                let feature = Vec3::from_array(std::array::from_fn(|_| rng.range(-0.3, 1.3)));
                let nothing = (0, distance(feature, Vec3::ZERO));
                let all = grid.objects.iter().map(|o| (o.id, distance(feature, o.code)));
                let nearest = std::iter::once(nothing).chain(all).min_by(|a, b| a.1.total_cmp(&b.1)).expect("nothing, at least");
                assert_eq!(book.owner(feature).1, nearest.1, "{count} codes, {feature}");
            }
        }
    }

    #[test]
    fn the_spacing_is_that_of_the_codes_that_are_left() {
        let codes = lattice(27, 1);
        assert!((Codebook::of(&grid(&codes)).spacing() - SCALE / 3.0).abs() < 1e-3);
        assert!((Codebook::of(&grid(&codes[..2])).spacing() - distance(codes[0], codes[1])).abs() < 1e-3);
        assert_eq!(Codebook::of(&grid(&codes[..1])).spacing(), SCALE);
    }
}
