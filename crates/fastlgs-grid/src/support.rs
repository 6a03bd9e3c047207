//! Global mapping, step 3: IoU of each elected set with the masks of each view.

use crate::consensus::Proposal;
use crate::observations::Observations;
use rayon::prelude::*;

/// Support of a set of Gaussians by masks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Support {
    /// Mean IoU with the best mask of each view, weighted by the set's pixels there; 0 to 1.
    pub iou: f32,
    /// Each view that shows at least [`MIN_PIXELS`](crate::observations::MIN_PIXELS) of it.
    pub views: Vec<ViewSupport>,
}

/// Support of a set of Gaussians in a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewSupport {
    /// Index of the view.
    pub view: u32,
    /// Number of pixels of the set.
    pub pixels: u32,
    /// IoU with the best mask, 0 to 1.
    pub iou: f32,
}

/// Computes the support of each set.
pub fn support(observations: &Observations, sets: &[Proposal]) -> Vec<Support> {
    let of = |scratch: &mut _, set: &Proposal| {
        let shown = observations.view_fits(&set.set, scratch);
        let (pixels, common) = shown.iter().fold((0.0, 0.0), |(pixels, common), s| {
            (
                pixels + s.pixels,
                common + s.pixels * s.best.map_or(0.0, |best| best.iou),
            )
        });
        Support {
            iou: common / pixels.max(1.0),
            views: shown
                .iter()
                .map(|s| ViewSupport {
                    view: s.view,
                    pixels: s.pixels.round() as u32,
                    iou: s.best.map_or(0.0, |best| best.iou),
                })
                .collect(),
        }
    };
    sets.par_iter()
        .with_min_len(16)
        .map_init(|| observations.scratch(), of)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observations::Observation;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    #[test]
    fn sets_are_compared_with_whole_masks() {
        // Five Gaussians of 100 pixels; masks of the first two and of the first four.
        let mask = |end: u32| Mask::new(Level::Whole, RunLengths::from_fn(5, 1, |x, _| x < end));
        let atoms = MaskList {
            masks: vec![mask(2), mask(4)],
            ..MaskList::new(5, 1)
        }
        .atoms();
        let seen = |_| {
            (0..5)
                .map(|g| Observation::new(g, atoms.map.at(g, 0), 100.0))
                .collect()
        };
        let tables = [(); 3].map(|()| atoms.table.clone());
        let sightings = Observations::new(5, [(); 3].map(seen).to_vec(), &tables);
        let sets = [0..2, 1..2, 0..4, 4..5, 0..5].map(|set| Proposal {
            set: set.collect(),
            masks: Vec::new(),
        });
        let found = support(&sightings, &sets);
        assert_eq!(
            found.iter().map(|s| s.iou).collect::<Vec<_>>(),
            [1.0, 0.5, 1.0, 0.0, 0.8]
        );
        let expected = [0, 1, 2].map(|view| ViewSupport {
            view,
            pixels: 400,
            iou: 1.0,
        });
        assert_eq!(found[2].views, expected);
    }
}
