//! A bounding volume hierarchy that finds the nearest hit of a ray without testing every solid.

use super::solid::{Crossing, Solid};
use glam::Vec3;

/// A binary tree of axis-aligned boxes. Each inner node divides its solids into two halves.
pub struct Hierarchy {
    nodes: Vec<Node>,
    /// Indices of the solids in the order of the leaves.
    order: Vec<u32>,
}

struct Node {
    bounds: [Vec3; 2],
    /// For a leaf, the solids are `order[first..first + count]`. For an inner node, `count` is 0
    /// and `first` is the index of the right child; the left child directly follows its parent.
    first: u32,
    count: u32,
}

/// Largest number of solids in a leaf.
const LEAF_SIZE: usize = 4;

impl Hierarchy {
    /// Builds the tree by median splits along the longest axis of each box.
    pub fn new(solids: &[Solid]) -> Self {
        let mut tree = Self {
            nodes: Vec::new(),
            order: (0..solids.len() as u32).collect(),
        };
        let bounds: Vec<[Vec3; 2]> = solids.iter().map(Solid::bounds).collect();
        tree.split(&bounds, 0, solids.len());
        tree
    }

    fn split(&mut self, bounds: &[[Vec3; 2]], from: usize, to: usize) {
        let place = self.nodes.len();
        let around = self.order[from..to].iter().fold(
            [Vec3::INFINITY, Vec3::NEG_INFINITY],
            |[low, high], i| {
                let [l, h] = bounds[*i as usize];
                [low.min(l), high.max(h)]
            },
        );
        self.nodes.push(Node {
            bounds: around,
            first: from as u32,
            count: (to - from) as u32,
        });
        if to - from <= LEAF_SIZE {
            return;
        }
        let axis = (around[1] - around[0]).max_position();
        let middle = |i: &u32| bounds[*i as usize][0][axis] + bounds[*i as usize][1][axis];
        self.order[from..to].sort_by(|a, b| middle(a).total_cmp(&middle(b)).then(a.cmp(b)));
        let half = usize::midpoint(from, to);
        self.split(bounds, from, half);
        let right = self.nodes.len() as u32;
        self.split(bounds, half, to);
        (self.nodes[place].first, self.nodes[place].count) = (right, 0);
    }

    /// Returns the index of the first solid that a ray meets, and the crossing.
    pub fn nearest(
        &self,
        solids: &[Solid],
        origin: Vec3,
        direction: Vec3,
    ) -> Option<(usize, Crossing)> {
        let inverse = direction.recip();
        let mut best: Option<(usize, Crossing)> = None;
        let mut stack = vec![0usize];
        while let Some(place) = stack.pop() {
            let node = &self.nodes[place];
            let (a, b) = (
                (node.bounds[0] - origin) * inverse,
                (node.bounds[1] - origin) * inverse,
            );
            let (enter, exit) = (a.min(b).max_element(), a.max(b).min_element());
            if exit < enter.max(0.0) || best.is_some_and(|(_, hit)| enter > hit.t) {
                continue;
            }
            if node.count == 0 {
                stack.extend([node.first as usize, place + 1]);
                continue;
            }
            for &i in &self.order[node.first as usize..(node.first + node.count) as usize] {
                let hit = solids[i as usize].hit(origin, direction);
                if let Some(hit) = hit.filter(|h| best.is_none_or(|(_, b)| h.t < b.t)) {
                    best = Some((i as usize, hit));
                }
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::super::solid::Shape;
    use super::super::surface::Surface;
    use super::*;
    use fastlgs_core::rng::Rng;
    use glam::Mat3;

    #[test]
    fn the_tree_and_a_linear_search_find_the_same_hit() {
        let mut rng = Rng::new(1, "hierarchy");
        let mut point =
            |reach: f32| Vec3::from_array(std::array::from_fn(|_| rng.range(-reach, reach)));
        let solids: Vec<Solid> = (0..200)
            .map(|k| Solid {
                shape: [Shape::Ball, Shape::Block, Shape::Cylinder, Shape::Cone][k % 4],
                centre: point(5.0),
                half: point(0.3).abs() + 0.05,
                rotation: Mat3::from_rotation_y(k as f32),
                surface: Surface::plain(Vec3::ONE),
                object: k as u16 + 1,
            })
            .collect();
        let tree = Hierarchy::new(&solids);
        let mut hits = 0;
        for _ in 0..2000 {
            let (origin, direction) = (point(6.0), point(1.0));
            let all = solids
                .iter()
                .enumerate()
                .filter_map(|(i, s)| Some((i, s.hit(origin, direction)?.t)));
            let nearest = all.min_by(|a, b| a.1.total_cmp(&b.1));
            let found = tree
                .nearest(&solids, origin, direction)
                .map(|(i, hit)| (i, hit.t));
            assert_eq!(found, nearest);
            hits += usize::from(found.is_some());
        }
        assert!(hits > 150, "{hits} of 2000 rays hit something");
    }
}
