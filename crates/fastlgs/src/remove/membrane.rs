//! Fills unknown pixels from the known pixels around them.

use fastlgs_vision::inpaint::Inpainter;

/// Fills a hole smoothly: solves the Laplace equation with the pixels at its border as boundary
/// values. It continues planes of inverse depth exactly, and adds no texture.
pub struct Membrane;

/// Factor of successive over-relaxation.
const RELAXATION: f32 = 1.9;
/// Number of iterations, enough for holes that are a few hundred pixels wide.
const ITERATIONS: usize = 400;

impl Inpainter for Membrane {
    fn fill(&self, colors: &mut [f32], hole: &[bool], width: u32) -> fastlgs_vision::Result<()> {
        Self::fill_planes(colors, hole, width as usize);
        Ok(())
    }
}

impl Membrane {
    /// Fills `hole` in each plane of `[planes][height][width]`.
    pub fn fill_planes(planes: &mut [f32], hole: &[bool], width: usize) {
        let inside: Vec<usize> = (0..hole.len()).filter(|p| hole[*p]).collect();
        let around: Vec<Vec<usize>> = inside
            .iter()
            .map(|p| neighbours(*p, width, hole.len()))
            .collect();
        for plane in planes.chunks_exact_mut(hole.len()) {
            fill_by_rings(plane, hole, width, |known| {
                known.iter().sum::<f32>() / known.len() as f32
            });
            for _ in 0..ITERATIONS {
                for (p, near) in inside.iter().zip(&around) {
                    let mean = near.iter().map(|q| plane[*q]).sum::<f32>() / near.len() as f32;
                    plane[*p] += RELAXATION * (mean - plane[*p]);
                }
            }
        }
    }
}

/// Returns the labels of an image. Each pixel of `hole` gets the label of a known neighbour, ring
/// by ring.
pub fn extend_labels(labels: &[u16], hole: &[bool], width: usize) -> Vec<u16> {
    let mut labels = labels.to_vec();
    fill_by_rings(&mut labels, hole, width, |known| known[0]);
    labels
}

/// Fills the pixels of `hole` ring by ring. `value` computes a pixel from its known neighbours.
fn fill_by_rings<T: Copy>(
    values: &mut [T],
    hole: &[bool],
    width: usize,
    value: impl Fn(&[T]) -> T,
) {
    let mut unknown = hole.to_vec();
    let mut rest: Vec<usize> = (0..hole.len()).filter(|p| hole[*p]).collect();
    while !rest.is_empty() {
        let from_neighbours = |p: &usize| {
            let known: Vec<T> = neighbours(*p, width, hole.len())
                .into_iter()
                .filter(|q| !unknown[*q])
                .map(|q| values[q])
                .collect();
            (!known.is_empty()).then(|| (*p, value(&known)))
        };
        let ring: Vec<(usize, T)> = rest.iter().filter_map(from_neighbours).collect();
        if ring.is_empty() {
            break;
        }
        ring.into_iter()
            .for_each(|(p, value)| (values[p], unknown[p]) = (value, false));
        rest.retain(|p| unknown[*p]);
    }
}

/// Returns the indices of the up to four direct neighbours of a pixel.
fn neighbours(p: usize, width: usize, pixels: usize) -> Vec<usize> {
    let x = p % width;
    let beside = [
        (x > 0).then(|| p - 1),
        (x + 1 < width).then_some(p + 1),
        p.checked_sub(width),
        Some(p + width).filter(|q| *q < pixels),
    ];
    beside.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_is_continued() {
        let (width, height) = (40, 30);
        let value = |p: usize| 0.1 + 0.02 * (p % width) as f32 - 0.01 * (p / width) as f32;
        let hole: Vec<bool> = (0..width * height)
            .map(|p| (8..32).contains(&(p % width)) && (6..25).contains(&(p / width)))
            .collect();
        let mut planes: Vec<f32> = (0..2 * width * height)
            .map(|p| {
                if hole[p % hole.len()] {
                    9.0
                } else {
                    value(p % hole.len())
                }
            })
            .collect();
        Membrane::fill_planes(&mut planes, &hole, width);
        for (p, found) in planes.iter().enumerate() {
            assert!(
                (found - value(p % hole.len())).abs() < 1e-3,
                "pixel {p}: {found}"
            );
        }
    }
}
