//! Global mapping, step 4: the sets that masks support become objects, which may overlap.

use crate::consensus::Proposal;
use crate::grid::PART;
use crate::observations::Observations;
use crate::overlaps::{self, Overlaps};
use crate::support::Support;

/// Conditions for a set to be an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelectionConfig {
    /// Smallest number of views that show it, each with at least
    /// [`MIN_PIXELS`](crate::observations::MIN_PIXELS). Views of fewer pixels are ignored.
    pub min_views: usize,
    /// Smallest support: mean IoU with masks, 0 to 1.
    pub min_support: f32,
    /// Largest IoU of two objects. Of more similar sets only the best supported one is an object.
    pub same: f32,
}

impl Default for SelectionConfig {
    fn default() -> Self {
        Self {
            min_views: 3,
            min_support: 0.5,
            same: 0.7,
        }
    }
}

/// The objects and the ids of the Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chosen {
    /// For each Gaussian: id of its object or of its overlap list, see [`Overlaps`]; 0 for none.
    pub ids: Vec<u16>,
    /// For each object k + 1: the smallest object that it is a part of; 0 for none.
    pub parents: Vec<u16>,
    /// Object lists for the ids above those of the objects.
    pub overlaps: Overlaps,
    /// For each id, 0 included: area of its Gaussians summed over all views, in units of a view's
    /// area.
    pub id_areas: Vec<f32>,
    /// Support of each object by masks.
    pub support: Vec<Support>,
    /// Numbers of rejected sets: with too few views; with too little support; duplicates, or sets
    /// beyond the limit of 16-bit ids.
    pub dropped: [usize; 3],
}

impl Chosen {
    /// Returns for each id the objects that it denotes, smallest first.
    pub fn lists(&self) -> Vec<Vec<u16>> {
        self.overlaps.lists(&self.parents)
    }
}

/// Selects the objects among the sets and numbers them 1..=K in descending order of size.
///
/// Masks of neighbouring objects differ in their common border, and one view may merge what another
/// separates. So the sets overlap, and all of them are kept. A Gaussian belongs to each object
/// whose set contains it.
///
/// `pixels`: mean number of pixels of a view.
pub fn choose(
    observations: &Observations,
    sets: Vec<Proposal>,
    support: Vec<Support>,
    pixels: usize,
    config: &SelectionConfig,
) -> Chosen {
    let mut chosen = Chosen::default();
    let left = supported(sets, support, config, &mut chosen.dropped);
    let weights: Vec<f32> = (0..observations.gaussians() as u32)
        .map(|g| observations.weight(g))
        .collect();
    let weight = |set: &[u32]| -> f32 { set.iter().map(|g| weights[*g as usize]).sum() };
    let mut kept = SetsByGaussian::new(weights.len());
    let mut objects: Vec<(f32, Proposal, Support)> = Vec::new();
    for (set, support) in left {
        let size = weight(&set.set);
        let alike = kept
            .common(&set.set, &weights)
            .into_iter()
            .any(|(other, common)| common > config.same * (size + objects[other].0 - common));
        if alike || objects.len() == usize::from(u16::MAX) - 1 {
            chosen.dropped[2] += 1;
            continue;
        }
        kept.add(objects.len(), &set.set);
        objects.push((size, set, support));
    }
    objects.sort_by(|a, b| b.0.total_cmp(&a.0));

    let mut holders = SetsByGaussian::new(weights.len());
    for (place, (size, set, _)) in objects.iter().enumerate() {
        let around = holders
            .common(&set.set, &weights)
            .into_iter()
            .filter(|(_, common)| *common > PART * size)
            .map(|(other, _)| other as u16 + 1);
        chosen.parents.push(around.max().unwrap_or(0));
        holders.add(place, &set.set);
    }
    let list = |objects: Vec<u32>| {
        let places = objects.into_iter().rev();
        places.map(|place| place as u16 + 1).collect()
    };
    let lists: Vec<Vec<u16>> = holders.of.into_iter().map(list).collect();
    (chosen.overlaps, chosen.ids) =
        Overlaps::of(&lists, &chosen.parents, &weights, overlaps::LISTED_SHARE);
    let shown: Vec<f32> = weights
        .iter()
        .map(|weight| weight / pixels as f32)
        .collect();
    chosen.id_areas = chosen
        .overlaps
        .sums(chosen.parents.len(), &chosen.ids, &shown);
    chosen.support = objects.into_iter().map(|o| o.2).collect();
    chosen
}

/// Returns the sets that enough views show with enough support, in descending order of support.
/// Counts the others by reason.
fn supported(
    sets: Vec<Proposal>,
    support: Vec<Support>,
    config: &SelectionConfig,
    dropped: &mut [usize; 3],
) -> Vec<(Proposal, Support)> {
    let mut left: Vec<(Proposal, Support)> = Vec::new();
    for (set, support) in sets.into_iter().zip(support) {
        if support.views.len() < config.min_views {
            dropped[0] += 1;
        } else if support.iou < config.min_support {
            dropped[1] += 1;
        } else {
            left.push((set, support));
        }
    }
    left.sort_by(|(a, of_a), (b, of_b)| {
        let masks = |set: &Proposal| set.masks.iter().map(|f| f.mask).collect::<Vec<_>>();
        let by_support = of_b.iou.total_cmp(&of_a.iou);
        by_support.then_with(|| masks(a).cmp(&masks(b)))
    });
    left
}

/// For each Gaussian, the sets that contain it, in order of insertion.
struct SetsByGaussian {
    of: Vec<Vec<u32>>,
    sums: Vec<f32>,
}

impl SetsByGaussian {
    fn new(gaussians: usize) -> Self {
        Self {
            of: vec![Vec::new(); gaussians],
            sums: Vec::new(),
        }
    }

    fn add(&mut self, place: usize, set: &[u32]) {
        set.iter()
            .for_each(|g| self.of[*g as usize].push(place as u32));
        self.sums.resize(place + 1, 0.0);
    }

    /// Returns the sets that share Gaussians with `set`, each with the weight of the shared ones.
    fn common(&mut self, set: &[u32], weights: &[f32]) -> Vec<(usize, f32)> {
        let mut met = Vec::new();
        for g in set {
            for other in &self.of[*g as usize] {
                let sum = &mut self.sums[*other as usize];
                if *sum == 0.0 {
                    met.push(*other as usize);
                }
                *sum += weights[*g as usize];
            }
        }
        met.sort_unstable();
        met.dedup();
        met.into_iter()
            .map(|other| (other, std::mem::take(&mut self.sums[other])))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observations::Observation;
    use crate::support::ViewSupport;
    use std::collections::BTreeSet;

    /// Returns the objects of sets of 20 Gaussians with these supports. Each Gaussian covers 100
    /// pixels in each of four views of 10,000.
    fn chosen(sets: &[(std::ops::Range<u32>, f32)], config: &SelectionConfig) -> Chosen {
        let seen = (0..20).map(|g| Observation::new(g, 0, 400.0)).collect();
        let table = fastlgs_core::MaskList::new(1, 1).atoms().table;
        let proposals = sets
            .iter()
            .map(|(set, _)| Proposal {
                set: set.clone().collect(),
                masks: Vec::new(),
            })
            .collect();
        let support = |(set, iou): &(std::ops::Range<u32>, f32)| Support {
            iou: *iou,
            views: (0..4)
                .map(|view| ViewSupport {
                    view,
                    pixels: 100 * set.len() as u32,
                    iou: *iou,
                })
                .collect(),
        };
        choose(
            &Observations::new(20, vec![seen], &[table]),
            proposals,
            sets.iter().map(support).collect(),
            10_000,
            config,
        )
    }

    #[test]
    fn supported_sets_become_overlapping_objects_in_descending_size() {
        // A part that extends beyond its object, an object, an unsupported part, and a neighbour
        // that overlaps the object.
        let found = chosen(
            &[(1..5, 0.9), (2..12, 0.8), (6..9, 0.2), (10..16, 1.0)],
            &SelectionConfig::default(),
        );
        assert_eq!(
            (found.parents.as_slice(), found.dropped),
            (&[0, 0, 1][..], [0, 1, 0])
        );
        let lists = found.lists();
        let of: Vec<&[u16]> = found
            .ids
            .iter()
            .map(|id| lists[usize::from(*id)].as_slice())
            .collect();
        let all: [(&[u16], usize); 7] = [
            (&[], 1),
            (&[3], 1),
            (&[3, 1], 3),
            (&[1], 5),
            (&[2, 1], 2),
            (&[2], 4),
            (&[], 4),
        ];
        assert_eq!(
            of,
            all.iter()
                .flat_map(|(list, count)| vec![*list; *count])
                .collect::<Vec<_>>()
        );
        assert_eq!(
            overlaps::layers(&found.lists(), found.parents.len()),
            [BTreeSet::from([1]), BTreeSet::from([2, 3])]
        );
        assert_eq!(
            chosen(
                &[(0..5, 0.9)],
                &SelectionConfig {
                    min_views: 5,
                    ..SelectionConfig::default()
                }
            )
            .dropped,
            [1, 0, 0]
        );
    }

    #[test]
    fn of_near_duplicates_the_best_supported_set_is_kept() {
        let found = chosen(
            &[(0..8, 0.6), (0..19, 0.9), (0..20, 0.8)],
            &SelectionConfig::default(),
        );
        assert_eq!(
            (
                found.support.iter().map(|s| s.iou).collect::<Vec<_>>(),
                found.dropped
            ),
            (vec![0.9, 0.6], [0, 0, 1])
        );
    }
}
