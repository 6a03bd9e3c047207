//! Global mapping, step 1: each mask proposes a set of Gaussians, which the masks of the other
//! views refine.
//!
//! A mask holds the Gaussians that lie in it. In each other view, the best fitting mask is accepted
//! if mask and set each hold most of the other. The Gaussians that lie mostly in the accepted masks
//! form the next set. This is repeated until the masks do not change.
//!
//! The result does not depend on which of its masks starts it. A view that splits or merges objects
//! contributes no mask, and missing masks do no harm. An object, its parts and what it stands on
//! are all found, each from its own masks.
//!
//! As in MaskClustering (arXiv 2401.07745), the agreement of masks in all views decides, not the
//! overlap of two masks. There, however, each mask belongs to one object only.

use crate::observations::{Fit, MIN_PIXELS, MaskId, Observations, Scratch};
use rayon::prelude::*;

/// A set of Gaussians on which masks of several views agree.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Indices of its Gaussians in ascending order.
    pub set: Vec<u32>,
    /// Masks that show it, at most one for each view, in ascending order.
    pub masks: Vec<Fit>,
}

/// Largest number of refinement rounds; nearly all sets converge within four.
const CONSENSUS_ROUNDS: usize = 8;
/// Number of seeds that are refined in parallel. Between batches, seeds whose masks all belong to
/// proposals are skipped.
const BATCH: usize = 256;

/// Returns the distinct proposals of all masks. At least `min_views` views show each of them.
pub fn proposals(observations: &Observations, min_views: usize) -> Vec<Proposal> {
    // Tracks come first, then single masks in scattered order, so that a batch rarely contains the
    // same object twice.
    let mut seeds: Vec<Vec<MaskId>> = observations.tracks();
    let mut single: Vec<MaskId> = (0..observations.pixels.len() as MaskId)
        .filter(|m| observations.pixels[*m as usize] >= MIN_PIXELS)
        .collect();
    single.sort_by_key(|mask| (mask.wrapping_mul(0x9e37_79b1), *mask));
    seeds.extend(single.into_iter().map(|mask| vec![mask]));
    let mut explained = vec![false; observations.pixels.len()];
    let mut found: Vec<Proposal> = Vec::new();
    let mut seeds = seeds.into_iter().peekable();
    while seeds.peek().is_some() {
        let fresh = |seed: &Vec<MaskId>| seed.iter().any(|mask| !explained[*mask as usize]);
        let batch: Vec<Vec<MaskId>> = seeds.by_ref().filter(fresh).take(BATCH).collect();
        let rest = |scratch: &mut Scratch, seed: &Vec<MaskId>| {
            refine(observations, seed, min_views, scratch)
        };
        let new: Vec<Option<Proposal>> = batch
            .par_iter()
            .with_min_len(BATCH / 16)
            .map_init(|| observations.scratch(), rest)
            .collect();
        for proposal in new.into_iter().flatten() {
            proposal
                .masks
                .iter()
                .for_each(|fit| explained[fit.mask as usize] = true);
            found.push(proposal);
        }
    }
    found.sort_by(|a, b| {
        a.masks
            .iter()
            .map(|fit| fit.mask)
            .cmp(b.masks.iter().map(|fit| fit.mask))
    });
    found.dedup_by(|a, b| a.masks == b.masks);
    found
}

/// Refines the Gaussians of the seed masks until their masks do not change, in at most [`CONSENSUS_ROUNDS`]
/// rounds. Returns `None` if fewer than `min_views` views show the set.
fn refine(
    observations: &Observations,
    seed: &[MaskId],
    min_views: usize,
    scratch: &mut Scratch,
) -> Option<Proposal> {
    let mut masks_in = seed.to_vec();
    let mut found = None;
    for _ in 0..CONSENSUS_ROUNDS {
        let set = observations.gaussians_in(masks_in.iter().copied(), scratch);
        let masks = observations.matching_masks(&set, scratch);
        let unchanged = masks
            .iter()
            .map(|fit| fit.mask)
            .eq(masks_in.iter().copied());
        masks_in = masks.iter().map(|fit| fit.mask).collect();
        found = (masks.len() >= min_views).then_some(Proposal { set, masks });
        if unchanged || masks_in.is_empty() {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observations::Observation;
    use fastlgs_core::mask_list::{AtomTable, Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    /// A mask: first Gaussian, end (exclusive), and track number.
    type Range = (u32, u32, Option<u32>);

    /// Returns the proposed sets for views of a row of 12 Gaussians. Each Gaussian has 50 pixels in
    /// the views where `shows(view, gaussian)`.
    fn proposed(views: &[&[Range]], shows: impl Fn(usize, u32) -> bool) -> Vec<Vec<u32>> {
        let atoms = |masks: &&[Range]| {
            let runs = |from, to| RunLengths::from_fn(12, 1, |x, _| (from..to).contains(&x));
            let mask = |&(from, to, track): &Range| Mask {
                track,
                ..Mask::new(Level::Whole, runs(from, to))
            };
            MaskList {
                masks: masks.iter().map(mask).collect(),
                ..MaskList::new(12, 1)
            }
            .atoms()
        };
        let atoms: Vec<_> = views.iter().map(atoms).collect();
        let tables: Vec<AtomTable> = atoms.iter().map(|a| a.table.clone()).collect();
        let seen = atoms.iter().enumerate().map(|(view, a)| {
            let shown = (0..12).filter(|g| shows(view, *g));
            shown
                .map(|g| Observation::new(g, a.map.at(g, 0), 50.0))
                .collect()
        });
        let mut sets: Vec<Vec<u32>> = proposals(&Observations::new(12, seen.collect(), &tables), 3)
            .into_iter()
            .map(|p| p.set)
            .collect();
        sets.sort();
        sets
    }

    #[test]
    fn parts_and_wholes_are_proposed_despite_merged_and_split_views() {
        // A handle (2 Gaussians) on a cup (6) on a saucer (10). One view merges all of them,
        // another splits the cup.
        let good: &[_] = &[(0, 10, None), (0, 6, None), (0, 2, None)];
        let (glued, cut): (&[_], &[_]) = (
            &[(0, 10, None)],
            &[(0, 10, None), (0, 3, None), (3, 6, None)],
        );
        let wanted = [0..2, 0..6, 0..10].map(|range| range.collect::<Vec<u32>>());
        let found = proposed(&[good, good, good, glued, cut], |_, _| true);
        assert_eq!(
            found,
            proposed(&[cut, glued, good, good, good], |_, _| true),
            "the result does not depend on the order of the views"
        );
        assert!(wanted.iter().all(|set| found.contains(set)), "{found:?}");
        assert_eq!(
            proposed(&[good, good, glued, glued, glued], |_, _| true),
            [wanted[2].clone()],
            "two views of the cup are fewer than min_views"
        );
    }
    #[test]
    fn masks_that_hold_most_of_each_other_form_one_proposal() {
        // Each view draws a bowl of six Gaussians at another position. The outer masks have an IoU
        // of 2/10, the middle one 4/8 with each of them.
        let drawn: [&[_]; 3] = [&[(1, 7, None)], &[(3, 9, None)], &[(5, 11, None)]];
        assert_eq!(
            proposed(&drawn, |_, _| true),
            [(3..9).collect::<Vec<u32>>()]
        );
        // Masks that share only half of each other do not match.
        let drawn: [&[_]; 3] = [&[(0, 6, None)], &[(3, 9, None)], &[(6, 12, None)]];
        assert!(proposed(&drawn, |_, _| true).is_empty());
    }
    #[test]
    fn a_track_joins_masks_of_different_parts_of_an_object() {
        // Each of three views shows a different third of one object.
        let thirds = |track| [0, 1, 2].map(|view| [(4 * view, 4 * view + 4, track)]);
        let found = |track| {
            proposed(
                &thirds(track).each_ref().map(|masks| masks.as_slice()),
                |view, g| g as usize / 4 == view,
            )
        };
        assert_eq!(found(Some(7)), [(0..12).collect::<Vec<u32>>()]);
        assert!(found(None).is_empty());
    }
}
