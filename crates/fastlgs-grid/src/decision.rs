//! Which object each pixel of blended codes shows (paper, querying features: the target mask).
//!
//! A pixel that is nearer than tau_ac to a code shows that object. At the border of two objects pixels are blends, which come near third codes
//! and are within 5 of none: the paper's threshold alone leaves halos of both kinds. Blends show one of the objects beside them, so they are
//! decided from there.

use crate::codebook::Codebook;
use crate::codes;
use crate::grid::Grid;
use fastlgs_core::LabelMap;
use glam::Vec3;
use rayon::prelude::*;

/// The object that each pixel shows; 0 for none. `values`: blended codes, `[3][h][w]`.
///
/// Pixels within `tau_ac` (on the 0..255 scale; by default a quarter of the codes' spacing) of a code, or of the origin, which is no object's, are
/// sure. Then, ring by ring, the others take that one of their decided neighbours whose code is nearest.
pub fn decide(grid: &Grid, width: u32, height: u32, values: &[f32], tau_ac: Option<f32>) -> LabelMap {
    let pixels = (width * height) as usize;
    let feature = |p: usize| Vec3::new(values[p], values[pixels + p], values[2 * pixels + p]);
    let codebook = Codebook::of(grid);
    let tau_ac = tau_ac.unwrap_or_else(|| codebook.spacing() / 4.0);
    let sure = |p: usize| {
        let (owner, distance) = codebook.owner(feature(p));
        (distance < tau_ac).then_some(owner)
    };
    let mut labels: Vec<Option<u16>> = (0..pixels).into_par_iter().map(sure).collect();
    let mut open: Vec<usize> = (0..pixels).filter(|p| labels[*p].is_none()).collect();
    while !open.is_empty() {
        let beside = |p: usize| {
            let feature = feature(p);
            let decided = neighbours(p, width as usize, pixels).filter_map(|q| labels[q]);
            let distance = |label: u16| codes::distance(feature, grid.code_of(label));
            decided.min_by(|a, b| distance(*a).total_cmp(&distance(*b)).then(a.cmp(b))).map(|label| (p, label))
        };
        let found: Vec<(usize, u16)> = open.par_iter().filter_map(|p| beside(*p)).collect();
        if found.is_empty() {
            // Nothing is sure anywhere.
            break;
        }
        found.into_iter().for_each(|(p, label)| labels[p] = Some(label));
        open.retain(|p| labels[*p].is_none());
    }
    LabelMap { width, height, labels: labels.into_iter().map(Option::unwrap_or_default).collect() }
}

/// The up to eight pixels around a pixel.
fn neighbours(p: usize, width: usize, pixels: usize) -> impl Iterator<Item = usize> {
    let (x, y, rows) = (p % width, p / width, pixels / width);
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    (y.saturating_sub(1)..(y + 2).min(rows)).flat_map(move |y| columns.clone().map(move |x| y * width + x)).filter(move |q| *q != p)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::tests::grid;

    /// One row of grey features.
    fn row(x: &[f32], tau_ac: Option<f32>) -> Vec<u16> {
        decide(&grid(), x.len() as u32, 1, &[x, x, x].concat(), tau_ac).labels
    }

    #[test]
    fn blends_belong_to_what_lies_beside_them() {
        // Codes 0.25, 0.5 and 0.75. On the way from the first to the third lies the second, which is not there.
        assert_eq!(row(&[0.25, 0.26, 0.35, 0.48, 0.6, 0.75], Some(5.0)), [1, 1, 1, 1, 3, 3]);
        assert_eq!(row(&[0.5, 0.5, 0.5], Some(5.0)), [2, 2, 2], "it is where it is sure");
        assert_eq!(row(&[0.0, 0.1, 0.2, 0.25], Some(5.0)), [0, 0, 1, 1], "nothing is a neighbour, too");
        assert_eq!(row(&[0.4, 0.4], Some(1.0)), [0, 0], "nothing is sure");
    }

    #[test]
    fn every_ring_follows_the_one_before() {
        let mut values = vec![0.3f32; 3 * 25];
        (0..3).for_each(|channel| values[25 * channel] = 0.25);
        assert_eq!(decide(&grid(), 5, 5, &values, Some(5.0)).labels, [1; 25]);
    }
}
