//! What Gaussians see of the photos' masks, which may overlap, and how much two of them agree in it.

use fastlgs_core::mask_list::Table;

/// How much of a Gaussian falls on an atom of a view: six bytes, since a scene has hundreds of millions of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vote {
    /// Index of the training view.
    pub view: u16,
    /// Atom of the view's masks.
    pub atom: u16,
    /// Upper half of a 32-bit float.
    weight: u16,
}

impl Vote {
    /// `weight`: sum of blending weights, in pixels.
    pub fn new(view: u16, atom: u16, weight: f32) -> Self {
        Self { view, atom, weight: (weight.to_bits().saturating_add(0x8000) >> 16) as u16 }
    }

    /// Sum of blending weights in pixels, to three digits.
    pub fn weight(self) -> f32 {
        f32::from_bits(u32::from(self.weight) << 16)
    }
}

/// What a set of Gaussians sees of all views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seen {
    /// Rising by view.
    views: Vec<InView>,
    /// (mask, weight there) of one view after the other, rising by mask.
    masks: Vec<(u32, f32)>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct InView {
    view: u16,
    /// How many of the masks are of this view.
    masks: u32,
    /// Pixels.
    weight: f32,
    /// Those that no mask covers.
    uncovered: f32,
}

/// Pixels that both must cover in a view before its vote counts half.
const HALF_WEIGHT: f32 = 3.0;

impl Seen {
    /// What one Gaussian sees. `votes` rise by view; `tables` are those of all views.
    pub fn of(votes: &[Vote], tables: &[Table]) -> Self {
        let mut seen = Self::default();
        let mut tracked = InView { view: tables.len() as u16, masks: 0, weight: 0.0, uncovered: 0.0 };
        let mut tracks: Vec<(u32, f32)> = Vec::new();
        for votes in votes.chunk_by(|a, b| a.view == b.view) {
            let table = &tables[usize::from(votes[0].view)];
            let first = seen.masks.len();
            let (mut weight, mut uncovered) = (0.0, 0.0);
            for vote in votes {
                let (own, masks) = (vote.weight(), table.masks(vote.atom));
                weight += own;
                uncovered += if masks.is_empty() { own } else { 0.0 };
                for &mask in masks {
                    seen.masks.push((u32::from(mask), own));
                    if let Some(track) = table.tracks[usize::from(mask)] {
                        tracks.push((track, own));
                    }
                }
                let has_track = masks.iter().any(|m| table.tracks[usize::from(*m)].is_some());
                tracked.weight += if has_track { own } else { 0.0 };
            }
            add_up(&mut seen.masks, first);
            seen.views.push(InView { view: votes[0].view, masks: (seen.masks.len() - first) as u32, weight, uncovered });
        }
        // What a tracker says of all views is one more voice.
        if !tracks.is_empty() {
            let first = seen.masks.len();
            seen.masks.extend(tracks);
            add_up(&mut seen.masks, first);
            seen.views.push(InView { masks: (seen.masks.len() - first) as u32, ..tracked });
        }
        seen
    }

    /// Whether masks cover most of it.
    pub fn is_covered(&self) -> bool {
        self.views.iter().map(|v| v.weight - 2.0 * v.uncovered).sum::<f32>() > 0.0
    }

    /// Sum of the weights of all views.
    pub fn weight(&self) -> f32 {
        self.views.iter().map(|v| v.weight).sum()
    }

    /// The largest weight that so many of `views` views reach; 0 where fewer show it.
    pub fn reached_by(&self, count: usize, views: usize) -> f32 {
        let mut weights: Vec<f32> = self.views.iter().filter(|v| usize::from(v.view) < views).map(|v| v.weight).collect();
        weights.sort_by(|a, b| b.total_cmp(a));
        weights.get(count.saturating_sub(1)).copied().unwrap_or(0.0)
    }

    /// Each view with its masks.
    fn blocks(&self) -> impl Iterator<Item = (&InView, &[(u32, f32)])> {
        let mut rest = self.masks.as_slice();
        self.views.iter().map(move |view| {
            let (own, after) = rest.split_at(view.masks as usize);
            rest = after;
            (view, own)
        })
    }

    /// How many masks hold both, as the mean over the views that see both. So parts of a thing, which their own masks hold and the thing's,
    /// agree before things do that lie on one table, a mask that was found at several levels has a voice at each, and one wrong mask is outvoted.
    /// (Weighing masks by how small they are lets every leak of a small mask outvote the large ones: fox 0.60 instead of 0.85.)
    ///
    /// Uncovered pixels agree with nothing, and a view that covers neither has no voice.
    pub fn agreement(&self, other: &Self) -> f32 {
        let (mut sum, mut total) = (0.0, 0.0);
        let (mut ours, mut theirs) = (self.blocks().peekable(), other.blocks().peekable());
        while let (Some((a, masks_a)), Some((b, masks_b))) = (ours.peek(), theirs.peek()) {
            if a.view != b.view {
                if a.view < b.view {
                    ours.next();
                } else {
                    theirs.next();
                }
                continue;
            }
            let common = a.weight.min(b.weight);
            let all = (a.weight * b.weight).max(1e-12);
            let voice = common / (common + HALF_WEIGHT) * (1.0 - a.uncovered * b.uncovered / all);
            sum += voice * dot(masks_a, masks_b) / all;
            total += voice;
            ours.next();
            theirs.next();
        }
        if total > 1e-6 { sum / total } else { 0.0 }
    }

    /// What both see together.
    pub fn merged(&self, other: &Self) -> Self {
        let mut out = Self { views: Vec::with_capacity(self.views.len()), masks: Vec::with_capacity(self.masks.len() + other.masks.len()) };
        let (mut ours, mut theirs) = (self.blocks().peekable(), other.blocks().peekable());
        loop {
            let view = match (ours.peek(), theirs.peek()) {
                (None, None) => break,
                (Some(a), None) => a.0.view,
                (None, Some(b)) => b.0.view,
                (Some(a), Some(b)) => a.0.view.min(b.0.view),
            };
            let first = out.masks.len();
            let mut whole = InView { view, masks: 0, weight: 0.0, uncovered: 0.0 };
            for side in [ours.next_if(|b| b.0.view == view), theirs.next_if(|b| b.0.view == view)].into_iter().flatten() {
                whole.weight += side.0.weight;
                whole.uncovered += side.0.uncovered;
                out.masks.extend_from_slice(side.1);
            }
            add_up(&mut out.masks, first);
            out.views.push(InView { masks: (out.masks.len() - first) as u32, ..whole });
        }
        out
    }
}

/// Sum over the masks that both have.
fn dot(a: &[(u32, f32)], b: &[(u32, f32)]) -> f32 {
    let (few, many) = if a.len() < b.len() { (a, b) } else { (b, a) };
    let (mut sum, mut rest) = (0.0, many);
    for &(mask, weight) in few {
        // A single Gaussian has few masks, what it may join has hundreds.
        let at =
            if many.len() > 8 * few.len() { rest.partition_point(|m| m.0 < mask) } else { rest.iter().take_while(|m| m.0 < mask).count() };
        rest = &rest[at..];
        sum += rest.first().filter(|m| m.0 == mask).map_or(0.0, |m| m.1 * weight);
    }
    sum
}

/// Sorts what lies from `first` on by mask and sums what belongs to one.
fn add_up(masks: &mut Vec<(u32, f32)>, first: usize) {
    // Stable, so that sums are the same in every run.
    masks[first..].sort_by_key(|m| m.0);
    let mut last = first;
    for k in first + 1..masks.len() {
        if masks[k].0 == masks[last].0 {
            masks[last].1 += masks[k].1;
        } else {
            last += 1;
            masks[last] = masks[k];
        }
    }
    masks.truncate(masks.len().min(last + 1));
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    /// Ten pixels: a saucer of 8 with a cup of 4 on it, which has a handle of 1.
    fn table(tracks: [Option<u32>; 3]) -> Table {
        let masks = [0..8, 2..6, 2..3].into_iter().zip(tracks).map(|(range, track)| {
            let runs = RunLengths::of(10, 1, |x, _| range.contains(&x));
            Mask { track, ..Mask::new(Level::Whole, runs) }
        });
        MaskList { masks: masks.collect(), ..MaskList::new(10, 1) }.atoms().table
    }

    fn seen(tables: &[Table], votes: &[(u16, &[u16], f32)]) -> Seen {
        let atom = |view: u16, masks: &[u16]| (0..=3).find(|a| tables[usize::from(view)].masks(*a) == masks).expect("an atom");
        let votes: Vec<Vote> = votes.iter().map(|&(view, masks, weight)| Vote::new(view, atom(view, masks), weight)).collect();
        Seen::of(&votes, tables)
    }

    #[test]
    fn votes_keep_three_digits() {
        for weight in [0.02, 1.0, 3.3, 700.0, 1e6] {
            assert!((Vote::new(0, 0, weight).weight() / weight - 1.0).abs() < 0.005, "{weight}");
        }
    }

    #[test]
    fn the_more_masks_hold_both_the_more_two_agree() {
        let tables = [table([None; 3]), table([None; 3])];
        let [handle, cup, saucer, nothing]: [&[u16]; 4] = [&[0, 1, 2], &[0, 1], &[0], &[]];
        let of = |masks: &[u16]| seen(&tables, &[(0, masks, 50.0), (1, masks, 50.0)]);
        let [handle, cup, saucer, nothing] = [handle, cup, saucer, nothing].map(of);
        let pairs = [(&handle, &handle), (&cup, &handle), (&cup, &cup), (&cup, &saucer), (&handle, &saucer), (&cup, &nothing)];
        for ((a, b), masks) in pairs.into_iter().zip([3.0, 2.0, 2.0, 1.0, 1.0, 0.0]) {
            assert!((a.agreement(b) - masks).abs() < 1e-5, "{} instead of {masks}", a.agreement(b));
        }
        assert_eq!(nothing.agreement(&nothing), 0.0);
        assert!(cup.is_covered() && !nothing.is_covered());
        let half = seen(&tables, &[(0, &[0, 1], 50.0), (1, &[0], 50.0)]);
        assert!((half.agreement(&cup) - 1.5).abs() < 1e-5, "views have one voice each");
    }

    #[test]
    fn merging_adds_up() {
        let tables = [table([None; 3]), table([None; 3])];
        let a = seen(&tables, &[(0, &[0, 1], 4.0), (1, &[], 2.0)]);
        let b = seen(&tables, &[(0, &[0], 8.0), (0, &[], 1.0)]);
        let both = a.merged(&b);
        assert_eq!(both, b.merged(&a));
        assert_eq!((both.weight(), both.reached_by(1, 2), both.reached_by(2, 2), both.reached_by(3, 2)), (15.0, 13.0, 2.0, 0.0));
        assert_eq!(both.masks, [(0, 12.0), (1, 4.0)]);
        assert_eq!(both.views.iter().map(|v| v.uncovered).collect::<Vec<_>>(), [1.0, 2.0]);
    }

    #[test]
    fn a_tracker_is_one_more_voice() {
        let tables = [table([None, Some(5), None]), table([None, Some(5), Some(6)])];
        let (a, b) = (seen(&tables, &[(0, &[0, 1], 50.0)]), seen(&tables, &[(1, &[0, 1], 50.0)]));
        assert!((a.agreement(&b) - 1.0).abs() < 1e-5, "no photo sees both, but the tracker knows them");
        let other = seen(&tables, &[(1, &[0], 50.0)]);
        assert_eq!(a.agreement(&other), 0.0);
        assert_eq!(a.reached_by(2, 2), 0.0, "it is no view");
    }
}
