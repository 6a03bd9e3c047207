//! Matching of key points: mutual nearest neighbours that pass Lowe's ratio test.
//!
//! Every descriptor of one photo is compared with every one of the other. Squared distances are
//! |a|^2 + |b|^2 - 2 a.b, because products are vectorised well. With known poses, only key points
//! on each other's epipolar lines are compared. Repeated patterns elsewhere then do not compete,
//! which doubles the number of matches.

use crate::keypoints::Keypoints;
use fastlgs_core::vectorised;
use glam::{Mat3, Vec2, Vec3};

/// Largest ratio of the best to the second-best distance (Lowe).
const RATIO: f32 = 0.8;
/// Largest distance between matching descriptors, whose lengths are 512. It is checked on epipolar
/// lines, where few candidates make the ratio test weak.
const MAX_DESCRIPTOR_DISTANCE: i32 = 300;
/// Number of descriptors of the first photo that are compared together with one of the second,
/// which then stays in the cache.
const BLOCK: usize = 4;

/// A descriptor as 16-bit integers, whose products are vectorised best.
type Wide = [i16; 128];

/// Nearest descriptor of the other photo: its squared distance, that of the second nearest, and its
/// index.
#[derive(Clone, Copy)]
struct Nearest {
    distance: i32,
    second: i32,
    index: u32,
}

impl Nearest {
    const NONE: Self = Self {
        distance: i32::MAX,
        second: i32::MAX,
        index: u32::MAX,
    };

    /// Considers a candidate; of equal distances the first one is kept.
    #[inline(always)]
    fn update(&mut self, distance: i32, index: usize) {
        if distance < self.second {
            if distance < self.distance {
                *self = Self {
                    distance,
                    second: self.distance,
                    index: index as u32,
                };
            } else {
                self.second = distance;
            }
        }
    }

    /// Returns the index of the nearest descriptor if it passes the ratio test.
    fn distinct(&self) -> Option<usize> {
        // A single candidate has no second best.
        let second = if self.second == i32::MAX {
            u32::MAX
        } else {
            self.second as u32
        };
        (self.index != u32::MAX && (self.distance as f32) < RATIO * RATIO * second as f32)
            .then_some(self.index as usize)
    }
}

/// Descriptors with their squared lengths.
struct Descriptors {
    rows: Vec<Wide>,
    squares: Vec<i32>,
}

impl Descriptors {
    fn of(points: &Keypoints) -> Self {
        let rows: Vec<Wide> = points
            .descriptors
            .iter()
            .map(|d| d.map(i16::from))
            .collect();
        let squares = rows.iter().map(|row| dot(row, row)).collect();
        Self { rows, squares }
    }
}

#[inline(always)]
fn dot(a: &Wide, b: &Wide) -> i32 {
    a.iter()
        .zip(b)
        .map(|(a, b)| i32::from(*a) * i32::from(*b))
        .sum()
}

vectorised! {
    /// Compares all pairs of descriptors, and records the nearest ones on both sides.
    fn compare(a: &Descriptors, b: &Descriptors, of_a: &mut [Nearest], of_b: &mut [Nearest]) = compare_body
}

#[inline(always)]
fn compare_body<const FMA: bool>(
    a: &Descriptors,
    b: &Descriptors,
    of_a: &mut [Nearest],
    of_b: &mut [Nearest],
) {
    let (blocks, rest) = a.rows.as_chunks::<BLOCK>();
    for (k, block) in blocks.iter().enumerate() {
        for (j, other) in b.rows.iter().enumerate() {
            let products: [i32; BLOCK] = std::array::from_fn(|r| dot(&block[r], other));
            for (r, product) in products.into_iter().enumerate() {
                let i = BLOCK * k + r;
                let distance = a.squares[i] + b.squares[j] - 2 * product;
                of_a[i].update(distance, j);
                of_b[j].update(distance, i);
            }
        }
    }
    for (r, row) in rest.iter().enumerate() {
        let i = BLOCK * blocks.len() + r;
        for (j, other) in b.rows.iter().enumerate() {
            let distance = a.squares[i] + b.squares[j] - 2 * dot(row, other);
            of_a[i].update(distance, j);
            of_b[j].update(distance, i);
        }
    }
}

/// Returns mutual nearest neighbours that pass the ratio test: pairs (index in a, index in b).
pub fn matches(a: &Keypoints, b: &Keypoints) -> Vec<(usize, usize)> {
    let (a, b) = (Descriptors::of(a), Descriptors::of(b));
    let (mut of_a, mut of_b) = (
        vec![Nearest::NONE; a.rows.len()],
        vec![Nearest::NONE; b.rows.len()],
    );
    compare(&a, &b, &mut of_a, &mut of_b);
    mutual(&of_a, &of_b).collect()
}

/// Returns pairs of mutual nearest neighbours that pass the ratio test on both sides.
fn mutual(of_a: &[Nearest], of_b: &[Nearest]) -> impl Iterator<Item = (usize, usize)> {
    let distinct = |(i, nearest): (usize, &Nearest)| Some((i, nearest.distinct()?));
    of_a.iter()
        .enumerate()
        .filter_map(distinct)
        .filter(|&(i, j)| of_b[j].distinct() == Some(i))
}

/// Returns matches within `tolerance` pixels of each other's epipolar lines, as measured by
/// `keypoints::epipolar_error`: pairs (index in a, index in b). `f` is the fundamental matrix from
/// a to b.
///
/// Of these candidates, mutual nearest neighbours match if they pass the ratio test and are nearer
/// than `MAX_DESCRIPTOR_DISTANCE`.
pub fn guided(a: &Keypoints, b: &Keypoints, f: &Mat3, tolerance: f32) -> Vec<(usize, usize)> {
    let [lines_b, lines_a] = [(a, *f), (b, f.transpose())].map(|(points, f)| {
        let line = |p: &Vec2| f * p.extend(1.0);
        points
            .positions
            .iter()
            .map(line)
            .map(|line| (line, tolerance * line.truncate().length()))
            .collect::<Vec<(Vec3, f32)>>()
    });
    let (rows_a, rows_b) = (Descriptors::of(a), Descriptors::of(b));
    let (mut of_a, mut of_b) = (
        vec![Nearest::NONE; lines_b.len()],
        vec![Nearest::NONE; lines_a.len()],
    );
    for (i, (line, limit)) in lines_b.iter().enumerate() {
        for (j, (point, (_, other_limit))) in b.positions.iter().zip(&lines_a).enumerate() {
            if point.extend(1.0).dot(*line).abs() < limit.min(*other_limit) {
                let distance = rows_a.squares[i] + rows_b.squares[j]
                    - 2 * dot(&rows_a.rows[i], &rows_b.rows[j]);
                of_a[i].update(distance, j);
                of_b[j].update(distance, i);
            }
        }
    }
    mutual(&of_a, &of_b)
        .filter(|&(i, _)| of_a[i].distance < MAX_DESCRIPTOR_DISTANCE * MAX_DESCRIPTOR_DISTANCE)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;

    fn points(descriptors: Vec<[u8; 128]>) -> Keypoints {
        Keypoints {
            positions: vec![Vec2::ZERO; descriptors.len()],
            descriptors,
        }
    }

    /// Matches by definition, pair by pair.
    fn by_definition(a: &Keypoints, b: &Keypoints) -> Vec<(usize, usize)> {
        let distance = |x: &[u8; 128], y: &[u8; 128]| {
            x.iter()
                .zip(y)
                .map(|(x, y)| u32::from(x.abs_diff(*y)).pow(2))
                .sum::<u32>()
        };
        let nearest = |d: &[u8; 128], all: &[[u8; 128]]| {
            let mut order: Vec<(u32, usize)> = all
                .iter()
                .enumerate()
                .map(|(k, o)| (distance(d, o), k))
                .collect();
            order.sort_unstable();
            let second = order.get(1).map_or(u32::MAX, |o| o.0);
            order
                .first()
                .filter(|o| (o.0 as f32) < RATIO * RATIO * second as f32)
                .map(|o| o.1)
        };
        let back: Vec<Option<usize>> = b
            .descriptors
            .iter()
            .map(|d| nearest(d, &a.descriptors))
            .collect();
        let forth = a
            .descriptors
            .iter()
            .enumerate()
            .map(|(i, d)| (i, nearest(d, &b.descriptors)));
        forth
            .filter_map(|(i, j)| j.filter(|j| back[*j] == Some(i)).map(|j| (i, j)))
            .collect()
    }

    #[test]
    fn blocked_matching_equals_brute_force() {
        let mut rng = Rng::new(3, "descriptors");
        for (n, m) in [(0, 5), (1, 1), (7, 9), (130, 121)] {
            let a: Vec<[u8; 128]> = (0..n)
                .map(|_| std::array::from_fn(|_| rng.below(256) as u8))
                .collect();
            // Most descriptors of b are those of a with noise, in reverse order; one occurs twice.
            let noisy =
                |d: &[u8; 128], rng: &mut Rng| d.map(|v| v.saturating_add(rng.below(30) as u8));
            let mut b: Vec<[u8; 128]> =
                a.iter().rev().take(m).map(|d| noisy(d, &mut rng)).collect();
            b.resize_with(m, || std::array::from_fn(|_| rng.below(256) as u8));
            if m > 8 {
                b[3] = b[4];
            }
            let (a, b) = (points(a), points(b));
            let found = matches(&a, &b);
            assert_eq!(found, by_definition(&a, &b), "{n} and {m}");
            assert!(n < 100 || found.len() > 50, "{} matches", found.len());
        }
    }

    #[test]
    fn epipolar_lines_disambiguate_repeated_patterns() {
        // Two photos whose key points are shifted along the rows. The pattern repeats from row to
        // row, so it is matched only with known poses.
        let mut rng = Rng::new(4, "rows");
        let pattern: [u8; 128] = std::array::from_fn(|_| rng.below(200) as u8);
        let wavering = |rng: &mut Rng| pattern.map(|v| v + rng.below(20) as u8);
        let photo = |shift: f32, rng: &mut Rng| Keypoints {
            positions: (0..20)
                .map(|row| Vec2::new(10.0 + shift, 10.0 * row as f32))
                .collect(),
            descriptors: (0..20).map(|_| wavering(rng)).collect(),
        };
        let (a, b) = (photo(0.0, &mut rng), photo(7.0, &mut rng));
        let along_rows = Mat3::from_cols(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
        assert!(matches(&a, &b).is_empty());
        assert_eq!(
            guided(&a, &b, &along_rows, 2.0),
            (0..20).map(|row| (row, row)).collect::<Vec<_>>()
        );
        assert_eq!(
            guided(&a, &b, &along_rows, 11.0),
            matches(&a, &b),
            "a repeated pattern does not match if several rows are candidates"
        );
        let mut other = b.clone();
        other.descriptors[3] = std::array::from_fn(|_| rng.below(256) as u8);
        assert!(
            !guided(&a, &other, &along_rows, 2.0).contains(&(3, 3)),
            "a single candidate must be similar, too"
        );
    }
}
