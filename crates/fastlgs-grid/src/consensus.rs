//! Global mapping, first step: every mask proposes a thing, and the other views' masks say what it is.
//!
//! A mask holds the Gaussians that lie in it. In each other view the mask that fits these best is taken to show the same thing if each holds most
//! of the other, so that no mask can show two things that share nothing. What most of all these masks' pixels hold is the thing as more views see
//! it; and so on, until nothing changes. Such a set is its own consensus: whichever of its masks it starts from, a view that cuts the thing apart
//! or glues it to another one has no voice, masks that are missing are not missed, and a thing, its parts, and what it stands on are all found,
//! each from its own masks. (As MaskClustering, 2401.07745, has it, agreement of whole masks in all views decides, not of their borders in two;
//! but there a mask belongs to one thing only.)

use crate::sightings::{Fit, MIN_PIXELS, MaskId, Scratch, Sightings};
use rayon::prelude::*;

/// A set of Gaussians that masks agree on.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Its Gaussians, rising.
    pub set: Vec<u32>,
    /// The masks that show it, at most one a view, rising.
    pub masks: Vec<Fit>,
}

/// Most rounds; nearly all sets rest after four.
const ROUNDS: usize = 8;
/// Masks that propose at the same time, before those that are explained fall out.
const BATCH: usize = 256;

/// What the masks of the views propose, each once; at least `min_views` views show every one of them.
pub fn proposals(sightings: &Sightings, min_views: usize) -> Vec<Proposal> {
    // What trackers hold together comes first; then single masks, scattered, so that a batch seldom holds a thing twice.
    let mut seeds: Vec<Vec<MaskId>> = sightings.tracks();
    let mut single: Vec<MaskId> = (0..sightings.pixels.len() as MaskId).filter(|m| sightings.pixels[*m as usize] >= MIN_PIXELS).collect();
    single.sort_by_key(|mask| (mask.wrapping_mul(0x9e37_79b1), *mask));
    seeds.extend(single.into_iter().map(|mask| vec![mask]));
    let mut explained = vec![false; sightings.pixels.len()];
    let mut found: Vec<Proposal> = Vec::new();
    let mut seeds = seeds.into_iter().peekable();
    while seeds.peek().is_some() {
        let fresh = |seed: &Vec<MaskId>| seed.iter().any(|mask| !explained[*mask as usize]);
        let batch: Vec<Vec<MaskId>> = seeds.by_ref().filter(fresh).take(BATCH).collect();
        let rest = |scratch: &mut Scratch, seed: &Vec<MaskId>| at_rest(sightings, seed, min_views, scratch);
        let new: Vec<Option<Proposal>> = batch.par_iter().with_min_len(BATCH / 16).map_init(|| sightings.scratch(), rest).collect();
        for proposal in new.into_iter().flatten() {
            proposal.masks.iter().for_each(|fit| explained[fit.mask as usize] = true);
            found.push(proposal);
        }
    }
    found.sort_by(|a, b| a.masks.iter().map(|fit| fit.mask).cmp(b.masks.iter().map(|fit| fit.mask)));
    found.dedup_by(|a, b| a.masks == b.masks);
    found
}

/// What the views make of the thing that some masks show.
fn at_rest(sightings: &Sightings, seed: &[MaskId], min_views: usize, scratch: &mut Scratch) -> Option<Proposal> {
    let mut asked = seed.to_vec();
    let mut found = None;
    for _ in 0..ROUNDS {
        let set = sightings.held_by(asked.iter().copied(), scratch);
        let masks = sightings.showing(&set, scratch);
        let rests = masks.iter().map(|fit| fit.mask).eq(asked.iter().copied());
        asked = masks.iter().map(|fit| fit.mask).collect();
        found = (masks.len() >= min_views).then_some(Proposal { set, masks });
        if rests || asked.is_empty() {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sightings::Sighting;
    use fastlgs_core::mask_list::{Mask, RunLengths, Table};
    use fastlgs_core::{Level, MaskList};

    /// A mask by its first Gaussian, the one after its last, and the number that a tracker gave it.
    type Range = (u32, u32, Option<u32>);

    /// The sets that views of a row of 12 Gaussians propose, each of 50 pixels where `shows(view, gaussian)`.
    fn proposed(views: &[&[Range]], shows: impl Fn(usize, u32) -> bool) -> Vec<Vec<u32>> {
        let atoms = |masks: &&[Range]| {
            let runs = |from, to| RunLengths::of(12, 1, |x, _| (from..to).contains(&x));
            let mask = |&(from, to, track): &Range| Mask { track, ..Mask::new(Level::Whole, runs(from, to)) };
            MaskList { masks: masks.iter().map(mask).collect(), ..MaskList::new(12, 1) }.atoms()
        };
        let atoms: Vec<_> = views.iter().map(atoms).collect();
        let tables: Vec<Table> = atoms.iter().map(|a| a.table.clone()).collect();
        let seen = atoms.iter().enumerate().map(|(view, a)| {
            let shown = (0..12).filter(|g| shows(view, *g));
            shown.map(|g| Sighting::new(g, a.map.at(g, 0), 50.0)).collect()
        });
        let mut sets: Vec<Vec<u32>> = proposals(&Sightings::new(12, seen.collect(), &tables), 3).into_iter().map(|p| p.set).collect();
        sets.sort();
        sets
    }

    #[test]
    fn parts_and_wholes_are_found_and_the_views_that_show_them_decide() {
        // A handle of 2 on a cup of 6 on a saucer of 10; one view glues all, another cuts the cup.
        let good: &[_] = &[(0, 10, None), (0, 6, None), (0, 2, None)];
        let (glued, cut): (&[_], &[_]) = (&[(0, 10, None)], &[(0, 10, None), (0, 3, None), (3, 6, None)]);
        let wanted = [0..2, 0..6, 0..10].map(|range| range.collect::<Vec<u32>>());
        let found = proposed(&[good, good, good, glued, cut], |_, _| true);
        assert_eq!(found, proposed(&[cut, glued, good, good, good], |_, _| true), "the order of the views plays no part");
        assert!(wanted.iter().all(|set| found.contains(set)), "{found:?}");
        assert_eq!(proposed(&[good, good, glued, glued, glued], |_, _| true), [wanted[2].clone()], "two views of the cup are too few");
    }
    #[test]
    fn masks_that_hold_most_of_each_other_show_one_thing() {
        // Each view draws a bowl of six a little elsewhere: between the outer ones the IoU is 2 in 10, from the middle one to either 4 in 8.
        let drawn: [&[_]; 3] = [&[(1, 7, None)], &[(3, 9, None)], &[(5, 11, None)]];
        assert_eq!(proposed(&drawn, |_, _| true), [(3..9).collect::<Vec<u32>>()]);
        // Half of each is too little.
        let drawn: [&[_]; 3] = [&[(0, 6, None)], &[(3, 9, None)], &[(6, 12, None)]];
        assert!(proposed(&drawn, |_, _| true).is_empty());
    }
    #[test]
    fn a_tracker_joins_what_no_photo_shows_together() {
        // Each of three views shows another third of one thing.
        let thirds = |track| [0, 1, 2].map(|view| [(4 * view, 4 * view + 4, track)]);
        let found = |track| proposed(&thirds(track).each_ref().map(|masks| masks.as_slice()), |view, g| g as usize / 4 == view);
        assert_eq!(found(Some(7)), [(0..12).collect::<Vec<u32>>()]);
        assert!(found(None).is_empty());
    }
}
