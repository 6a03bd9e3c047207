//! Global mapping, fourth step: how well the photos' masks fit each node of the tree.

use crate::sightings::MIN_PIXELS;
use crate::tree::{Node, Tree};
use fastlgs_core::LabelMap;
use fastlgs_core::mask_list::Table;
use rayon::prelude::*;

/// What the views show of a node.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Support {
    /// Mean IoU of the node with the best mask of each view, weighted by the node's pixels there.
    pub iou: f32,
    /// (pixels, view) of the views that show it.
    pub areas: Vec<(u32, u32)>,
}

impl Support {
    /// Sum of the pixels of all views.
    pub fn pixels(&self) -> f32 {
        self.areas.iter().map(|a| a.0 as f32).sum()
    }

    /// The pixels that so many views show at least; 0 where fewer show it.
    pub fn reached_by(&self, count: usize) -> u32 {
        let mut areas: Vec<u32> = self.areas.iter().map(|a| a.0).collect();
        areas.sort_unstable_by(|a, b| b.cmp(a));
        areas.get(count.saturating_sub(1)).copied().unwrap_or(0)
    }
}

/// The pixels of a view by what they show.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shown(Vec<(Node, u16, u32)>);

impl Shown {
    /// `nodes`: by pixel, the smallest node that has most of its weight; `atoms`: the atoms of the view's masks, by pixel.
    pub fn of(nodes: impl Iterator<Item = Option<Node>>, atoms: &LabelMap) -> Self {
        let mut pairs: Vec<(Node, u16)> = nodes.zip(&atoms.labels).filter_map(|(node, atom)| Some((node?, *atom))).collect();
        pairs.sort_unstable();
        Self(pairs.chunk_by(|a, b| a == b).map(|same| (same[0].0, same[0].1, same.len() as u32)).collect())
    }
}

/// A node in a view: its pixels, and how many of them lie in each mask, rising by mask.
type Held = (u32, Vec<(u16, u32)>);

/// Compares every node with the masks of every view, which may overlap. `tables` are those of the views' masks.
pub fn support(tree: &Tree, views: &[Shown], tables: &[Table]) -> Vec<Support> {
    let mut children = vec![Vec::new(); tree.parents.len()];
    for (node, above) in tree.parents.iter().enumerate() {
        above.iter().for_each(|above| children[above.place()].push(node));
    }
    let seen: Vec<_> = views.par_iter().zip(tables).map(|(shown, table)| of_view(&children, shown, table)).collect();
    let mut all = vec![(Support::default(), 0.0f32); tree.parents.len()];
    for (view, shown) in seen.into_iter().enumerate() {
        for (node, area, iou) in shown.into_iter().filter(|s| s.1 as f32 >= MIN_PIXELS) {
            let (support, weight) = &mut all[node];
            support.areas.push((area, view as u32));
            support.iou += area as f32 * iou;
            *weight += area as f32;
        }
    }
    let mean = |(s, weight): (Support, f32)| Support { iou: s.iou / weight.max(1.0), ..s };
    all.into_iter().map(mean).collect()
}

/// Nodes that a view shows: place, pixels, and the IoU of the mask that fits best.
fn of_view(children: &[Vec<usize>], shown: &Shown, table: &Table) -> Vec<(usize, u32, f32)> {
    let mut held: Vec<Option<Held>> = vec![None; children.len()];
    for same in shown.0.chunk_by(|a, b| a.0 == b.0) {
        let mut masks: Vec<(u16, u32)> = same.iter().flat_map(|s| table.masks(s.1).iter().map(|m| (*m, s.2))).collect();
        masks.sort_unstable();
        held[same[0].0.place()] = Some((same.iter().map(|s| s.2).sum(), summed(masks)));
    }
    let mut out = Vec::new();
    for (node, below) in children.iter().enumerate() {
        for &child in below {
            let (own, inner) = (held[node].take(), held[child].take());
            held[node] = match (own, inner) {
                (Some(a), Some(b)) => Some((a.0 + b.0, summed(merged(&a.1, &b.1)))),
                (own, inner) => own.or(inner),
            };
        }
        if let Some((area, masks)) = &held[node] {
            let iou = |&(mask, common): &(u16, u32)| common as f32 / (area + table.areas[usize::from(mask)] - common) as f32;
            out.push((node, *area, masks.iter().map(iou).fold(0.0, f32::max)));
        }
    }
    out
}

/// Both lists as one that rises by mask.
fn merged(a: &[(u16, u32)], b: &[(u16, u32)]) -> Vec<(u16, u32)> {
    let mut all = [a, b].concat();
    all.sort_unstable();
    all
}

/// One entry a mask, of a list that rises by mask.
fn summed(masks: Vec<(u16, u32)>) -> Vec<(u16, u32)> {
    masks.chunk_by(|a, b| a.0 == b.0).map(|same| (same[0].0, same.iter().map(|m| m.1).sum())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::mask_list::{Mask, RunLengths};
    use fastlgs_core::{Level, MaskList};

    #[test]
    fn nodes_are_compared_with_whole_masks() {
        // Nodes 0 and 1 lie in 2, 2 and 3 in 4; 3 owns the last fifth. Masks: 0, and 2 whole although the first lies on it.
        let tree = Tree { parents: [Some(2), Some(2), Some(4), Some(4), None].map(|p| p.map(Node)).to_vec(), of: Vec::new() };
        let mask = |end: u32| Mask::new(Level::Whole, RunLengths::of(500, 1, |x, _| x < end));
        let atoms = MaskList { masks: vec![mask(200), mask(400)], ..MaskList::new(500, 1) }.atoms();
        let shown = Shown::of((0..500).map(|x| Some(Node([0, 0, 1, 1, 3][x / 100]))), &atoms.map);
        let found = support(&tree, &[(); 3].map(|()| shown.clone()), &[(); 3].map(|()| atoms.table.clone()));
        let iou: Vec<f32> = found.iter().map(|s| s.iou).collect();
        assert_eq!(iou, [1.0, 0.5, 1.0, 0.0, 0.8]);
        assert_eq!((found[2].areas.clone(), found[2].pixels()), (vec![(400, 0), (400, 1), (400, 2)], 1200.0));
        assert_eq!((found[2].reached_by(3), found[2].reached_by(4)), (400, 0));
    }
}
