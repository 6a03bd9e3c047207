//! Segmenters: find object masks in photos.

use crate::Result;
use crate::brighten;
use crate::conse::{Conse, DENSE, DenseMap};
use crate::edges::Hed;
use crate::regions::{Hierarchy, Node, watershed};
use fastlgs_core::color::lab;
use fastlgs_core::mask_list::{Mask, RunLengths};
use fastlgs_core::{Level, MaskList, image_io};
use image::RgbImage;

/// Version of [`OfflineSegmenter`]. Increase it whenever the same photo gets other masks.
pub const VERSION: u32 = 4;

/// Finds masks in photos.
pub trait Segmenter: Sync {
    /// Returns the masks of a photo, in the photo's size. `view` is the name of its view.
    ///
    /// # Errors
    /// Failed inference, or imported masks that are missing.
    fn segment(&self, view: &str, photo: &RgbImage) -> Result<MaskList>;

    /// Returns whether photos are segmented in parallel. A segmenter that uses all cores itself
    /// takes one photo after another, so that an interruption costs one photo.
    fn is_parallel(&self) -> bool {
        true
    }

    /// Measures and returns the seconds for a photo; `None` if it takes only moments.
    ///
    /// # Errors
    /// As [`Self::segment`].
    fn seconds_per_photo(&self, _photo: &RgbImage) -> Result<Option<f64>> {
        Ok(None)
    }
}

/// Offline segmenter: builds a region hierarchy from learned edges (HED), colour and the
/// classifier's dense embeddings. Regions that persist over a long span of the hierarchy become
/// masks.
pub struct OfflineSegmenter {
    edges: Hed,
    classifier: Conse,
}

/// Longer side, in pixels, of the image for edge detection. HED was trained near this size.
const WORK_SIDE: u32 = 480;
/// Longer sides, in pixels, of the images for the classifier. Its cells have 32 pixels: 15 and 26
/// cells along the side.
const DENSE_SIDES: [u32; 2] = [480, 832];
/// Smallest mask, as a share of the photo's area.
const MIN_AREA: f32 = 0.003;
/// Smallest mask of a region that differs much from its surroundings.
const MIN_DISTINCT_AREA: f32 = 0.0003;
/// Span of dissimilarity from which a region differs much from its surroundings.
const DISTINCT_SPAN: f32 = 0.1;
/// Number of features per pixel: L, a, b, then the dense embeddings.
const FEATURES: usize = 3 + DENSE_SIDES.len() * DENSE;
/// Of nested regions with an area ratio above this value, only one becomes a mask.
const MAX_OVERLAP: f32 = 0.85;
/// Range of dissimilarities for whole objects. Below it, regions are always merged; above it,
/// never.
const WHOLE_HEIGHTS: [f32; 2] = [0.25, 0.45];
/// Range of dissimilarities for parts, as `WHOLE_HEIGHTS`.
const PART_HEIGHTS: [f32; 2] = [0.08, 0.20];
impl OfflineSegmenter {
    /// Loads the edge detector and the classifier.
    ///
    /// # Errors
    /// A model that is not installed.
    pub fn load() -> Result<Self> {
        Ok(Self {
            edges: Hed::load()?,
            classifier: Conse::load()?,
        })
    }

    /// Returns the features of each pixel of `small`, `[pixel][FEATURES]`: colour and bilinearly
    /// interpolated dense embeddings of `photo`.
    fn features(&self, photo: &RgbImage, small: &RgbImage) -> Result<Vec<f32>> {
        let (w, h) = (small.width() as usize, small.height() as usize);
        let scales = DENSE_SIDES.map(|side| {
            Ok(self
                .classifier
                .project(&self.classifier.dense(&at_side(photo, side))?))
        });
        let scales = scales.into_iter().collect::<Result<Vec<_>>>()?;
        let mut out = Vec::with_capacity(w * h * FEATURES);
        for (p, pixel) in small.pixels().enumerate() {
            out.extend(lab(pixel.0));
            for DenseMap {
                columns,
                rows,
                values,
                ..
            } in &scales
            {
                let at = |x: usize, n: usize, cells: usize| {
                    ((x as f32 + 0.5) / n as f32 * cells as f32 - 0.5)
                        .clamp(0.0, (cells - 1) as f32)
                };
                let (u, v) = (at(p % w, w, *columns), at(p / w, h, *rows));
                let (i, j, fu, fv) = (u as usize, v as usize, u.fract(), v.fract());
                let (i1, j1) = ((i + 1).min(columns - 1), (j + 1).min(rows - 1));
                for k in 0..DENSE {
                    let cell = |i: usize, j: usize| values[(j * columns + i) * DENSE + k];
                    let (upper, lower) = (
                        cell(i, j) * (1.0 - fu) + cell(i1, j) * fu,
                        cell(i, j1) * (1.0 - fu) + cell(i1, j1) * fu,
                    );
                    out.push(upper * (1.0 - fv) + lower * fv);
                }
            }
        }
        Ok(out)
    }
}

/// Resizes a photo so that its longer side has `side` pixels. Each side has at least 32 pixels, one
/// cell of the classifier.
fn at_side(photo: &RgbImage, side: u32) -> RgbImage {
    let scale = side as f32 / photo.width().max(photo.height()) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(32);
    image_io::resize(photo, size(photo.width()), size(photo.height()))
}

impl Segmenter for OfflineSegmenter {
    fn segment(&self, _view: &str, photo: &RgbImage) -> Result<MaskList> {
        let photo = &brighten::brightened(photo);
        let small = at_side(photo, WORK_SIDE.min(photo.width().max(photo.height())));
        let (w, h) = (small.width() as usize, small.height() as usize);
        let edges = self.edges.edges(&small)?;
        let (basins, count) = watershed(&edges, w, h);
        let features = self.features(photo, &small)?;
        let tree = Hierarchy::build(
            &basins,
            count,
            w,
            &edges,
            &features,
            FEATURES,
            dissimilarity,
        );
        // Nested regions may all become masks. The consensus of the views decides which of them are
        // objects.
        let [whole, part] = [WHOLE_HEIGHTS, PART_HEIGHTS]
            .map(|[low, high]| tree.is_below(&tree.best_cut(|i| persistence(&tree, i, low, high))));
        let mut list = MaskList::new(photo.width(), photo.height());
        let runs = basin_runs(&basins, small.dimensions(), photo.dimensions());
        let is_candidate = |node: usize| {
            let share = tree.nodes[node].area / (w * h) as f32;
            let is_distinct = tree.span(node) >= DISTINCT_SPAN;
            share >= MIN_AREA || (share >= MIN_DISTINCT_AREA && is_distinct)
        };
        for node in tree.stable_nodes(is_candidate, MAX_OVERLAP) {
            let level = Level::ALL[usize::from(whole[node]) + usize::from(part[node])];
            let mask = region(&tree, node, &runs);
            // A region that is smaller than a pixel of the photo disappears.
            if mask.area() > 0 {
                list.masks.push(Mask::new(level, mask));
            }
        }
        Ok(list)
    }
}

/// Returns the dissimilarity of two regions: a weighted sum of the mean edge on their border and of
/// the distances of colour and embedding. A factor below 1 for small regions makes them merge
/// early.
fn dissimilarity(edge: f32, a: &Node, b: &Node) -> f32 {
    let mean = |n: &Node, k: usize| n.feature[k] / n.area;
    let color: f32 = (0..3)
        .map(|k| (mean(a, k) - mean(b, k)).powi(2))
        .sum::<f32>()
        .sqrt();
    let (mut dot, mut aa, mut bb) = (0.0f32, 1e-6f32, 1e-6f32);
    for k in 3..FEATURES {
        let (x, y) = (mean(a, k), mean(b, k));
        dot += x * y;
        aa += x * x;
        bb += y * y;
    }
    let embedding_distance = 0.5 - 0.5 * dot / (aa * bb).sqrt();
    let small = a.area.min(b.area);
    let small_region_factor = small / (small + 300.0);
    (0.4 * edge + 0.2 * (color / 40.0).min(1.0) + 0.4 * embedding_distance) * small_region_factor
}

/// Returns the excess of mass of a region: its area times the span of dissimilarity, between `low`
/// and `high`, over which it exists.
fn persistence(tree: &Hierarchy, i: usize, low: f32, high: f32) -> f32 {
    let node = &tree.nodes[i];
    let end = node.parent.map_or(high, |p| tree.nodes[p].height);
    node.area * (end.clamp(low, high) - node.height.clamp(low, high))
}

/// Runs of pixels of one basin, down the columns of a photo: basin and number of pixels.
type BasinRuns = Vec<(u32, u32)>;

/// Returns the runs of a photo of the size `to`, whose basins are those of the nearest pixels of an
/// image of the size `from`.
fn basin_runs(basins: &[u32], from: (u32, u32), to: (u32, u32)) -> BasinRuns {
    let nearest = |n: u32, from: u32, to: u32| (2 * n + 1) * from / (2 * to);
    let rows: Vec<u32> = (0..to.1).map(|y| nearest(y, from.1, to.1)).collect();
    let mut runs = BasinRuns::new();
    for x in 0..to.0 {
        let column = nearest(x, from.0, to.0);
        for row in &rows {
            let basin = basins[(row * from.0 + column) as usize];
            match runs.last_mut() {
                Some((last, count)) if *last == basin => *count += 1,
                _ => runs.push((basin, 1)),
            }
        }
    }
    runs
}

/// Returns the pixels of a region.
fn region(tree: &Hierarchy, node: usize, runs: &BasinRuns) -> RunLengths {
    let mut is_its = vec![false; tree.nodes.len()];
    tree.leaves(node)
        .into_iter()
        .for_each(|leaf| is_its[leaf] = true);
    RunLengths::from_runs(runs.iter().map(|&(basin, n)| (is_its[basin as usize], n)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::LabelMap;

    #[test]
    fn runs_show_the_nearest_basins() {
        let basins: Vec<u32> = (0..12).map(|p| p / 2).collect();
        let map = LabelMap {
            width: 4,
            height: 3,
            labels: basins.iter().map(|b| *b as u16).collect(),
        };
        for to in [(4, 3), (7, 5), (2, 3), (1, 1)] {
            let nearest = map.resized(to.0, to.1);
            let runs = basin_runs(&basins, (4, 3), to);
            assert!(runs.windows(2).all(|pair| pair[0].0 != pair[1].0));
            let found: Vec<u16> = runs
                .iter()
                .flat_map(|&(basin, n)| std::iter::repeat_n(basin as u16, n as usize))
                .collect();
            let down_the_columns: Vec<u16> = (0..to.0)
                .flat_map(|x| (0..to.1).map(move |y| (x, y)))
                .map(|(x, y)| nearest.at(x, y))
                .collect();
            assert_eq!(found, down_the_columns, "{to:?}");
        }
    }
}
