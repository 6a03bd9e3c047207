//! Assigns an object to each pixel of rendered codes (paper, querying features: the target mask).
//!
//! Pixels within tau_ac of a code show its object. At borders, pixels blend two codes: they may
//! come near a third code or be near none. The paper's threshold alone leaves halos of both kinds.
//! Such pixels take an object of their neighbours instead.

use crate::codebook::Codebook;
use crate::codes;
use crate::grid::Grid;
use fastlgs_core::LabelMap;
use glam::Vec3;
use rayon::prelude::*;

/// Returns the object id of each pixel; 0 for none. `values`: rendered codes, `[3][h][w]`.
///
/// A pixel is confident if its feature lies within `tau_ac` of a code or of the origin (no object).
/// `tau_ac` is on the 0..255 scale and defaults to a quarter of the smallest distance between
/// codes. All other pixels take the nearest code among their decided neighbours, ring by ring.
pub fn decide(
    grid: &Grid,
    width: u32,
    height: u32,
    values: &[f32],
    tau_ac: Option<f32>,
) -> LabelMap {
    let pixels = (width * height) as usize;
    let feature = |p: usize| Vec3::new(values[p], values[pixels + p], values[2 * pixels + p]);
    let codebook = Codebook::of(grid);
    let tau_ac = tau_ac.unwrap_or_else(|| codebook.spacing() / 4.0);
    let confident = |p: usize| {
        let (owner, distance) = codebook.owner(feature(p));
        (distance < tau_ac).then_some(owner)
    };
    let mut labels: Vec<Option<u16>> = (0..pixels).into_par_iter().map(confident).collect();
    let mut undecided: Vec<usize> = (0..pixels).filter(|p| labels[*p].is_none()).collect();
    while !undecided.is_empty() {
        let nearest_neighbour_label = |p: usize| {
            let feature = feature(p);
            let decided = neighbours(p, width as usize, pixels).filter_map(|q| labels[q]);
            let distance = |label: u16| codes::distance(feature, grid.code_of(label));
            decided
                .min_by(|a, b| distance(*a).total_cmp(&distance(*b)).then(a.cmp(b)))
                .map(|label| (p, label))
        };
        let found: Vec<(usize, u16)> = undecided
            .par_iter()
            .filter_map(|p| nearest_neighbour_label(*p))
            .collect();
        if found.is_empty() {
            // No pixel is confident.
            break;
        }
        found
            .into_iter()
            .for_each(|(p, label)| labels[p] = Some(label));
        undecided.retain(|p| labels[*p].is_none());
    }
    LabelMap {
        width,
        height,
        labels: labels.into_iter().map(Option::unwrap_or_default).collect(),
    }
}

/// Iterates over the neighbours of a pixel, at most eight.
fn neighbours(p: usize, width: usize, pixels: usize) -> impl Iterator<Item = usize> {
    let (x, y, rows) = (p % width, p / width, pixels / width);
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    (y.saturating_sub(1)..(y + 2).min(rows))
        .flat_map(move |y| columns.clone().map(move |x| y * width + x))
        .filter(move |q| *q != p)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::tests::grid;

    /// Decides one row of grey features.
    fn row(x: &[f32], tau_ac: Option<f32>) -> Vec<u16> {
        decide(&grid(), x.len() as u32, 1, &[x, x, x].concat(), tau_ac).labels
    }

    #[test]
    fn blended_pixels_take_the_object_of_a_neighbour() {
        // The codes are 0.25, 0.5 and 0.75. A blend of objects 1 and 3 passes the code of object 2,
        // which is absent here.
        assert_eq!(
            row(&[0.25, 0.26, 0.35, 0.48, 0.6, 0.75], Some(5.0)),
            [1, 1, 1, 1, 3, 3]
        );
        assert_eq!(
            row(&[0.5, 0.5, 0.5], Some(5.0)),
            [2, 2, 2],
            "object 2 is found where its code is confident"
        );
        assert_eq!(
            row(&[0.0, 0.1, 0.2, 0.25], Some(5.0)),
            [0, 0, 1, 1],
            "id 0 spreads to its neighbours, too"
        );
        assert_eq!(row(&[0.4, 0.4], Some(1.0)), [0, 0], "no pixel is confident");
    }

    #[test]
    fn undecided_pixels_are_filled_ring_by_ring() {
        let mut values = vec![0.3f32; 3 * 25];
        (0..3).for_each(|channel| values[25 * channel] = 0.25);
        assert_eq!(decide(&grid(), 5, 5, &values, Some(5.0)).labels, [1; 25]);
    }
}
