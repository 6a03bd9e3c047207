//! Observations: blending weights of Gaussians in the atoms of each view's masks, indexed by
//! Gaussian and by mask.

use fastlgs_core::mask_list::AtomTable;
use rayon::prelude::*;

/// Sum of blending weights in pixels, as the upper half of a 32-bit float (error below 0.4 %). A
/// scene has hundreds of millions of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Weight(u16);

impl Weight {
    fn new(pixels: f32) -> Self {
        Self((pixels.to_bits().saturating_add(0x8000) >> 16) as u16)
    }

    fn pixels(self) -> f32 {
        f32::from_bits(u32::from(self.0) << 16)
    }
}

/// Blending weight of one Gaussian on one atom of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observation {
    gaussian: u32,
    atom: u16,
    weight: Weight,
}

impl Observation {
    /// `weight`: sum of blending weights in pixels.
    pub fn new(gaussian: u32, atom: u16, weight: f32) -> Self {
        Self {
            gaussian,
            atom,
            weight: Weight::new(weight),
        }
    }
}

/// An observation, as stored for its Gaussian.
#[derive(Clone, Copy)]
struct Vote {
    view: u16,
    atom: u16,
    weight: Weight,
}

/// Index of a mask among the masks of all views, which are concatenated.
pub type MaskId = u32;

/// Masks of a view with their atoms, and the Gaussians on each atom.
struct ViewMasks {
    /// Index of the view's first mask.
    first: MaskId,
    /// Atoms of each mask.
    atoms: Vec<Vec<u16>>,
    /// Gaussians, sorted by atom.
    gaussians: Vec<u32>,
    /// Blending weight of each of these on its atom.
    weights: Vec<Weight>,
    /// For each atom: index of its first Gaussian, with a final end index.
    begin: Vec<usize>,
}

impl ViewMasks {
    fn new(mut seen: Vec<Observation>, table: &AtomTable, first: MaskId) -> Self {
        seen.sort_by_key(|s| (s.atom, s.gaussian));
        let mut atoms = vec![Vec::new(); table.areas.len()];
        for atom in 0..table.count() {
            table
                .masks(atom as u16)
                .iter()
                .for_each(|m| atoms[usize::from(*m)].push(atom as u16));
        }
        let begin = (0..=table.count())
            .map(|atom| seen.partition_point(|s| usize::from(s.atom) < atom))
            .collect();
        Self {
            first,
            atoms,
            gaussians: seen.iter().map(|s| s.gaussian).collect(),
            weights: seen.iter().map(|s| s.weight).collect(),
            begin,
        }
    }

    /// Iterates over the Gaussians on an atom, with their weights in pixels.
    fn of(&self, atom: u16) -> impl Iterator<Item = (u32, f32)> {
        let own = self.begin[usize::from(atom)]..self.begin[usize::from(atom) + 1];
        self.gaussians[own.clone()]
            .iter()
            .copied()
            .zip(self.weights[own].iter().map(|w| w.pixels()))
    }
}

/// All observations, by Gaussian and by mask.
pub struct Observations<'a> {
    /// Observations sorted by Gaussian, then by view.
    votes: Vec<Vote>,
    /// For each Gaussian: index of its first vote, with a final end index.
    begin: Vec<usize>,
    tables: &'a [AtomTable],
    view_masks: Vec<ViewMasks>,
    /// For each view: index of its first atom among the atoms of all views, with a final end index.
    first_atom: Vec<u32>,
    /// For each mask of all views: total weight of Gaussians in it, in pixels.
    pub pixels: Vec<f32>,
}

/// A mask with its IoU with a set of Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The mask.
    pub mask: MaskId,
    /// IoU of mask and set in the mask's view, 0 to 1.
    pub iou: f32,
}

/// Visibility of a set of Gaussians in a view, with the best mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewFit {
    /// The view.
    pub view: u32,
    /// Total weight of the set in the view, in pixels.
    pub pixels: f32,
    /// Mask with the largest IoU; `None` if no mask overlaps the set.
    pub best: Option<Fit>,
    /// Whether mask and set each contain more than half of the other.
    pub mutual: bool,
}

/// Accumulators that searches reuse; all zero between searches.
pub struct Scratch {
    gaussians: Vec<f32>,
    atoms: Vec<f32>,
    masks: Vec<f32>,
}

/// Smallest weight in pixels for a view to show a set, or for a mask to be used.
pub const MIN_PIXELS: f32 = 30.0;

impl<'a> Observations<'a> {
    /// Indexes the observations of each view. `gaussians`: number of Gaussians; `tables`: mask
    /// tables of all views.
    pub fn new(gaussians: usize, views: Vec<Vec<Observation>>, tables: &'a [AtomTable]) -> Self {
        let mut begin = vec![0usize; gaussians + 1];
        views
            .iter()
            .flatten()
            .for_each(|seen| begin[seen.gaussian as usize + 1] += 1);
        (0..gaussians).for_each(|g| begin[g + 1] += begin[g]);
        let mut next = begin.clone();
        let mut votes = vec![
            Vote {
                view: 0,
                atom: 0,
                weight: Weight(0)
            };
            begin[gaussians]
        ];
        for (view, seen) in views.iter().enumerate() {
            for Observation {
                gaussian,
                atom,
                weight,
            } in seen
            {
                let place = &mut next[*gaussian as usize];
                votes[*place] = Vote {
                    view: view as u16,
                    atom: *atom,
                    weight: *weight,
                };
                *place += 1;
            }
        }
        drop(next);
        let mut first = 0;
        let mut place = |table: &AtomTable| {
            first += table.areas.len() as MaskId;
            first - table.areas.len() as MaskId
        };
        let firsts: Vec<MaskId> = tables.iter().map(&mut place).collect();
        let of_view = |((seen, table), first)| ViewMasks::new(seen, table, first);
        let view_masks: Vec<ViewMasks> = views
            .into_par_iter()
            .zip(tables)
            .zip(firsts)
            .map(of_view)
            .collect();
        let pixels = |view: &ViewMasks| -> Vec<f32> {
            let of_atom: Vec<f32> = (0..view.begin.len() as u32 - 1)
                .map(|a| view.of(a as u16).map(|seen| seen.1).sum())
                .collect();
            view.atoms
                .iter()
                .map(|atoms| atoms.iter().map(|a| of_atom[usize::from(*a)]).sum())
                .collect()
        };
        let pixels = view_masks
            .par_iter()
            .map(pixels)
            .collect::<Vec<_>>()
            .concat();
        let first_atom = (0..=tables.len())
            .map(|v| tables[..v].iter().map(|t| t.count() as u32).sum())
            .collect();
        Self {
            votes,
            begin,
            tables,
            view_masks,
            first_atom,
            pixels,
        }
    }

    /// Allocates accumulators for [`Self::gaussians_in`] and [`Self::matching_masks`].
    pub fn scratch(&self) -> Scratch {
        let atoms = self.first_atom.last().map_or(0, |count| *count as usize);
        Scratch {
            gaussians: vec![0.0; self.gaussians()],
            atoms: vec![0.0; atoms],
            masks: vec![0.0; self.pixels.len()],
        }
    }

    /// Returns the number of Gaussians.
    pub fn gaussians(&self) -> usize {
        self.begin.len() - 1
    }

    /// Returns the number of observations.
    pub fn len(&self) -> usize {
        self.votes.len()
    }

    /// Returns whether there are no observations.
    pub fn is_empty(&self) -> bool {
        self.votes.is_empty()
    }

    /// Returns the memory of all observations in bytes.
    pub fn bytes(&self) -> usize {
        self.len() * (size_of::<Vote>() + size_of::<u32>() + size_of::<Weight>())
    }

    fn votes_of(&self, gaussian: u32) -> &[Vote] {
        &self.votes[self.begin[gaussian as usize]..self.begin[gaussian as usize + 1]]
    }

    /// Returns the weight of a Gaussian in all views, in pixels.
    pub fn weight(&self, gaussian: u32) -> f32 {
        self.votes_of(gaussian)
            .iter()
            .map(|v| v.weight.pixels())
            .sum()
    }

    fn view_of(&self, mask: MaskId) -> usize {
        self.view_masks.partition_point(|view| view.first <= mask) - 1
    }

    /// Returns the masks of each track, if a tracker provided them.
    pub fn tracks(&self) -> Vec<Vec<MaskId>> {
        let mut tracks = std::collections::BTreeMap::<u32, Vec<MaskId>>::new();
        for (table, held) in self.tables.iter().zip(&self.view_masks) {
            for (track, mask) in table
                .tracks
                .iter()
                .zip(held.first..)
                .filter_map(|(track, mask)| Some(((*track)?, mask)))
            {
                tracks.entry(track).or_default().push(mask);
            }
        }
        tracks.into_values().collect()
    }

    /// Returns the Gaussians with more than half of their weight in `masks`, in ascending order.
    /// Counts only the views of these masks; expects at most one mask for each view.
    pub fn gaussians_in(
        &self,
        masks: impl Iterator<Item = MaskId>,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        let (mut met, mut asked) = (Vec::new(), vec![0.0; self.tables.len()]);
        for mask in masks {
            let view = self.view_of(mask);
            asked[view] = 1.0;
            let held = &self.view_masks[view];
            for (g, pixels) in held.atoms[(mask - held.first) as usize]
                .iter()
                .flat_map(|atom| held.of(*atom))
            {
                add(&mut scratch.gaussians, g, pixels, &mut met);
            }
        }
        let mut met = sorted_unique(met);
        met.retain(|g| {
            let inside = std::mem::take(&mut scratch.gaussians[*g as usize]);
            2.0 * inside > weight_in(self.votes_of(*g), &asked)
        });
        met
    }

    /// Returns the best mask of each view, where mask and set each contain more than half of the
    /// other.
    pub fn matching_masks(&self, set: &[u32], scratch: &mut Scratch) -> Vec<Fit> {
        self.view_fits(set, scratch)
            .into_iter()
            .filter(|shown| shown.mutual)
            .filter_map(|shown| shown.best)
            .collect()
    }

    /// Returns all views in which the set has at least [`MIN_PIXELS`], in ascending order.
    pub fn view_fits(&self, set: &[u32], scratch: &mut Scratch) -> Vec<ViewFit> {
        let mut atoms = Vec::new();
        for vote in set.iter().flat_map(|g| self.votes_of(*g)) {
            let atom = self.first_atom[usize::from(vote.view)] + u32::from(vote.atom);
            add(&mut scratch.atoms, atom, vote.weight.pixels(), &mut atoms);
        }
        let (mut met, mut shown) = (Vec::new(), vec![0.0f32; self.tables.len()]);
        for atom in sorted_unique(atoms) {
            let weight = std::mem::take(&mut scratch.atoms[atom as usize]);
            let view = self.first_atom.partition_point(|first| *first <= atom) - 1;
            shown[view] += weight;
            for mask in self.tables[view].masks((atom - self.first_atom[view]) as u16) {
                add(
                    &mut scratch.masks,
                    self.view_masks[view].first + MaskId::from(*mask),
                    weight,
                    &mut met,
                );
            }
        }
        let mut best: Vec<(Option<Fit>, bool)> = vec![(None, false); self.tables.len()];
        for mask in sorted_unique(met) {
            let common = std::mem::take(&mut scratch.masks[mask as usize]);
            let view = self.view_of(mask);
            let (own, whole) = (shown[view], self.pixels[mask as usize]);
            let iou = common / (own + whole - common);
            if best[view].0.is_none_or(|fit| iou > fit.iou) {
                best[view] = (Some(Fit { mask, iou }), 2.0 * common > own.max(whole));
            }
        }
        let views = (0..)
            .zip(shown)
            .zip(best)
            .map(|((view, pixels), (best, mutual))| ViewFit {
                view,
                pixels,
                best,
                mutual,
            });
        views.filter(|shown| shown.pixels >= MIN_PIXELS).collect()
    }
}

/// Returns the weight of votes in pixels, each times the factor of its view.
fn weight_in(votes: &[Vote], factors: &[f32]) -> f32 {
    // Without branches, and with four sums side by side: this loop takes much of the mapping's time.
    let weighted = |vote: &Vote| factors[usize::from(vote.view)] * vote.weight.pixels();
    let (fours, rest) = votes.as_chunks::<4>();
    let mut sums = [0.0f32; 4];
    for four in fours {
        (0..4).for_each(|k| sums[k] += weighted(&four[k]));
    }
    sums.iter().sum::<f32>() + rest.iter().map(weighted).sum::<f32>()
}

/// Adds `weight` to `sums[of]`, and appends `of` to `met` if the sum was 0.
fn add(sums: &mut [f32], of: u32, weight: f32, met: &mut Vec<u32>) {
    let sum = &mut sums[of as usize];
    if *sum == 0.0 {
        met.push(of);
    }
    *sum += weight;
}

/// Sorts and removes duplicates, which occur if a sum stays 0.
fn sorted_unique(mut met: Vec<u32>) -> Vec<u32> {
    met.sort_unstable();
    met.dedup();
    met
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    #[test]
    fn weights_keep_three_digits() {
        for weight in [0.02, 1.0, 3.3, 700.0, 1e6] {
            assert!(
                (Weight::new(weight).pixels() / weight - 1.0).abs() < 0.005,
                "{weight}"
            );
        }
    }

    #[test]
    fn masks_hold_gaussians_and_fit_them() {
        // Ten Gaussians in a row, 40 pixels each in both views. View 0 has masks of 0..4 and 0..2,
        // view 1 of 0..5.
        let atoms = |ends: &[u32], track: Option<u32>| {
            let mask = |end: &u32| Mask {
                track,
                ..Mask::new(Level::Whole, RunLengths::from_fn(10, 1, |x, _| x < *end))
            };
            MaskList {
                masks: ends.iter().map(mask).collect(),
                ..MaskList::new(10, 1)
            }
            .atoms()
        };
        let atoms = [atoms(&[4, 2], None), atoms(&[5], Some(7))];
        let tables = atoms.each_ref().map(|a| a.table.clone());
        let seen = atoms
            .iter()
            .map(|a| {
                (0..10)
                    .map(|g| Observation::new(g, a.map.at(g, 0), 40.0))
                    .collect()
            })
            .collect();
        let sightings = Observations::new(10, seen, &tables);
        assert_eq!(
            (
                sightings.pixels.as_slice(),
                sightings.weight(3),
                sightings.tracks()
            ),
            (&[160.0, 80.0, 200.0][..], 80.0, vec![vec![2]])
        );
        let mut scratch = sightings.scratch();
        assert_eq!(
            sightings.gaussians_in([1].into_iter(), &mut scratch),
            [0, 1]
        );
        assert_eq!(
            sightings.gaussians_in([0, 2].into_iter(), &mut scratch),
            [0, 1, 2, 3],
            "exactly half of Gaussian 4 lies in the masks, not more"
        );
        assert_eq!(
            sightings.matching_masks(&[0, 1, 2, 3], &mut scratch),
            [Fit { mask: 0, iou: 1.0 }, Fit { mask: 2, iou: 0.8 }]
        );
        // The set contains half of mask 0..4, which is not enough. Mask 0..5 and the set share
        // three of five Gaussians each.
        assert_eq!(
            sightings.matching_masks(&[2, 3, 4, 5, 6], &mut scratch),
            [Fit {
                mask: 2,
                iou: 3.0 / 7.0
            }]
        );
        // Masks 0..4 and 0..5 contain the whole set, but the set contains less than half of them.
        assert_eq!(sightings.matching_masks(&[2], &mut scratch), []);
        assert_eq!(
            sightings
                .view_fits(&[2], &mut scratch)
                .iter()
                .map(|shown| shown.best.is_some())
                .collect::<Vec<_>>(),
            [true, true]
        );
        assert_eq!(sightings.matching_masks(&[8], &mut scratch), []);
        assert!(
            [scratch.gaussians, scratch.atoms, scratch.masks]
                .concat()
                .iter()
                .all(|sum| *sum == 0.0)
        );
    }
}
