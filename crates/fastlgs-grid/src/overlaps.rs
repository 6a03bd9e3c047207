//! Ids for Gaussians that lie in several objects.
//!
//! Objects have the ids 1..=K in descending order of size. Id k denotes object k and all its
//! ancestors. Ids above K denote other combinations of objects, each by a list.

use std::collections::{BTreeMap, BTreeSet};

/// Object lists that are not a chain of parents. Id K + 1 + i denotes list i. A list holds object
/// ids in descending order, so small objects come first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overlaps(pub Vec<Vec<u16>>);

/// Share of the total weight of the Gaussians whose lists get ids of their own. The other lists are
/// mostly at object borders, each for a few Gaussians.
pub const LISTED_SHARE: f32 = 0.98;

impl Overlaps {
    /// Numbers object lists; returns the overlap lists and the id of each input list.
    ///
    /// `lists` are in descending order of id, with `weights`; `parents` holds the parent of each
    /// object. The heaviest lists are kept, up to `share` of the total weight and 16-bit ids. Each
    /// other list gets the id of the list with the largest IoU to it.
    pub fn of(
        lists: &[Vec<u16>],
        parents: &[u16],
        weights: &[f32],
        share: f32,
    ) -> (Self, Vec<u16>) {
        let mut found: BTreeMap<&[u16], f32> = BTreeMap::new();
        lists
            .iter()
            .zip(weights)
            .filter(|(list, _)| !list.is_empty())
            .for_each(|(list, weight)| *found.entry(list).or_default() += weight);
        let mut order: Vec<(&[u16], f32)> = found.into_iter().collect();
        order.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(b.0)));
        let all: f32 = order.iter().map(|o| o.1).sum();

        let chains: Vec<Vec<u16>> = (1..=parents.len() as u16)
            .map(|id| with_ancestors(id, parents))
            .collect();
        let mut number: BTreeMap<&[u16], u16> = chains.iter().map(Vec::as_slice).zip(1..).collect();
        let (mut kept, mut sum) = (Vec::new(), 0.0);
        for (list, weight) in &order {
            let next = parents.len() + kept.len() + 1;
            if sum <= share * all && next <= usize::from(u16::MAX) && !number.contains_key(list) {
                number.insert(list, next as u16);
                kept.push(list.to_vec());
            }
            sum += weight;
        }

        let mut holders: Vec<Vec<(&[u16], u16)>> = vec![Vec::new(); parents.len() + 1];
        for (list, number) in &number {
            list.iter()
                .for_each(|id| holders[usize::from(*id)].push((list, *number)));
        }
        // The candidates are the lists that contain its smallest object.
        let nearest = |list: &[u16]| {
            let alike = |other: &[u16]| {
                let common = list.iter().filter(|id| other.contains(id)).count();
                common as f32 / (list.len() + other.len() - common) as f32
            };
            let others = holders[usize::from(list[0])]
                .iter()
                .map(|(other, number)| (alike(other), *number));
            others
                .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
                .map_or(0, |other| other.1)
        };
        let id = |list| number.get(list).copied().unwrap_or_else(|| nearest(list));
        let of_list: BTreeMap<&[u16], u16> =
            order.iter().map(|(list, _)| (*list, id(*list))).collect();
        let ids = lists
            .iter()
            .map(|list| of_list.get(list.as_slice()).copied().unwrap_or(0))
            .collect();
        (Self(kept), ids)
    }

    /// Returns for each id, 0 included, the sum of the `values` of its elements. `objects`: number
    /// of objects.
    pub fn sums(&self, objects: usize, ids: &[u16], values: &[f32]) -> Vec<f32> {
        let mut sums = vec![0.0; 1 + objects + self.0.len()];
        ids.iter()
            .zip(values)
            .for_each(|(id, value)| sums[usize::from(*id)] += value);
        sums
    }

    /// Returns for each id, 0 included, the objects that it denotes, smallest first.
    pub fn lists(&self, parents: &[u16]) -> Vec<Vec<u16>> {
        let objects = (0..=parents.len() as u16).map(|id| with_ancestors(id, parents));
        objects.chain(self.0.iter().cloned()).collect()
    }
}

/// Returns the id that represents the objects of a pixel, given in descending order of id.
///
/// `found`: the ids there with their weights. Prefers the heaviest id of exactly these objects,
/// then the heaviest one whose smallest object is the same. Otherwise returns the smallest object.
pub fn representative_id(
    objects: &[u16],
    found: impl Iterator<Item = (u16, f32)>,
    lists: &[Vec<u16>],
) -> u16 {
    let Some(smallest) = objects.first() else {
        return 0;
    };
    let list = |id: u16| lists.get(usize::from(id)).map_or(&[][..], Vec::as_slice);
    let fitting = found
        .filter(|(id, _)| list(*id).first() == Some(smallest))
        .map(|(id, weight)| (list(id) == objects, weight, id));
    fitting
        .max_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(b.2.cmp(&a.2)))
        .map_or(*smallest, |best| best.2)
}

/// Returns an object and its ancestors, smallest first; nothing for id 0.
fn with_ancestors(id: u16, parents: &[u16]) -> Vec<u16> {
    let up =
        |id: &u16| Some(parents[usize::from(*id) - 1]).filter(|above| (1..*id).contains(above));
    std::iter::successors(Some(id).filter(|id| *id > 0), up).collect()
}

/// Partitions the objects 1 to `objects` into layers. Objects of a layer share no Gaussians. `lists`
/// holds the objects of each id.
pub fn layers(lists: &[Vec<u16>], objects: usize) -> Vec<BTreeSet<u16>> {
    let mut beside: Vec<BTreeSet<u16>> = vec![BTreeSet::new(); objects + 1];
    for list in lists {
        list.iter()
            .for_each(|id| beside[usize::from(*id)].extend(list));
    }
    let mut layers: Vec<BTreeSet<u16>> = Vec::new();
    for id in 1..=objects as u16 {
        let place = layers
            .iter()
            .position(|layer| layer.is_disjoint(&beside[usize::from(id)]))
            .unwrap_or(layers.len());
        layers.resize(layers.len().max(place + 1), BTreeSet::new());
        layers[place].insert(id);
    }
    layers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn object_lists_get_ids_and_can_be_recovered() {
        // Objects 2 and 3 lie in 1. Some Gaussians of 3 lie in 2 as well; some of 2 lie outside 1.
        let parents = [0, 1, 1];
        let lists = vec![
            vec![],
            vec![1],
            vec![2, 1],
            vec![3, 2, 1],
            vec![2],
            vec![3, 1],
            vec![2],
        ];
        let (overlaps, ids) = Overlaps::of(&lists, &parents, &[1.0; 7], 1.0);
        assert_eq!(
            (ids.as_slice(), &overlaps),
            (
                &[0, 1, 2, 5, 4, 3, 4][..],
                &Overlaps(vec![vec![2], vec![3, 2, 1]])
            )
        );
        let all = overlaps.lists(&parents);
        assert_eq!(
            ids.iter()
                .map(|id| all[usize::from(*id)].clone())
                .collect::<Vec<_>>(),
            lists
        );
    }

    #[test]
    fn rare_lists_get_the_id_of_the_most_similar_list() {
        let parents = [0, 0, 0];
        let lists = vec![vec![3, 2, 1], vec![3, 2], vec![3, 1], vec![3], vec![2, 1]];
        let (overlaps, ids) = Overlaps::of(&lists, &parents, &[1.0, 50.0, 0.5, 50.0, 0.1], 0.98);
        assert_eq!((overlaps.0, ids), (vec![vec![3, 2]], vec![4, 4, 3, 3, 2]));
    }

    #[test]
    fn representative_id_prefers_an_id_of_exactly_these_objects() {
        let lists = [vec![], vec![1], vec![2, 1], vec![3, 2], vec![3, 1]];
        let number = |objects: &[u16], found: &[(u16, f32)]| {
            representative_id(objects, found.iter().copied(), &lists)
        };
        assert_eq!(
            number(&[2, 1], &[(3, 9.0), (2, 1.0)]),
            2,
            "id 3 stands for objects 3 and 2"
        );
        assert_eq!(number(&[3, 1], &[(3, 9.0), (4, 1.0)]), 4);
        assert_eq!(number(&[3, 2, 1], &[(3, 2.0), (4, 1.0)]), 3);
        assert_eq!(
            (
                number(&[1], &[(3, 2.0), (2, 1.0)]),
                number(&[], &[(3, 2.0)])
            ),
            (1, 0)
        );
    }
}
