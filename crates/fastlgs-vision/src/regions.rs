//! Builds a region hierarchy from an edge map: watershed basins are merged in ascending order of
//! dissimilarity.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// Grows basins from the minima of `edges` (row-major, 0 to 1). Returns the basin of each pixel,
/// from 0, and the number of basins.
pub fn watershed(edges: &[f32], width: usize, height: usize) -> (Vec<u32>, usize) {
    const NONE: u32 = u32::MAX;
    let level: Vec<u32> = edges
        .iter()
        .map(|e| (e.clamp(0.0, 1.0) * 255.0) as u32)
        .collect();
    let near = |p: usize| neighbours(p, width, height);
    let mut basin = vec![NONE; level.len()];
    let mut count = 0;
    let mut stack = Vec::new();
    // A minimum is a plateau with no lower neighbour.
    let mut seen = vec![false; level.len()];
    for start in 0..level.len() {
        if seen[start] {
            continue;
        }
        let (mut plateau, mut lowest) = (Vec::new(), true);
        seen[start] = true;
        stack.push(start);
        while let Some(p) = stack.pop() {
            plateau.push(p);
            for q in near(p) {
                lowest &= level[q] >= level[p];
                if level[q] == level[p] && !seen[q] {
                    seen[q] = true;
                    stack.push(q);
                }
            }
        }
        if lowest {
            plateau.iter().for_each(|&p| basin[p] = count);
            count += 1;
        }
    }
    // Flood in ascending order of edge strength. Ties are resolved by order of insertion, so the
    // result is deterministic.
    let mut queue = BinaryHeap::new();
    let mut arrival = 0u64;
    for p in 0..level.len() {
        if basin[p] != NONE {
            queue.push(Reverse((level[p], arrival, p)));
            arrival += 1;
        }
    }
    while let Some(Reverse((height_now, _, p))) = queue.pop() {
        for q in near(p) {
            if basin[q] == NONE {
                basin[q] = basin[p];
                queue.push(Reverse((level[q].max(height_now), arrival, q)));
                arrival += 1;
            }
        }
    }
    (basin, count as usize)
}

/// Returns the neighbours of a pixel: left, right, above and below.
fn neighbours(p: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (p % width, p / width);
    [
        (x > 0).then(|| p - 1),
        (x + 1 < width).then(|| p + 1),
        (y > 0).then(|| p - width),
        (y + 1 < height).then(|| p + width),
    ]
    .into_iter()
    .flatten()
}

/// A node of the merge tree: a basin or the union of two nodes.
#[derive(Clone, Debug)]
pub struct Node {
    /// Area in pixels.
    pub area: f32,
    /// Sum of the pixels' features (colour and dense embedding).
    pub feature: Vec<f32>,
    /// Dissimilarity at which its children merged; 0 for basins.
    pub height: f32,
    /// The two nodes that merged into it; `None` for basins.
    pub children: Option<[usize; 2]>,
    /// Node that it was merged into.
    pub parent: Option<usize>,
}

/// A merge tree over watershed basins; the first nodes are the basins.
pub struct Hierarchy {
    /// All nodes.
    pub nodes: Vec<Node>,
}

#[derive(Clone, Copy, Default)]
struct Border {
    length: f32,
    strength: f32,
}

impl Hierarchy {
    /// Merges adjacent regions, in ascending order of dissimilarity, until none are adjacent.
    /// `features` holds `dimension` values per pixel.
    ///
    /// `dissimilarity(edge, a, b)` receives the mean edge strength on the common border, and both
    /// nodes. It must not be negative.
    pub fn build(
        basins: &[u32],
        count: usize,
        width: usize,
        edges: &[f32],
        features: &[f32],
        dimension: usize,
        dissimilarity: impl Fn(f32, &Node, &Node) -> f32,
    ) -> Self {
        let empty = Node {
            area: 0.0,
            feature: vec![0.0; dimension],
            height: 0.0,
            children: None,
            parent: None,
        };
        let mut nodes = vec![empty; count];
        let mut borders: Vec<BTreeMap<usize, Border>> = vec![BTreeMap::new(); count];
        for (p, &b) in basins.iter().enumerate() {
            let node = &mut nodes[b as usize];
            node.area += 1.0;
            node.feature
                .iter_mut()
                .zip(&features[p * dimension..])
                .for_each(|(s, v)| *s += v);
            let right = (p % width + 1 < width).then_some(p + 1);
            for q in [right, Some(p + width)]
                .into_iter()
                .flatten()
                .filter(|&q| q < basins.len())
            {
                let (a, b) = (basins[p] as usize, basins[q] as usize);
                if a != b {
                    for (x, y) in [(a, b), (b, a)] {
                        let border = borders[x].entry(y).or_default();
                        border.length += 1.0;
                        border.strength += edges[p].max(edges[q]);
                    }
                }
            }
        }
        let cost = |nodes: &[Node], border: Border, a: usize, b: usize| {
            dissimilarity(border.strength / border.length, &nodes[a], &nodes[b])
        };
        // Non-negative floats sort like their bit patterns.
        let mut queue = BinaryHeap::new();
        for a in 0..count {
            for (&b, &border) in borders[a].range(a + 1..) {
                queue.push(Reverse((cost(&nodes, border, a, b).to_bits(), a, b)));
            }
        }
        while let Some(Reverse((bits, a, b))) = queue.pop() {
            if nodes[a].parent.is_some() || nodes[b].parent.is_some() {
                continue;
            }
            let merged = nodes.len();
            let feature = nodes[a]
                .feature
                .iter()
                .zip(&nodes[b].feature)
                .map(|(x, y)| x + y)
                .collect();
            let height = f32::from_bits(bits)
                .max(nodes[a].height)
                .max(nodes[b].height);
            nodes.push(Node {
                area: nodes[a].area + nodes[b].area,
                feature,
                height,
                children: Some([a, b]),
                parent: None,
            });
            nodes[a].parent = Some(merged);
            nodes[b].parent = Some(merged);
            let mut around = std::mem::take(&mut borders[a]);
            for (other, border) in std::mem::take(&mut borders[b]) {
                let sum = around.entry(other).or_default();
                sum.length += border.length;
                sum.strength += border.strength;
            }
            around.remove(&a);
            around.remove(&b);
            for (&other, &border) in &around {
                borders[other].remove(&a);
                borders[other].remove(&b);
                borders[other].insert(merged, border);
                queue.push(Reverse((
                    cost(&nodes, border, other, merged).to_bits(),
                    other,
                    merged,
                )));
            }
            borders.push(around);
        }
        Self { nodes }
    }

    /// Returns the basins below a node.
    pub fn leaves(&self, node: usize) -> Vec<usize> {
        let (mut stack, mut out) = (vec![node], Vec::new());
        while let Some(n) = stack.pop() {
            match self.nodes[n].children {
                Some(children) => stack.extend(children),
                None => out.push(n),
            }
        }
        out
    }

    /// Returns the span of dissimilarity over which a node exists: the difference between the
    /// heights of its parent and its own.
    pub fn span(&self, node: usize) -> f32 {
        let parent = self.nodes[node].parent;
        parent.map_or(0.0, |p| self.nodes[p].height - self.nodes[node].height)
    }

    /// Returns the nodes that `is_candidate` accepts, in descending order of area. Of nested nodes
    /// whose area ratio is above `max_overlap`, only the one with the longest span is kept.
    pub fn stable_nodes(
        &self,
        is_candidate: impl Fn(usize) -> bool,
        max_overlap: f32,
    ) -> Vec<usize> {
        let area = |i: usize| self.nodes[i].area;
        let span = |i: usize| self.span(i);
        let upwards = |i: usize| std::iter::successors(Some(i), |i| self.nodes[*i].parent);
        let mut order: Vec<usize> = (0..self.nodes.len()).filter(|i| is_candidate(*i)).collect();
        order.sort_by(|a, b| span(*b).total_cmp(&span(*a)).then(a.cmp(b)));
        let mut kept = vec![false; self.nodes.len()];
        // Area of the largest kept node inside each node.
        let mut largest = vec![0.0f32; self.nodes.len()];
        for &i in &order {
            let around = upwards(i).skip(1).find(|j| kept[*j]);
            if largest[i] <= max_overlap * area(i)
                && around.is_none_or(|j| area(i) <= max_overlap * area(j))
            {
                kept[i] = true;
                upwards(i).for_each(|j| largest[j] = largest[j].max(area(i)));
            }
        }
        order.retain(|i| kept[*i]);
        order.sort_by(|a, b| area(*b).total_cmp(&area(*a)).then(a.cmp(b)));
        order
    }

    /// Returns for each node whether it is a strict descendant of a node of `cut`.
    pub fn is_below(&self, cut: &[usize]) -> Vec<bool> {
        let mut below = vec![false; self.nodes.len()];
        let mut stack: Vec<usize> = cut
            .iter()
            .flat_map(|i| self.nodes[*i].children)
            .flatten()
            .collect();
        while let Some(i) = stack.pop() {
            below[i] = true;
            stack.extend(self.nodes[i].children.into_iter().flatten());
        }
        below
    }

    /// Returns disjoint nodes that cover the image with the largest total `value` (dynamic
    /// programming from the leaves).
    pub fn best_cut(&self, value: impl Fn(usize) -> f32) -> Vec<usize> {
        // Children precede their parents.
        let mut best = vec![0.0f32; self.nodes.len()];
        let mut whole = vec![true; self.nodes.len()];
        for i in 0..self.nodes.len() {
            let own = value(i);
            best[i] = own;
            if let Some([a, b]) = self.nodes[i].children
                && best[a] + best[b] > own
            {
                best[i] = best[a] + best[b];
                whole[i] = false;
            }
        }
        let mut stack: Vec<usize> = (0..self.nodes.len())
            .filter(|&i| self.nodes[i].parent.is_none())
            .collect();
        let mut cut = Vec::new();
        while let Some(i) = stack.pop() {
            match self.nodes[i].children {
                Some(children) if !whole[i] => stack.extend(children),
                _ => cut.push(i),
            }
        }
        cut.sort_unstable();
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_rooms_merge_by_their_walls() {
        // Rooms divided by a weak wall at x = 10 and a strong one at x = 20.
        let (w, h) = (30, 12);
        let edges: Vec<f32> = (0..w * h)
            .map(|p| match p % w {
                10 => 0.3,
                20 => 0.9,
                _ => 0.0,
            })
            .collect();
        let (basins, count) = watershed(&edges, w, h);
        assert_eq!(count, 3);
        let tree = Hierarchy::build(
            &basins,
            count,
            w,
            &edges,
            &vec![0.0; w * h],
            1,
            |edge, _, _| edge,
        );
        assert_eq!(tree.nodes.len(), 5);
        let first = &tree.nodes[3];
        assert!(
            (first.height - 0.3).abs() < 1e-3 && first.area >= 19.0 * 12.0,
            "regions must merge across the weak wall first"
        );
        let cut = tree.best_cut(|i| if i == 3 { 5.0 } else { 1.0 });
        assert_eq!(cut.len(), 2);
        assert!(cut.contains(&3));
        let below = tree.is_below(&cut);
        assert_eq!(
            (below.iter().filter(|b| **b).count(), below[3], below[4]),
            (2, false, false)
        );
        let larger = |least: f32| {
            let tree = &tree;
            move |i: usize| tree.nodes[i].area >= least
        };
        assert_eq!(tree.stable_nodes(larger(1.0), 0.85).len(), 5);
        assert_eq!(
            tree.stable_nodes(larger(1.5 * 120.0), 0.85),
            [4, 3],
            "nodes must be sorted by descending area"
        );
        assert_eq!(
            tree.stable_nodes(larger(1.5 * 120.0), 0.5),
            [3],
            "the root spans no range of dissimilarity"
        );
    }
}
