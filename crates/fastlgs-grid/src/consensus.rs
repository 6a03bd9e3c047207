//! Global mapping, first step: regions of Gaussians that most views show inside one mask.
//!
//! Every view votes on every border: neighbouring regions are joined, most agreed first, while the views that see both
//! put them into the same mask more often than not. The order of the photos plays no part, a wrong mask in one view is
//! outvoted by the others, and what one view cuts apart or glues together the majority mends.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// What a Gaussian sees: weight of (view, label); label 0 is what no mask covers.
pub type Seen = Vec<((u16, u16), f32)>;

/// Constants of the consensus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Agreement from which neighbours are one region.
    pub agreement: f32,
    /// Fewest views that must show a region.
    pub min_views: usize,
    /// Smallest region: mean share of the pixels of the views that show it.
    pub min_share: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self { agreement: 0.5, min_views: 3, min_share: 0.0005 }
    }
}

/// Pixels that both regions must cover in a view before its vote counts half.
const HALF_WEIGHT: f32 = 3.0;

/// A set of Gaussians: its sorted votes and its neighbours.
struct Region {
    seen: Seen,
    near: BTreeSet<u32>,
    version: u32,
}

/// Weighted mean over the views that see both of the cosine between their label distributions; 0 where none does.
///
/// Uncovered pixels agree with nothing, and a view that covers neither region has no vote.
pub(crate) fn agreement(a: &Seen, b: &Seen) -> f32 {
    let (mut i, mut j) = (0, 0);
    let (mut sum, mut total) = (0.0, 0.0);
    while i < a.len() && j < b.len() {
        let (va, vb) = (a[i].0.0, b[j].0.0);
        if va != vb {
            if va < vb {
                i += 1
            } else {
                j += 1
            }
            continue;
        }
        let (mut dot, mut aa, mut bb, mut wa, mut wb) = (0.0, 0.0, 0.0, 0.0f32, 0.0f32);
        let mut uncovered = 0.0;
        while (i < a.len() && a[i].0.0 == va) || (j < b.len() && b[j].0.0 == va) {
            let la = a.get(i).filter(|e| e.0.0 == va).map_or(u32::MAX, |e| u32::from(e.0.1));
            let lb = b.get(j).filter(|e| e.0.0 == va).map_or(u32::MAX, |e| u32::from(e.0.1));
            let (mut x, mut y) = (0.0, 0.0);
            if la <= lb {
                x = a[i].1;
                i += 1;
            }
            if lb <= la {
                y = b[j].1;
                j += 1;
            }
            if la.min(lb) == 0 {
                uncovered = x * y
            } else {
                dot += x * y
            }
            aa += x * x;
            bb += y * y;
            wa += x;
            wb += y;
        }
        let common = wa.min(wb);
        let weight = common / (common + HALF_WEIGHT) * (1.0 - uncovered / (wa * wb).max(1e-12));
        sum += weight * dot / (aa * bb).sqrt().max(1e-12);
        total += weight;
    }
    if total > 1e-6 { sum / total } else { 0.0 }
}

/// Sum of two sorted vote lists.
pub(crate) fn merged(a: &Seen, b: &Seen) -> Seen {
    let mut out = Vec::with_capacity(a.len() + b.len());
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let order = match (a.get(i), b.get(j)) {
            (Some(x), Some(y)) => x.0.cmp(&y.0),
            (Some(_), None) => std::cmp::Ordering::Less,
            _ => std::cmp::Ordering::Greater,
        };
        match order {
            std::cmp::Ordering::Less => {
                out.push(a[i]);
                i += 1;
            }
            std::cmp::Ordering::Greater => {
                out.push(b[j]);
                j += 1;
            }
            std::cmp::Ordering::Equal => {
                out.push((a[i].0, a[i].1 + b[j].1));
                i += 1;
                j += 1;
            }
        }
    }
    out
}

/// What the views agree on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Regions {
    /// Region of each Gaussian, 1..=K in order of falling weight; 0 for none.
    pub of: Vec<u16>,
    /// The votes of region k + 1.
    pub seen: Vec<Seen>,
    /// Pairs of neighbouring Gaussians that each pair of regions (a < b) shares.
    pub contacts: BTreeMap<(u16, u16), u32>,
}

/// Joins Gaussians to regions.
///
/// `seen` holds each Gaussian's votes sorted by (view, label); `near` the pairs of neighbours; `pixels` those of a view.
pub fn regions(mut seen: Vec<Seen>, near: &[(u32, u32)], pixels: usize, config: &Config) -> Regions {
    let n = seen.len();
    // A Gaussian that mostly shows where no mask is belongs to no object.
    for votes in &mut seen {
        let weight = |covered: bool| votes.iter().filter(|v| (v.0.1 > 0) == covered).map(|v| v.1).sum::<f32>();
        if weight(false) > weight(true) {
            votes.clear();
        }
    }
    let mut regions: Vec<Region> = seen.into_iter().map(|seen| Region { seen, near: BTreeSet::new(), version: 0 }).collect();
    for &(a, b) in near {
        regions[a as usize].near.insert(b);
        regions[b as usize].near.insert(a);
    }
    let mut owner: Vec<u32> = (0..n as u32).collect();
    // The heap holds (agreement as bits, Reverse of both, versions): the highest agreement first, ties by number.
    let mut queue = BinaryHeap::new();
    let entry = |regions: &[Region], a: u32, b: u32| {
        let (a, b) = (a.min(b), a.max(b));
        let (ra, rb) = (&regions[a as usize], &regions[b as usize]);
        let agreed = agreement(&ra.seen, &rb.seen);
        (agreed >= config.agreement).then_some((agreed.to_bits(), Reverse((a, b)), ra.version, rb.version))
    };
    queue.extend(near.iter().filter_map(|&(a, b)| entry(&regions, a, b)));
    while let Some((_, Reverse((a, b)), va, vb)) = queue.pop() {
        if owner[a as usize] != a || owner[b as usize] != b {
            continue;
        }
        if regions[a as usize].version != va || regions[b as usize].version != vb {
            // One of them has grown since: ask the views again.
            queue.extend(entry(&regions, a, b));
            continue;
        }
        // The one with more neighbours swallows the other.
        let (keep, gone) = if regions[a as usize].near.len() >= regions[b as usize].near.len() { (a, b) } else { (b, a) };
        let other = std::mem::replace(&mut regions[gone as usize], Region { seen: Vec::new(), near: BTreeSet::new(), version: u32::MAX });
        owner[gone as usize] = keep;
        let region = &mut regions[keep as usize];
        region.seen = merged(&region.seen, &other.seen);
        region.version += 1;
        region.near.remove(&gone);
        for &c in other.near.iter().filter(|c| **c != keep) {
            regions[c as usize].near.remove(&gone);
            let new = regions[c as usize].near.insert(keep);
            regions[keep as usize].near.insert(c);
            if new {
                queue.extend(entry(&regions, keep, c));
            }
        }
    }
    let mut out = number(&owner, &mut regions, pixels, config);
    for &(a, b) in near {
        let (a, b) = (out.of[a as usize], out.of[b as usize]);
        if a != b && a.min(b) > 0 {
            *out.contacts.entry((a.min(b), a.max(b))).or_default() += 1;
        }
    }
    out
}

/// Drops what is too small or seen too rarely, and numbers the rest.
fn number(owner: &[u32], regions: &mut [Region], pixels: usize, config: &Config) -> Regions {
    let mut kept: Vec<(u32, f32)> = (0..owner.len() as u32)
        .filter(|&i| owner[i as usize] == i)
        .filter_map(|i| {
            let mut by_view: BTreeMap<u16, f32> = BTreeMap::new();
            regions[i as usize].seen.iter().for_each(|((view, _), w)| *by_view.entry(*view).or_default() += w);
            let total: f32 = by_view.values().sum();
            let share = total / (by_view.len().max(1) * pixels) as f32;
            (by_view.len() >= config.min_views && share >= config.min_share).then_some((i, total))
        })
        .collect();
    kept.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    kept.truncate(usize::from(u16::MAX));
    let ids: BTreeMap<u32, u16> = kept.iter().enumerate().map(|(k, r)| (r.0, k as u16 + 1)).collect();
    let root = |mut i: u32| {
        while owner[i as usize] != i {
            i = owner[i as usize];
        }
        i
    };
    Regions {
        of: (0..owner.len() as u32).map(|i| ids.get(&root(i)).copied().unwrap_or(0)).collect(),
        seen: kept.iter().map(|r| std::mem::take(&mut regions[r.0 as usize].seen)).collect(),
        contacts: BTreeMap::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A row of 12 Gaussians; the true border lies between 5 and 6. View 2 cuts the left part in two, view 3 glues both.
    fn row(order: [u16; 5]) -> Vec<Seen> {
        (0..12u16)
            .map(|g| {
                let side = u16::from(g >= 6);
                let label = |view: usize| match view {
                    2 => {
                        if g < 3 {
                            7
                        } else {
                            side + 1
                        }
                    }
                    3 => 9,
                    _ => side + 1,
                };
                let mut seen: Seen = (0..5).map(|v| ((order[v], label(v)), 50.0)).collect();
                seen.sort_by_key(|s| s.0);
                seen
            })
            .collect()
    }

    #[test]
    fn the_majority_of_views_decides_and_their_order_does_not() {
        let near: Vec<(u32, u32)> = (0..11).map(|i| (i, i + 1)).collect();
        let config = Config { min_share: 0.0, ..Config::default() };
        let found = regions(row([0, 1, 2, 3, 4]), &near, 1000, &config);
        let ids = &found.of;
        assert_eq!((found.seen.len(), &found.contacts), (2, &BTreeMap::from([((1, 2), 1)])));
        assert!(ids[..6].iter().all(|i| *i == ids[0]) && ids[6..].iter().all(|i| *i == ids[6]) && ids[0] != ids[6]);
        let shuffled = regions(row([4, 2, 0, 1, 3]), &near, 1000, &config);
        assert_eq!(ids, &shuffled.of);
    }

    #[test]
    fn what_few_views_show_is_no_object() {
        let near: Vec<(u32, u32)> = (0..11).map(|i| (i, i + 1)).collect();
        let found = regions(row([0, 1, 2, 3, 4]), &near, 1000, &Config { min_views: 6, ..Config::default() });
        assert_eq!((found.seen.len(), found.of.iter().max()), (0, Some(&0)));
    }
}
