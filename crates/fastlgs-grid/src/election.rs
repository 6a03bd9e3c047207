//! Global mapping, step 2: masks vote for proposals.

use crate::consensus::Proposal;
use crate::observations::{Fit, MaskId};
use std::collections::{BTreeMap, BTreeSet};

/// Returns the proposals with at least `min_votes` votes, sorted in descending order by the sum of
/// their voters' IoU.
///
/// Each mask votes for the proposal that fits it best. The proposal with the fewest votes is
/// removed, and its voters choose their next best. This repeats until all remaining proposals have
/// `min_votes` votes. So the best of several near duplicates collects their votes. Proposals that
/// fit only masks of other objects are removed.
pub fn elected(proposals: Vec<Proposal>, min_votes: usize) -> Vec<Proposal> {
    let mut ballots: BTreeMap<MaskId, Vec<(f32, usize)>> = BTreeMap::new();
    for (place, proposal) in proposals.iter().enumerate() {
        proposal
            .masks
            .iter()
            .for_each(|&Fit { mask, iou }| ballots.entry(mask).or_default().push((iou, place)));
    }
    // Ascending order: the preferred proposal is the last.
    ballots
        .values_mut()
        .for_each(|ballot| ballot.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1))));
    let mut voters: Vec<Vec<MaskId>> = vec![Vec::new(); proposals.len()];
    ballots.iter().for_each(|(mask, ballot)| {
        ballot
            .last()
            .iter()
            .for_each(|best| voters[best.1].push(*mask))
    });
    let mut remaining: BTreeSet<(usize, usize)> = voters
        .iter()
        .enumerate()
        .map(|(index, v)| (v.len(), index))
        .collect();
    while let Some(&(votes, last)) = remaining.first().filter(|(votes, _)| *votes < min_votes) {
        remaining.remove(&(votes, last));
        for mask in std::mem::take(&mut voters[last]) {
            let ballot = ballots.get_mut(&mask).expect("every voter has a ballot");
            while ballot
                .pop_if(|(_, place)| !remaining.contains(&(voters[*place].len(), *place)))
                .is_some()
            {}
            if let Some(&(_, next)) = ballot.last() {
                remaining.remove(&(voters[next].len(), next));
                voters[next].push(mask);
                remaining.insert((voters[next].len(), next));
            }
        }
    }
    let share = |(_, place): &(usize, usize)| {
        (
            voters[*place]
                .iter()
                .map(|mask| ballots[mask].last().map_or(0.0, |b| b.0))
                .sum::<f32>(),
            *place,
        )
    };
    let mut order: Vec<(f32, usize)> = remaining.iter().map(share).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut proposals: Vec<Option<Proposal>> = proposals.into_iter().map(Some).collect();
    order
        .into_iter()
        .filter_map(|(_, place)| proposals[place].take())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voters_of_removed_proposals_choose_the_next_best() {
        let proposal = |name: u32, fits: &[(MaskId, f32)]| Proposal {
            set: vec![name],
            masks: fits.iter().map(|&(mask, iou)| Fit { mask, iou }).collect(),
        };
        let all = vec![
            proposal(0, &[(0, 0.9), (1, 0.7), (2, 0.7)]),
            // Nearly the same as 0, with a better fit in one view.
            proposal(1, &[(0, 0.8), (1, 0.8), (2, 0.6)]),
            // Fits masks of 0, and one of its own.
            proposal(2, &[(1, 0.5), (2, 0.5), (9, 0.6)]),
            proposal(3, &[(3, 0.9), (4, 0.9), (5, 0.9)]),
        ];
        let names = |least| {
            elected(all.clone(), least)
                .iter()
                .map(|p| p.set[0])
                .collect::<Vec<_>>()
        };
        assert_eq!(names(1), [3, 0, 1, 2]);
        assert_eq!(names(3), [3, 0]);
        assert!(names(4).is_empty());
    }
}
