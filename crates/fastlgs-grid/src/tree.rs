//! Global mapping, third step: the elected sets are nested in each other.

use crate::consensus::Proposal;
use crate::sightings::Sightings;
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// A node of a [`Tree`], by its number from 0; no node has a higher number than the one above it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Node(pub u32);

impl Node {
    /// Its place in lists of all nodes.
    pub fn place(self) -> usize {
        self.0 as usize
    }
}

/// Nested sets of Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tree {
    /// By node: the one above it.
    pub parents: Vec<Option<Node>>,
    /// By Gaussian: the smallest node that it belongs to.
    pub of: Vec<Option<Node>>,
}

/// Sets of which this share is the same are the same thing, and a set of which less than this is left is no more what masks elected.
const ALIKE: f32 = 0.7;

impl Tree {
    /// Nests sets of Gaussians that masks elected, those first that most masks stand behind.
    ///
    /// Masks of neighbouring things cut their common border now here, now there, so that sets overlap a little. Of two that do, the larger one gives
    /// way, since it changes less by it: it takes the smaller one whole where it holds most of it, and leaves it whole otherwise. A set that would
    /// change an elected one too much, or is nearly the same, is left out.
    pub fn nest(sightings: &Sightings, elected: &[Proposal]) -> Self {
        let weights: Vec<f32> = (0..sightings.gaussians() as u32).map(|g| sightings.weight(g)).collect();
        let weight = |set: &[u32]| -> f32 { set.iter().map(|g| weights[*g as usize]).sum() };
        let mut kept = compatible(elected, &weights);
        kept.sort_by(|a, b| weight(&a.set).total_cmp(&weight(&b.set)));

        let (mut parents, mut sizes): (Vec<Option<Node>>, Vec<f32>) = Default::default();
        let mut of: Vec<Option<Node>> = vec![None; weights.len()];
        // By Gaussian: the largest node so far; and the Gaussians of the nodes that lie in no other one so far.
        let mut largest: Vec<Option<Node>> = of.clone();
        let mut roots: BTreeMap<Node, Vec<u32>> = BTreeMap::new();
        for proposal in kept {
            let mut common: BTreeMap<Node, f32> = BTreeMap::new();
            let met = proposal.set.iter().filter_map(|g| Some((largest[*g as usize]?, weights[*g as usize])));
            met.for_each(|(node, weight)| *common.entry(node).or_default() += weight);
            let is_inside = |node: &Node| 2.0 * common[node] > sizes[node.place()];
            let inside: Vec<Node> = common.keys().copied().filter(is_inside).collect();
            // What it keeps of its own, and what it gains with the nodes inside.
            let own: Vec<u32> = proposal.set.iter().copied().filter(|g| largest[*g as usize].is_none_or(|node| is_inside(&node))).collect();
            let (was, left) = (weight(&proposal.set), weight(&own));
            let now = left + inside.iter().map(|node| sizes[node.place()] - common[node]).sum::<f32>();
            if left < ALIKE * (was + now - left) {
                continue;
            }
            let node = Node(parents.len() as u32);
            parents.push(None);
            sizes.push(now);
            own.iter().for_each(|g| of[*g as usize] = of[*g as usize].or(Some(node)));
            let mut set: Vec<u32> = own.iter().copied().filter(|g| largest[*g as usize].is_none()).collect();
            for inner in inside {
                parents[inner.place()] = Some(node);
                set.extend(roots.remove(&inner).unwrap_or_default());
            }
            set.iter().for_each(|g| largest[*g as usize] = Some(node));
            roots.insert(node, set);
        }
        Self { parents, of }
    }

    /// The nodes that Gaussians belong to at first hand, and for each Gaussian the place of its own among them, from 1 on; 0 for none.
    /// Where 16 bits cannot number them all, the Gaussians of the smallest are left to the next node above.
    pub fn labels(&self) -> (Vec<Node>, Vec<u16>) {
        let mut sizes: BTreeMap<Node, usize> = BTreeMap::new();
        self.of.iter().flatten().for_each(|node| *sizes.entry(*node).or_default() += 1);
        let mut nodes: Vec<(usize, Node)> = sizes.into_iter().map(|(node, size)| (size, node)).collect();
        nodes.sort_by_key(|&(size, node)| (Reverse(size), node));
        nodes.truncate(usize::from(u16::MAX));
        let nodes: Vec<Node> = nodes.into_iter().map(|n| n.1).collect();
        let label: BTreeMap<Node, u16> = nodes.iter().copied().zip(1..=u16::MAX).collect();
        let of = |own: &Option<Node>| own.and_then(|node| self.upwards(node).find_map(|n| label.get(&n).copied())).unwrap_or(0);
        let labels = self.of.iter().map(of).collect();
        (nodes, labels)
    }

    /// A node and all above it.
    pub fn upwards(&self, node: Node) -> impl Iterator<Item = Node> {
        std::iter::successors(Some(node), |node| self.parents[node.place()])
    }
}

/// Those of the sets that can stand beside all before them.
fn compatible<'a>(elected: &'a [Proposal], weights: &[f32]) -> Vec<&'a Proposal> {
    let sizes: Vec<f32> = elected.iter().map(|p| p.set.iter().map(|g| weights[*g as usize]).sum()).collect();
    let mut holders: Vec<Vec<u32>> = vec![Vec::new(); weights.len()];
    let mut kept = Vec::new();
    for (place, proposal) in elected.iter().enumerate() {
        let mut common: BTreeMap<u32, f32> = BTreeMap::new();
        for &g in &proposal.set {
            holders[g as usize].iter().for_each(|other| *common.entry(*other).or_default() += weights[g as usize]);
        }
        let stands_beside = |(other, common): (&u32, &f32)| {
            let (a, b) = (sizes[place], sizes[*other as usize]);
            let (small, large) = (a.min(b), a.max(b));
            let change = if 2.0 * common > small { small - common } else { *common };
            *common <= ALIKE * (small + large - common) && change <= (1.0 - ALIKE) * large
        };
        if common.iter().all(stands_beside) {
            proposal.set.iter().for_each(|g| holders[*g as usize].push(place as u32));
            kept.push(proposal);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sightings::Sighting;

    /// The tree of sets of 20 Gaussians of one pixel each, and the Gaussians of its nodes.
    fn nested(sets: &[std::ops::Range<u32>]) -> (Tree, Vec<Vec<usize>>) {
        let seen = (0..20).map(|g| Sighting::new(g, 0, 1.0)).collect();
        let elected: Vec<Proposal> = sets.iter().map(|set| Proposal { set: set.clone().collect(), masks: Vec::new() }).collect();
        let table = fastlgs_core::MaskList::new(1, 1).atoms().table;
        let tree = Tree::nest(&Sightings::new(20, vec![seen], &[table]), &elected);
        let mut sets = vec![Vec::new(); tree.parents.len()];
        for (g, node) in tree.of.iter().enumerate() {
            node.iter().flat_map(|n| tree.upwards(*n)).for_each(|n| sets[n.place()].push(g));
        }
        (tree, sets)
    }

    #[test]
    fn of_two_that_overlap_the_larger_gives_way() {
        // A part that reaches out of its whole, and a neighbour that the whole reaches into.
        let (tree, sets) = nested(&[2..12, 1..4, 11..16]);
        assert_eq!(sets, [(1..4).collect::<Vec<_>>(), (11..16).collect(), (1..11).collect()]);
        assert_eq!(tree.parents, [Some(Node(2)), None, None]);
        assert_eq!(tree.of[3..6], [Some(Node(0)), Some(Node(2)), Some(Node(2))]);
    }

    #[test]
    fn what_is_the_same_or_would_change_others_too_much_is_left_out() {
        assert_eq!(nested(&[0..10, 0..9]).1, [(0..10).collect::<Vec<_>>()]);
        assert_eq!(nested(&[0..10, 5..15]).1, [(0..10).collect::<Vec<_>>()], "half of it is the other's");
        assert_eq!(nested(&[10..20, 8..12]).1.len(), 2);
        // Two neighbours take too much of it together, though neither does alone.
        assert_eq!(nested(&[4..14, 1..6, 12..17]).1.len(), 2);
    }

    #[test]
    fn labels_name_the_nodes_that_own_gaussians() {
        // Node 2 holds 0 and 1, and a Gaussian of its own.
        let [a, b, c] = [0, 1, 2].map(Node);
        let tree = Tree { parents: vec![Some(c), Some(c), None], of: vec![Some(a), Some(a), Some(b), Some(b), Some(b), Some(c), None] };
        assert_eq!(tree.labels(), (vec![b, a, c], vec![2, 2, 1, 1, 1, 3, 0]));
        assert_eq!(tree.upwards(a).collect::<Vec<_>>(), [a, c]);
    }
}
