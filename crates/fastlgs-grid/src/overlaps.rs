//! Numbers for Gaussians that lie in several objects.
//!
//! Objects are numbered 1..=K by falling size, and object k stands for itself and all above it by its parents: so far a Gaussian's number is the
//! smallest object that it lies in. Objects that masks draw overlap as well. Where they do, the numbers above K each stand for a list of objects.

use std::collections::BTreeMap;

/// Lists of objects that no chain of parents is: number K + 1 + i stands for list i, which falls, so that small objects come first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overlaps(pub Vec<Vec<u16>>);

impl Overlaps {
    /// The number of each list of objects, which fall; `parents` by object. Numbers have 16 bits: where more are needed, the lists of least weight
    /// are taken for their smallest object and what is above it.
    pub fn of(lists: Vec<Vec<u16>>, parents: &[u16], weights: &[f32]) -> (Self, Vec<u16>) {
        let mut found: BTreeMap<&[u16], f32> = BTreeMap::new();
        for (list, weight) in lists.iter().zip(weights).filter(|(list, _)| **list != nested(list, parents)) {
            *found.entry(list).or_default() += weight;
        }
        let mut order: Vec<(&[u16], f32)> = found.into_iter().collect();
        order.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(b.0)));
        order.truncate(usize::from(u16::MAX) - parents.len());
        let number: BTreeMap<&[u16], u16> = order.iter().map(|o| o.0).zip(1 + parents.len() as u16..).collect();
        let of = |list: &Vec<u16>| number.get(list.as_slice()).copied().unwrap_or_else(|| list.first().copied().unwrap_or(0));
        let ids = lists.iter().map(of).collect();
        (Self(order.into_iter().map(|o| o.0.to_vec()).collect()), ids)
    }

    /// For each number, 0 included, the objects that it stands for, from small to large.
    pub fn lists(&self, parents: &[u16]) -> Vec<Vec<u16>> {
        let objects = (0..=parents.len() as u16).map(|id| nested(&[id], parents));
        objects.chain(self.0.iter().cloned()).collect()
    }
}

/// The first object of a list and all above it; nothing for object 0.
fn nested(list: &[u16], parents: &[u16]) -> Vec<u16> {
    let first = list.first().copied().filter(|id| *id > 0);
    let up = |id: &u16| Some(parents[usize::from(*id) - 1]).filter(|above| (1..*id).contains(above));
    std::iter::successors(first, up).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_numbered_and_found_again() {
        // 2 and 3 lie in 1; some of 3 lies in 2 as well, and some of 2 reaches out of 1.
        let parents = [0, 1, 1];
        let lists = vec![vec![], vec![1], vec![2, 1], vec![3, 2, 1], vec![2], vec![3, 1], vec![2]];
        let (overlaps, ids) = Overlaps::of(lists.clone(), &parents, &[1.0; 7]);
        assert_eq!((ids.as_slice(), &overlaps), (&[0, 1, 2, 5, 4, 3, 4][..], &Overlaps(vec![vec![2], vec![3, 2, 1]])));
        let all = overlaps.lists(&parents);
        assert_eq!(ids.iter().map(|id| all[usize::from(*id)].clone()).collect::<Vec<_>>(), lists);
    }
}
