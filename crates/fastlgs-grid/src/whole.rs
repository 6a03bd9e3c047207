//! Global mapping, second step: regions that belong together become whole objects.
//!
//! A segmenter without learned objects cuts a thing where its colour changes. What the parts mean, averaged over all
//! views that show them, is much steadier than in a single photo: touching regions of like meaning, which the masks of
//! at least some views join, are one object.

use crate::consensus::{Regions, Seen, agreement, merged};
use std::collections::BTreeMap;

/// Likeness, 0 to 1, from which touching regions are one object.
pub const LIKENESS: f32 = 0.4;
/// Pairs of neighbouring Gaussians that make two regions touch, as a share of the smaller one's.
const TOUCH: f32 = 0.02;

struct Group {
    seen: Seen,
    meaning: Vec<f32>,
    gaussians: u32,
    members: Vec<u16>,
}

/// Mean of the views' agreement and the cosine of the meanings.
fn likeness(a: &Group, b: &Group) -> f32 {
    let dot = |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(p, q)| p * q).sum::<f32>();
    let cosine = dot(&a.meaning, &b.meaning) / (dot(&a.meaning, &a.meaning) * dot(&b.meaning, &b.meaning)).sqrt().max(1e-12);
    0.5 * (cosine.max(0.0) + agreement(&a.seen, &b.seen))
}

/// Object of each region, 1..=K in order of falling number of Gaussians; and K.
///
/// `meanings[k]` is the sum over all pixels that show region k + 1 of a signed description of what they look like.
pub fn join(regions: &Regions, meanings: Vec<Vec<f32>>, least: f32) -> (Vec<u16>, u16) {
    let mut sizes = vec![0u32; meanings.len() + 1];
    regions.of.iter().for_each(|r| sizes[usize::from(*r)] += 1);
    let mut groups: Vec<Option<Group>> = regions
        .seen
        .iter()
        .zip(meanings)
        .enumerate()
        .map(|(k, (seen, meaning))| Some(Group { seen: seen.clone(), meaning, gaussians: sizes[k + 1], members: vec![k as u16] }))
        .collect();
    let mut contacts: BTreeMap<(usize, usize), u32> =
        regions.contacts.iter().map(|(&(a, b), n)| ((usize::from(a) - 1, usize::from(b) - 1), *n)).collect();
    let like = |groups: &[Option<Group>], (a, b): (usize, usize), n: u32| match (&groups[a], &groups[b]) {
        (Some(a), Some(b)) if n as f32 >= TOUCH * a.gaussians.min(b.gaussians) as f32 => likeness(a, b),
        _ => 0.0,
    };
    let mut scores: BTreeMap<(usize, usize), f32> = contacts.iter().map(|(pair, n)| (*pair, like(&groups, *pair, *n))).collect();
    while let Some((&(a, b), _)) = scores.iter().filter(|s| *s.1 >= least).max_by(|x, y| x.1.total_cmp(y.1).then(y.0.cmp(x.0))) {
        let Some(gone) = groups[b].take() else { break };
        if let Some(group) = &mut groups[a] {
            group.seen = merged(&group.seen, &gone.seen);
            group.meaning.iter_mut().zip(&gone.meaning).for_each(|(x, y)| *x += y);
            group.gaussians += gone.gaussians;
            group.members.extend(gone.members);
        }
        let touched: Vec<((usize, usize), u32)> = contacts.iter().filter(|c| c.0.0 == b || c.0.1 == b).map(|c| (*c.0, *c.1)).collect();
        for ((p, q), n) in touched {
            contacts.remove(&(p, q));
            scores.remove(&(p, q));
            let other = if p == b { q } else { p };
            if other != a {
                *contacts.entry((a.min(other), a.max(other))).or_default() += n;
            }
        }
        for (pair, n) in contacts.iter().filter(|c| c.0.0 == a || c.0.1 == a) {
            scores.insert(*pair, like(&groups, *pair, *n));
        }
    }
    let mut whole: Vec<Group> = groups.into_iter().flatten().collect();
    whole.sort_by_key(|g| (std::cmp::Reverse(g.gaussians), g.members[0]));
    let mut object = vec![0u16; regions.seen.len()];
    for (k, group) in whole.iter().enumerate() {
        group.members.iter().for_each(|m| object[usize::from(*m)] = k as u16 + 1);
    }
    (object, whole.len() as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn like_neighbours_join_and_others_do_not() {
        let seen = |label: u16| -> Seen { (0..4).map(|view| ((view, label), 10.0)).collect() };
        let regions = Regions {
            of: vec![1, 1, 2, 2, 3, 3, 4, 4],
            seen: (1..=4).map(seen).collect(),
            contacts: BTreeMap::from([((1, 2), 2), ((2, 3), 2)]),
        };
        // 1 and 2 mean the same and touch; 3 touches but means something else; 4 means the same but is elsewhere.
        let meanings = vec![vec![1.0, 0.1], vec![1.0, 0.0], vec![0.0, 1.0], vec![1.0, 0.0]];
        let (object, count) = join(&regions, meanings, 0.4);
        assert_eq!((object, count), (vec![1, 1, 2, 3], 3));
    }
}
