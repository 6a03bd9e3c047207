//! Global mapping, first step: the views' masks grow a tree over the Gaussians.
//!
//! Neighbouring sets of Gaussians are joined, those first that most masks hold together, as all views see it ([`Seen::agreement`]): parts come
//! to be before the things that they are parts of, and these before what they stand on. The order of the photos plays no part, a wrong mask in
//! one view is outvoted by the others, and what one view cuts apart or glues together the majority mends. Nothing is decided here by a
//! threshold: which of the nodes are objects is asked of the masks again ([`crate::support`], [`crate::objects`]).

use crate::seen::{Seen, Vote};
use fastlgs_core::mask_list::Table;
use rayon::prelude::*;
use std::borrow::Cow;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

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

/// What makes a set of Gaussians large enough to be a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// So many views must show it.
    pub min_views: usize,
    /// And so many pixels of it each.
    pub min_pixels: f32,
}

/// Agreement below which nothing is joined: no masks but those of a few views hold both.
const LEAST_AGREEMENT: f32 = 0.02;
/// Growth from which a set is looked at anew: what it gained before changes little.
const GROWN: f32 = 1.05;
/// What agrees at least this share of what a node's own do is more of the same; what agrees less makes a new node above it.
const SAME_LEVEL: f32 = 0.85;

/// A set of Gaussians that is still growing.
struct Set {
    /// What it sees; a single Gaussian's is worked out where it is needed, since all together would not fit.
    seen: Option<Seen>,
    near: BTreeSet<u32>,
    /// Those of its Gaussians that belong to no node yet.
    loose: Vec<u32>,
    node: Option<Node>,
    /// The agreement at which that node came to be.
    level: f32,
    /// Changes when it has grown, with its weight then; the last version of all is that of a set that is gone.
    version: u32,
    weight: f32,
}

const GONE: u32 = u32::MAX;

/// Sets that grow, and the nodes that they have become.
struct Growing<'a> {
    votes: &'a [Vec<Vote>],
    tables: &'a [Table],
    sets: Vec<Set>,
    tree: Tree,
    /// By node: the one that it has become one with.
    dissolved: Vec<Option<Node>>,
}

/// Agreement as bits, so that it has an order; then the pair, and the versions in which they agreed.
type Offer = (u32, Reverse<(u32, u32)>, u32, u32);

impl Growing<'_> {
    fn seen(&self, set: u32) -> Cow<'_, Seen> {
        let single = || Cow::Owned(Seen::of(&self.votes[set as usize], self.tables));
        self.sets[set as usize].seen.as_ref().map_or_else(single, Cow::Borrowed)
    }

    /// What joining two sets is worth; none where nothing speaks for it.
    fn offer(&self, a: u32, b: u32) -> Option<Offer> {
        let (a, b) = (a.min(b), a.max(b));
        let agreed = self.seen(a).agreement(&self.seen(b));
        let versions = [a, b].map(|s| self.sets[s as usize].version);
        (agreed >= LEAST_AGREEMENT).then_some((agreed.to_bits(), Reverse((a, b)), versions[0], versions[1]))
    }

    /// A new node above some others.
    fn new_node(&mut self, below: &[Node]) -> Node {
        self.tree.parents.push(None);
        self.dissolved.push(None);
        let node = Node(self.tree.parents.len() as u32 - 1);
        below.iter().for_each(|below| self.tree.parents[below.place()] = Some(node));
        node
    }

    fn settle(&mut self, loose: Vec<u32>, node: Node) {
        loose.into_iter().for_each(|g| self.tree.of[g as usize] = Some(node));
    }

    /// Joins two sets; returns the one that is left, whose neighbours are those of both, and which of them are new to it.
    fn join(&mut self, a: u32, b: u32, agreed: f32, config: &Config) -> (u32, Vec<u32>) {
        // The one with more neighbours swallows the other.
        let (keep, gone) = if self.sets[a as usize].near.len() >= self.sets[b as usize].near.len() { (a, b) } else { (b, a) };
        let whole = self.seen(keep).merged(&self.seen(gone));
        let empty = Set { seen: None, near: BTreeSet::new(), loose: Vec::new(), node: None, level: 0.0, version: GONE, weight: 0.0 };
        let other = std::mem::replace(&mut self.sets[gone as usize], empty);
        let mut loose = std::mem::take(&mut self.sets[keep as usize].loose);
        loose.extend(other.loose);
        let set = &self.sets[keep as usize];
        let (node, level) = match (set.node.map(|n| (n, set.level)), other.node.map(|n| (n, other.level))) {
            (None, None) if whole.reached_by(config.min_views, self.tables.len()) < config.min_pixels => (None, 0.0),
            (None, None) => (Some(self.new_node(&[])), agreed),
            (Some(x), Some(y)) if agreed < SAME_LEVEL * x.1.max(y.1) => (Some(self.new_node(&[x.0, y.0])), agreed),
            (Some(x), Some(y)) => {
                // The later one, so that what lies in it has lower numbers.
                let (gone, stays) = (x.0.min(y.0), x.0.max(y.0));
                self.dissolved[gone.place()] = Some(stays);
                (Some(stays), x.1.max(y.1))
            }
            (Some((node, level)), None) | (None, Some((node, level))) if agreed < SAME_LEVEL * level => {
                (Some(self.new_node(&[node])), agreed)
            }
            (Some((node, level)), None) | (None, Some((node, level))) => (Some(node), level),
        };
        if let Some(node) = node {
            self.settle(std::mem::take(&mut loose), node);
        }
        let set = &mut self.sets[keep as usize];
        let weight = whole.weight();
        if weight > GROWN * set.weight {
            (set.version, set.weight) = (set.version + 1, weight);
        }
        (set.seen, set.loose, set.node, set.level) = (Some(whole), loose, node, level);
        set.near.remove(&gone);
        let mut new = Vec::new();
        for &c in other.near.iter().filter(|c| **c != keep) {
            self.sets[c as usize].near.remove(&gone);
            if self.sets[c as usize].near.insert(keep) {
                new.push(c);
            }
            self.sets[keep as usize].near.insert(c);
        }
        (keep, new)
    }

    /// The tree of the nodes that are left.
    fn finished(self) -> Tree {
        let left = |node: Node| std::iter::successors(Some(node), |n| self.dissolved[n.place()]).last().unwrap_or(node);
        let mut number = vec![Node(0); self.dissolved.len()];
        let stays = (0..self.dissolved.len()).filter(|n| self.dissolved[*n].is_none());
        stays.clone().enumerate().for_each(|(place, node)| number[node] = Node(place as u32));
        let renamed = |node: Option<Node>| node.map(|n| number[left(n).place()]);
        Tree {
            parents: stays.map(|node| renamed(self.tree.parents[node])).collect(),
            of: self.tree.of.iter().map(|node| renamed(*node)).collect(),
        }
    }
}

impl Tree {
    /// Grows the tree. `votes` holds each Gaussian's, rising by view; `tables` are those of all views; `near` are pairs of neighbours.
    pub fn grow(mut votes: Vec<Vec<Vote>>, tables: &[Table], near: &[(u32, u32)], config: &Config) -> Self {
        // A Gaussian that mostly shows where no mask is belongs to no object.
        votes.par_iter_mut().filter(|v| !Seen::of(v, tables).is_covered()).for_each(|v| *v = Vec::new());
        let set = |g: usize| {
            let weight = votes[g].iter().map(|v| v.weight()).sum();
            Set { seen: None, near: BTreeSet::new(), loose: vec![g as u32], node: None, level: 0.0, version: 0, weight }
        };
        let sets = (0..votes.len()).map(set).collect();
        let tree = Self { parents: Vec::new(), of: vec![None; votes.len()] };
        let mut growing = Growing { votes: &votes, tables, sets, tree, dissolved: Vec::new() };
        for &(a, b) in near.iter().filter(|(a, b)| !votes[*a as usize].is_empty() && !votes[*b as usize].is_empty()) {
            growing.sets[a as usize].near.insert(b);
            growing.sets[b as usize].near.insert(a);
        }
        let mut queue: BinaryHeap<Offer> = near.par_iter().filter_map(|&(a, b)| growing.offer(a, b)).collect::<Vec<_>>().into();
        while let Some((agreed, Reverse((a, b)), va, vb)) = queue.pop() {
            let now = [a, b].map(|s| growing.sets[s as usize].version);
            if now.contains(&GONE) {
                continue;
            }
            if now != [va, vb] {
                // One of them has grown since: ask the views again.
                queue.extend(growing.offer(a, b));
                continue;
            }
            let (keep, new) = growing.join(a, b, f32::from_bits(agreed), config);
            queue.extend(new.into_iter().filter_map(|c| growing.offer(keep, c)));
        }
        growing.finished()
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

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    const WIDTH: u32 = 16;

    /// A row of 12 Gaussians that cover a pixel each; every view has its masks, given by their first pixel and the one after their last.
    /// `order`: the views' numbers.
    fn grown(views: &[&[[u32; 2]]], order: &[usize]) -> Tree {
        let list = |masks: &[[u32; 2]]| {
            let mask = |[from, to]: &[u32; 2]| Mask::new(Level::Whole, RunLengths::of(WIDTH, 1, |x, _| (*from..*to).contains(&x)));
            MaskList { masks: masks.iter().map(mask).collect(), ..MaskList::new(WIDTH, 1) }.atoms()
        };
        let atoms: Vec<_> = order.iter().map(|v| list(views[*v])).collect();
        let tables: Vec<Table> = atoms.iter().map(|a| a.table.clone()).collect();
        let votes = |g: u32| atoms.iter().enumerate().map(|(v, a)| Vote::new(v as u16, a.map.at(g, 0), 50.0)).collect();
        let near: Vec<(u32, u32)> = (0..11).map(|g| (g, g + 1)).collect();
        Tree::grow((0..12).map(votes).collect(), &tables, &near, &Config { min_views: 3, min_pixels: 100.0 })
    }

    /// The Gaussians of every node, sorted.
    fn sets(tree: &Tree) -> BTreeSet<Vec<usize>> {
        let mut sets = vec![Vec::new(); tree.parents.len()];
        for (g, node) in tree.of.iter().enumerate() {
            node.iter().flat_map(|n| tree.upwards(*n)).for_each(|n| sets[n.place()].push(g));
        }
        sets.into_iter().collect()
    }

    #[test]
    fn parts_come_before_wholes_and_the_majority_of_views_decides() {
        // A handle of 2 on a cup of 6 on a saucer of 10; one view glues all, another cuts the cup, and two pixels have no mask.
        let good: &[[u32; 2]] = &[[0, 10], [0, 6], [0, 2]];
        let views = [good, good, good, &[[0, 10]], &[[0, 10], [0, 3], [3, 6]]];
        let tree = grown(&views, &[0, 1, 2, 3, 4]);
        let found = sets(&tree);
        for wanted in [0..2, 0..6, 0..10] {
            assert!(found.contains(&wanted.clone().collect::<Vec<_>>()), "{wanted:?} in {found:?}");
        }
        assert_eq!(tree.of[10..], [None, None]);
        assert_eq!(found, sets(&grown(&views, &[4, 2, 0, 3, 1])), "the order of the views plays no part");
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
