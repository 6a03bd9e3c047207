//! Global mapping, last step: the nodes of the tree that the photos' masks support become the objects.

use crate::support::Support;
use crate::tree::{Node, Tree};
use std::collections::{BTreeMap, BTreeSet};

/// When a node is an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Fewest views that must show it.
    pub min_views: usize,
    /// Smallest object, as the share of a view's pixels that so many views must show. Further photos from afar make nothing smaller.
    pub min_share: f32,
    /// Least support by masks.
    pub min_support: f32,
    /// Of a node and one below it that has more than this share of its pixels, only the better supported one is an object.
    pub same: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self { min_views: 3, min_share: 0.0005, min_support: 0.4, same: 0.7 }
    }
}

/// The nodes that are objects.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chosen {
    /// By node: its object, else the next one above it; 0 for none.
    object_of: Vec<u16>,
    /// Object that contains object k + 1; 0 for none.
    pub parents: Vec<u16>,
    /// Node of each object.
    pub nodes: Vec<Node>,
    /// Nodes that are no objects: too few views, too small, no masks of their shape, the same as another.
    pub dropped: [usize; 4],
}

impl Chosen {
    /// Object that a node is or lies in; 0 for none.
    pub fn object(&self, node: Node) -> u16 {
        self.object_of[node.place()]
    }

    /// An object and all that contain it, from small to large.
    fn chain(&self, id: u16) -> impl Iterator<Item = u16> {
        std::iter::successors(Some(id), |id| Some(self.parents[usize::from(*id) - 1]).filter(|p| *p > 0))
    }

    /// Objects none of which lies in another one of the same layer: by the number of objects around them.
    pub fn layers(&self) -> Vec<BTreeSet<u16>> {
        let mut layers: Vec<BTreeSet<u16>> = Vec::new();
        for id in 1..=self.parents.len() as u16 {
            let depth = self.chain(id).skip(1).count();
            layers.resize(layers.len().max(depth + 1), BTreeSet::new());
            layers[depth].insert(id);
        }
        layers
    }

    /// For each id 0..=K the object of `layer` that it is or lies in, where `wanted`; 0 for none.
    pub fn ancestors_on(&self, layer: &BTreeSet<u16>, wanted: impl Fn(u16) -> bool) -> Vec<u16> {
        let on_layer = |id: u16| self.chain(id).find(|a| layer.contains(a)).filter(|a| wanted(*a));
        std::iter::once(0).chain((1..=self.parents.len() as u16).map(|id| on_layer(id).unwrap_or(0))).collect()
    }
}

/// Chooses the objects among the nodes and numbers them, 1..=K, by falling size, so that none precedes what contains it.
pub fn choose(tree: &Tree, support: &[Support], pixels: usize, config: &Config) -> Chosen {
    let mut chosen = Chosen::default();
    let mut kept: BTreeSet<Node> = BTreeSet::new();
    let of = |node: Node| &support[node.place()];
    for (place, s) in support.iter().enumerate() {
        let small = (s.reached_by(config.min_views) as f32) < config.min_share * pixels as f32;
        match [s.areas.len() < config.min_views, small, s.iou < config.min_support].iter().position(|bad| *bad) {
            Some(reason) => chosen.dropped[reason] += 1,
            None => {
                kept.insert(Node(place as u32));
            }
        }
    }
    // The best supported first: what is nearly the same set as one that stays, above or below it, goes.
    let alike = |below: Node, above: Node| of(below).pixels() > config.same * of(above).pixels();
    let mut order: Vec<Node> = kept.iter().copied().collect();
    order.sort_by(|a, b| of(*b).iou.total_cmp(&of(*a).iou).then(a.cmp(b)));
    let mut stays: BTreeSet<Node> = BTreeSet::new();
    let mut holds_its_like: BTreeSet<Node> = BTreeSet::new();
    for node in order {
        let mut around = tree.upwards(node).skip(1).take_while(|whole| alike(node, *whole));
        if holds_its_like.contains(&node) || around.any(|whole| stays.contains(&whole)) {
            chosen.dropped[3] += 1;
            continue;
        }
        stays.insert(node);
        holds_its_like.extend(tree.upwards(node).skip(1).take_while(|whole| alike(node, *whole)));
    }
    let mut kept = stays;
    let above = |kept: &BTreeSet<Node>, node: Node| tree.upwards(node).skip(1).find(|n| kept.contains(n));
    let mut nodes: Vec<Node> = kept.iter().copied().collect();
    nodes.sort_by(|a, b| of(*b).pixels().total_cmp(&of(*a).pixels()).then(b.cmp(a)));
    for beyond in nodes.drain(nodes.len().min(usize::from(u16::MAX))..) {
        kept.remove(&beyond);
        chosen.dropped[1] += 1;
    }
    let ids: BTreeMap<Node, u16> = nodes.iter().copied().zip(1..=u16::MAX).collect();
    let id = |node: Option<Node>| node.map_or(0, |n| ids[&n]);
    let all = (0..support.len() as u32).map(Node);
    chosen.object_of = all.map(|n| ids.get(&n).copied().unwrap_or_else(|| id(above(&kept, n)))).collect();
    chosen.parents = nodes.iter().map(|n| id(above(&kept, *n))).collect();
    chosen.nodes = nodes;
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(parents: &[Option<u32>]) -> Tree {
        Tree { parents: parents.iter().map(|p| p.map(Node)).collect(), of: Vec::new() }
    }

    fn shown(area: u32, iou: f32) -> Support {
        Support { iou, areas: (0..4).map(|v| (area, v)).collect() }
    }

    #[test]
    fn supported_nodes_are_objects_by_falling_size() {
        // 0 lies in 1, 1 and 2 in 3; 4 stands alone.
        let tree = tree(&[Some(1), Some(3), Some(3), None, None]);
        let support = [shown(100, 0.9), shown(400, 0.8), shown(300, 0.2), shown(900, 0.7), shown(500, 1.0)];
        let chosen = choose(&tree, &support, 10_000, &Config::default());
        assert_eq!(chosen.nodes, [3, 4, 1, 0].map(Node));
        assert_eq!(chosen.parents, [0, 0, 1, 3]);
        assert_eq!([0, 1, 2, 3, 4].map(|n| chosen.object(Node(n))), [4, 3, 1, 1, 2]);
        assert_eq!(chosen.dropped, [0, 0, 1, 0]);
        assert_eq!(choose(&tree, &support, 10_000, &Config { min_views: 5, ..Config::default() }).dropped, [5, 0, 0, 0]);
    }

    #[test]
    fn glimpses_from_afar_make_nothing_smaller() {
        let near = |areas: &[u32]| Support { iou: 1.0, areas: areas.iter().copied().zip(0..).collect() };
        let config = Config { min_share: 0.01, ..Config::default() };
        let objects = |areas: &[u32]| choose(&tree(&[None]), &[near(areas)], 10_000, &config).nodes.len();
        assert_eq!((objects(&[100, 120, 110]), objects(&[100, 120, 110, 1, 1, 1, 1, 1]), objects(&[100, 120, 90])), (1, 1, 0));
    }

    #[test]
    fn layers_hold_no_object_inside_another() {
        // 2 and 3 lie in 1, 4 in 2.
        let chosen = Chosen { parents: vec![0, 1, 1, 2, 0], ..Chosen::default() };
        let layers = chosen.layers();
        assert_eq!(layers, [BTreeSet::from([1, 5]), BTreeSet::from([2, 3]), BTreeSet::from([4])]);
        assert_eq!(chosen.ancestors_on(&layers[0], |_| true), [0, 1, 1, 1, 1, 5]);
        assert_eq!(chosen.ancestors_on(&layers[1], |id| id != 3), [0, 0, 2, 0, 2, 0]);
    }

    #[test]
    fn of_two_that_are_nearly_the_same_the_better_one_stays() {
        let support = [shown(400, 0.4), shown(950, 0.9), shown(1000, 0.8)];
        let chosen = choose(&tree(&[Some(1), Some(2), None]), &support, 10_000, &Config::default());
        assert_eq!((chosen.nodes, chosen.parents), ([1, 0].map(Node).to_vec(), vec![0, 1]));
    }
}
