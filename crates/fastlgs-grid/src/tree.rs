//! Global mapping, second step: regions grow into a containment tree, and the nodes that the photos' masks support become
//! the objects.
//!
//! No single agreement is right for all things: at 0.5 a vase is one region and a bicycle five. So nothing is decided by a
//! threshold; touching regions are joined, most agreed first, and every union stays as a node above its members, as the
//! parts that finer masks show stay below. What is an object is then asked of the masks again: a node is kept where views
//! show masks of its shape.

use crate::consensus::{Regions, Seen, agreement, merged};
use fastlgs_core::LabelMap;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Pairs of neighbouring Gaussians that make two regions touch, as a share of the smaller one's.
const TOUCH: f32 = 0.02;
/// Agreement below which nothing is joined any more.
const LEAST_AGREEMENT: f32 = 0.1;

/// Nodes 1.. over the Gaussians: first the regions, then their parts, then unions of regions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tree {
    /// Node above node k + 1; 0 for none.
    pub parents: Vec<u16>,
    /// Deepest node of each Gaussian; 0 for none.
    pub of: Vec<u16>,
    regions: usize,
    parts: usize,
}

impl Tree {
    /// Grows the tree over `regions`; each of `parts` lies inside one of them.
    pub fn grow(regions: &Regions, parts: &Regions) -> Self {
        let (count, below) = (regions.seen.len(), parts.seen.len());
        let mut parents = vec![0; count + below];
        let mut of = regions.of.clone();
        for (deepest, part) in of.iter_mut().zip(&parts.of).filter(|(region, part)| **region > 0 && **part > 0) {
            let node = count as u16 + part;
            parents[usize::from(node) - 1] = *deepest;
            *deepest = node;
        }
        let mut sizes = vec![0u32; count];
        regions.of.iter().filter(|r| **r > 0).for_each(|r| sizes[usize::from(*r) - 1] += 1);
        join(regions, sizes, &mut parents);
        Self { parents, of, regions: count, parts: below }
    }

    /// Nodes, each after all that lie below it: parts, regions, unions.
    fn bottom_up(&self) -> impl Iterator<Item = usize> {
        let first_union = self.regions + self.parts;
        (self.regions..first_union).chain(0..self.regions).chain(first_union..self.parents.len())
    }
}

/// Joins touching regions, most agreed first; every union becomes a node of `parents`.
fn join(regions: &Regions, mut sizes: Vec<u32>, parents: &mut Vec<u16>) {
    let mut seen: Vec<Seen> = regions.seen.clone();
    // Groups are numbered as they come; `node[g]` is the tree's node of group g.
    let mut node: Vec<usize> = (0..sizes.len()).collect();
    let mut contacts: BTreeMap<(usize, usize), u32> =
        regions.contacts.iter().map(|(&(a, b), n)| ((usize::from(a) - 1, usize::from(b) - 1), *n)).collect();
    let score = |seen: &[Seen], sizes: &[u32], (a, b): (usize, usize), n: u32| {
        let touch = n as f32 >= TOUCH * sizes[a].min(sizes[b]) as f32;
        if touch { agreement(&seen[a], &seen[b]) } else { 0.0 }
    };
    let mut scores: BTreeMap<(usize, usize), f32> = contacts.iter().map(|(pair, n)| (*pair, score(&seen, &sizes, *pair, *n))).collect();
    while let Some((&(a, b), _)) = scores.iter().filter(|s| *s.1 >= LEAST_AGREEMENT).max_by(|x, y| x.1.total_cmp(y.1).then(y.0.cmp(x.0)))
        && parents.len() < usize::from(u16::MAX)
    {
        let union = sizes.len();
        parents.push(0);
        let above = parents.len();
        node.push(above - 1);
        [a, b].into_iter().for_each(|g| parents[node[g]] = above as u16);
        let (below_a, below_b) = (std::mem::take(&mut seen[a]), std::mem::take(&mut seen[b]));
        seen.push(merged(&below_a, &below_b));
        sizes.push(sizes[a] + sizes[b]);
        scores.remove(&(a, b));
        contacts.remove(&(a, b));
        let touched: Vec<(usize, usize)> = contacts.keys().copied().filter(|c| [c.0, c.1].iter().any(|g| *g == a || *g == b)).collect();
        for pair in touched {
            scores.remove(&pair);
            let n = contacts.remove(&pair).unwrap_or(0);
            let other = if pair.0 == a || pair.0 == b { pair.1 } else { pair.0 };
            *contacts.entry((other, union)).or_default() += n;
        }
        for (pair, n) in contacts.iter().filter(|c| c.0.1 == union) {
            scores.insert(*pair, score(&seen, &sizes, *pair, *n));
        }
    }
}

/// What the views show of a node.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Support {
    /// Mean IoU of the node with the best mask of each view, weighted by the node's pixels there.
    pub iou: f32,
    /// (pixels, view) of the views that show it.
    pub areas: Vec<(u32, usize)>,
}

impl Support {
    fn pixels(&self) -> f32 {
        self.areas.iter().map(|a| a.0 as f32).sum()
    }
}

/// Fewest pixels with which a view shows a node.
const MIN_PIXELS: u32 = 60;

/// Compares every node with the masks of every view. `views(v)` gives the view's map of deepest nodes and its mask maps.
///
/// # Errors
/// The first one that `views` returns.
pub fn support<E: Send>(
    tree: &Tree,
    views: usize,
    load: impl Fn(usize) -> Result<(LabelMap, Vec<LabelMap>), E> + Sync,
) -> Result<Vec<Support>, E> {
    let of_view = |view: usize| -> Result<Vec<(u32, f32)>, E> {
        let (nodes, levels) = load(view)?;
        let mut best = vec![0.0f32; tree.parents.len()];
        let mut areas = Vec::new();
        for masks in &levels {
            let (masks, _) = masks.dense();
            let width = usize::from(masks.max()) + 1;
            let mut common = vec![0u32; (tree.parents.len() + 1) * width];
            nodes.labels.iter().zip(&masks.labels).for_each(|(n, m)| common[usize::from(*n) * width + usize::from(*m)] += 1);
            for node in tree.bottom_up() {
                let (own, above) = (node + 1, usize::from(tree.parents[node]));
                if above > 0 {
                    (0..width).for_each(|m| common[above * width + m] += common[own * width + m]);
                }
            }
            let sizes = masks.areas();
            areas = common.chunks_exact(width).skip(1).map(|row| row.iter().sum::<u32>()).collect();
            for (node, row) in common.chunks_exact(width).skip(1).enumerate() {
                for mask in (1..width).filter(|m| row[*m] > 0) {
                    let union = areas[node] + sizes[mask] as u32 - row[mask];
                    best[node] = best[node].max(row[mask] as f32 / union as f32);
                }
            }
        }
        Ok(areas.into_iter().zip(best).collect())
    };
    let all = (0..views).into_par_iter().map(of_view).collect::<Result<Vec<_>, E>>()?;
    let gather = |node: usize| {
        let shown: Vec<(u32, usize, f32)> =
            all.iter().enumerate().map(|(v, nodes)| (nodes[node].0, v, nodes[node].1)).filter(|s| s.0 >= MIN_PIXELS).collect();
        let (sum, weight) = shown.iter().fold((0.0, 0.0), |(s, w), (area, _, iou)| (s + *area as f32 * iou, w + *area as f32));
        Support { iou: if weight > 0.0 { sum / weight } else { 0.0 }, areas: shown.into_iter().map(|(area, v, _)| (area, v)).collect() }
    };
    Ok((0..tree.parents.len()).map(gather).collect())
}

/// When a node is an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Fewest views that must show it.
    pub min_views: usize,
    /// Smallest mean share of the pixels of the views that show it.
    pub min_share: f32,
    /// Least support by masks.
    pub min_support: f32,
    /// Of a node and one below it that has more than this share of its pixels, only the better supported one is kept.
    pub same: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self { min_views: 3, min_share: 0.002, min_support: 0.4, same: 0.85 }
    }
}

/// The nodes that are objects.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chosen {
    /// Object of node k + 1: its own, else the next one above it; 0 for none.
    pub object_of: Vec<u16>,
    /// Object that contains object k + 1; 0 for none.
    pub parents: Vec<u16>,
    /// Node, less one, of each object.
    pub nodes: Vec<usize>,
    /// Nodes that are no objects: too few views, too small, no masks of their shape, the same as another.
    pub dropped: [usize; 4],
}

impl Chosen {
    /// Object of a node of [`Tree`]; 0 for node 0.
    pub fn object(&self, node: u16) -> u16 {
        if node > 0 { self.object_of[usize::from(node) - 1] } else { 0 }
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
    let mut kept: BTreeSet<usize> = BTreeSet::new();
    for (node, s) in support.iter().enumerate() {
        let share = s.pixels() / (s.areas.len().max(1) * pixels) as f32;
        match [s.areas.len() < config.min_views, share < config.min_share, s.iou < config.min_support].iter().position(|bad| *bad) {
            Some(reason) => chosen.dropped[reason] += 1,
            None => {
                kept.insert(node);
            }
        }
    }
    let above = |kept: &BTreeSet<usize>, node: usize| {
        let up = |n: &usize| usize::from(tree.parents[*n]).checked_sub(1);
        std::iter::successors(up(&node), up).find(|n| kept.contains(n))
    };
    // Small ones first, so that a chain of ever larger unions of one thing is thinned link by link.
    let mut order: Vec<usize> = kept.iter().copied().collect();
    order.sort_by(|a, b| support[*a].pixels().total_cmp(&support[*b].pixels()).then(a.cmp(b)));
    for &node in &order {
        if let Some(whole) = above(&kept, node).filter(|w| support[node].pixels() > config.same * support[*w].pixels()) {
            kept.remove(if support[node].iou > support[whole].iou { &whole } else { &node });
            chosen.dropped[3] += 1;
        }
    }
    // A node removed after its turn leaves the pair above it unchecked; that costs a duplicate, never an object.
    let mut nodes: Vec<usize> = kept.iter().copied().collect();
    nodes.sort_by(|a, b| support[*b].pixels().total_cmp(&support[*a].pixels()).then(b.cmp(a)));
    let ids: BTreeMap<usize, u16> = nodes.iter().enumerate().map(|(k, n)| (*n, k as u16 + 1)).collect();
    let id = |node: Option<usize>| node.map_or(0, |n| ids[&n]);
    chosen.object_of = (0..support.len()).map(|n| ids.get(&n).copied().unwrap_or_else(|| id(above(&kept, n)))).collect();
    chosen.parents = nodes.iter().map(|n| id(above(&kept, *n))).collect();
    chosen.nodes = nodes;
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;

    /// Regions 1 2 3 4 of two Gaussians each, in a row; all views show 1 and 2 in one mask, half of them 2 and 3, none 4.
    fn regions() -> Regions {
        let seen = |labels: [u16; 4]| -> Seen { labels.iter().enumerate().map(|(view, l)| ((view as u16, *l), 10.0)).collect() };
        Regions {
            of: vec![1, 1, 2, 2, 3, 3, 4, 4],
            seen: vec![seen([1, 1, 1, 1]), seen([1, 1, 1, 1]), seen([1, 1, 2, 2]), seen([3, 3, 3, 3])],
            contacts: BTreeMap::from([((1, 2), 2), ((2, 3), 2), ((3, 4), 2)]),
        }
    }

    fn parts() -> Regions {
        Regions { of: vec![1, 0, 0, 0, 0, 0, 2, 3], seen: vec![Seen::new(); 3], contacts: BTreeMap::new() }
    }

    #[test]
    fn agreement_orders_the_unions_and_parts_hang_below() {
        let tree = Tree::grow(&regions(), &parts());
        // Nodes 1-4 regions, 5-7 parts, 8 = {1, 2}, 9 = {8, 3}; 4 agrees with nobody.
        assert_eq!(tree.parents, [8, 8, 9, 0, 1, 4, 4, 9, 0]);
        assert_eq!(tree.of, [5, 1, 2, 2, 3, 3, 6, 7]);
    }

    #[test]
    fn nodes_with_masks_of_their_shape_are_objects() {
        let tree = Tree::grow(&regions(), &parts());
        // One row of 800 pixels: 100 for each Gaussian. Masks show {1, 2}, 3 and 4 whole, and the part 5 on its own.
        let nodes = LabelMap { width: 800, height: 1, labels: tree.of.iter().flat_map(|n| [*n; 100]).collect() };
        let masks = |labels: [u16; 8]| LabelMap { width: 800, height: 1, labels: labels.iter().flat_map(|l| [*l; 100]).collect() };
        let load = |_| Ok::<_, Infallible>((nodes.clone(), vec![masks([1, 1, 1, 1, 2, 2, 3, 3]), masks([4, 0, 0, 0, 0, 0, 0, 0])]));
        let support = support(&tree, 4, load).unwrap();
        let iou: Vec<f32> = support.iter().map(|s| s.iou).collect();
        assert_eq!(iou, [0.5, 0.5, 1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 4.0 / 6.0]);
        let config = Config { min_support: 0.6, ..Config::default() };
        let chosen = choose(&tree, &support, 800, &config);
        // By size: 9 (600 pixels), 8 (400), then 4, 3 (200 each) and part 5 (100).
        assert_eq!(chosen.nodes, [8, 7, 3, 2, 4]);
        assert_eq!(chosen.parents, [0, 1, 0, 1, 2]);
        assert_eq!(chosen.object_of, [2, 2, 4, 3, 5, 3, 3, 2, 1]);
        assert_eq!(chosen.dropped, [0, 0, 4, 0]);
        assert_eq!(choose(&tree, &support, 800, &Config { min_views: 5, ..config }).dropped, [9, 0, 0, 0]);
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
        let tree = Tree { parents: vec![2, 3, 0], of: vec![1, 2, 3], regions: 3, parts: 0 };
        let node = |area: u32, iou: f32| Support { iou, areas: (0..4).map(|v| (area, v)).collect() };
        let chosen = choose(&tree, &[node(400, 0.4), node(950, 0.9), node(1000, 0.8)], 10_000, &Config::default());
        assert_eq!((chosen.nodes, chosen.parents, chosen.object_of), (vec![1, 0], vec![0, 1], vec![2, 1, 0]));
    }
}
