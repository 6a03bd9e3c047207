//! Object masks of photos.

use crate::Result;
use crate::conse::{Conse, DENSE, DenseMap};
use crate::edges::Hed;
use crate::exposure;
use crate::regions::{Hierarchy, Node, watershed};
use fastlgs_core::color::lab;
use fastlgs_core::{LabelMap, Level, MaskList, image_io};
use image::RgbImage;

/// Changes when [`OfflineSegmenter`] gives the same photo other masks.
pub const VERSION: u32 = 1;

/// Finds masks.
pub trait Segmenter: Sync {
    /// Name recorded in the scene.
    fn name(&self) -> &'static str;
    /// The masks of the photo of the view of that name; the list has its size.
    ///
    /// # Errors
    /// When inference fails, or masks that were made elsewhere are missing.
    fn segment(&self, view: &str, photo: &RgbImage) -> Result<MaskList>;
}

/// Learned edges (HED), colour and the classifier's dense opinion, turned into a region hierarchy whose lasting regions
/// are the masks.
pub struct OfflineSegmenter {
    edges: Hed,
    classifier: Conse,
}

/// Longer side at which edges are found: HED was trained near this size.
const WORK_SIDE: u32 = 480;
/// Longer sides at which the classifier looks: cells of 32 pixels, so 15 and 26 cells along it.
const DENSE_SIDES: [u32; 2] = [480, 832];
/// Smallest mask as a share of the photo.
const MIN_AREA: f32 = 0.003;
/// Features of a pixel: L, a, b, then the dense embedding.
const FEATURES: usize = 3 + DENSE_SIDES.len() * DENSE;
/// Of regions that share more than this of their pixels one is a mask.
const ALIKE: f32 = 0.85;
/// Between these dissimilarities a region may stand as an object: below, pieces are always joined; above, never.
const WHOLE_HEIGHTS: [f32; 2] = [0.25, 0.45];
/// The same for parts.
const PART_HEIGHTS: [f32; 2] = [0.08, 0.20];
impl OfflineSegmenter {
    /// Loads edge detector and classifier.
    ///
    /// # Errors
    /// When they are not installed.
    pub fn load() -> Result<Self> {
        Ok(Self { edges: Hed::load()?, classifier: Conse::load()? })
    }

    /// Colour and meaning of each pixel of `small`.
    fn features(&self, photo: &RgbImage, small: &RgbImage) -> Result<Vec<f32>> {
        let (w, h) = (small.width() as usize, small.height() as usize);
        let scales = DENSE_SIDES.map(|side| Ok(self.classifier.project(&self.classifier.dense(&at_side(photo, side))?)));
        let scales = scales.into_iter().collect::<Result<Vec<_>>>()?;
        let mut out = Vec::with_capacity(w * h * FEATURES);
        for (p, pixel) in small.pixels().enumerate() {
            out.extend(lab(pixel.0));
            for DenseMap { columns, rows, values, .. } in &scales {
                let at =
                    |x: usize, n: usize, cells: usize| ((x as f32 + 0.5) / n as f32 * cells as f32 - 0.5).clamp(0.0, (cells - 1) as f32);
                let (u, v) = (at(p % w, w, *columns), at(p / w, h, *rows));
                let (i, j, fu, fv) = (u as usize, v as usize, u.fract(), v.fract());
                let (i1, j1) = ((i + 1).min(columns - 1), (j + 1).min(rows - 1));
                for k in 0..DENSE {
                    let cell = |i: usize, j: usize| values[(j * columns + i) * DENSE + k];
                    let (upper, lower) = (cell(i, j) * (1.0 - fu) + cell(i1, j) * fu, cell(i, j1) * (1.0 - fu) + cell(i1, j1) * fu);
                    out.push(upper * (1.0 - fv) + lower * fv);
                }
            }
        }
        Ok(out)
    }
}

/// The photo with its longer side at `side`, and no side below a cell of the classifier.
fn at_side(photo: &RgbImage, side: u32) -> RgbImage {
    let scale = side as f32 / photo.width().max(photo.height()) as f32;
    let size = |n: u32| ((n as f32 * scale).round() as u32).max(32);
    image_io::resize(photo, size(photo.width()), size(photo.height()))
}

impl Segmenter for OfflineSegmenter {
    fn name(&self) -> &'static str {
        "offline"
    }

    fn segment(&self, _view: &str, photo: &RgbImage) -> Result<MaskList> {
        let photo = &exposure::lifted(photo);
        let small = at_side(photo, WORK_SIDE.min(photo.width().max(photo.height())));
        let (w, h) = (small.width() as usize, small.height() as usize);
        let edges = self.edges.edges(&small)?;
        let (basins, count) = watershed(&edges, w, h);
        let features = self.features(photo, &small)?;
        let tree = Hierarchy::build(&basins, count, w, &edges, &features, FEATURES, dissimilarity);
        // What stands at several levels is a mask at each: consensus of the views decides which of them are things.
        let [whole, part] =
            [WHOLE_HEIGHTS, PART_HEIGHTS].map(|[low, high]| tree.is_below(&tree.best_cut(|i| persistence(&tree, i, low, high))));
        let mut list = MaskList::new(photo.width(), photo.height());
        for node in tree.lasting(MIN_AREA * (w * h) as f32, ALIKE) {
            let level = Level::ALL[usize::from(whole[node]) + usize::from(part[node])];
            list.add(level, &region(&tree, node, &basins, w, h).resized(photo.width(), photo.height()));
        }
        Ok(list)
    }
}

/// Mean border edge, colour and meaning; small regions merge early, so that no crumbs are left.
fn dissimilarity(edge: f32, a: &Node, b: &Node) -> f32 {
    let mean = |n: &Node, k: usize| n.feature[k] / n.area;
    let color: f32 = (0..3).map(|k| (mean(a, k) - mean(b, k)).powi(2)).sum::<f32>().sqrt();
    let (mut dot, mut aa, mut bb) = (0.0f32, 1e-6f32, 1e-6f32);
    for k in 3..FEATURES {
        let (x, y) = (mean(a, k), mean(b, k));
        dot += x * y;
        aa += x * x;
        bb += y * y;
    }
    let meaning = 0.5 - 0.5 * dot / (aa * bb).sqrt();
    let small = a.area.min(b.area);
    let crumbs = small / (small + 300.0);
    (0.4 * edge + 0.2 * (color / 40.0).min(1.0) + 0.4 * meaning) * crumbs
}

/// How much a region speaks for being an object: its area times the span of dissimilarity, between `low` and `high`,
/// over which it stands (excess of mass).
fn persistence(tree: &Hierarchy, i: usize, low: f32, high: f32) -> f32 {
    let node = &tree.nodes[i];
    let end = node.parent.map_or(high, |p| tree.nodes[p].height);
    node.area * (end.clamp(low, high) - node.height.clamp(low, high))
}

/// The pixels of a region, as label 1.
fn region(tree: &Hierarchy, node: usize, basins: &[u32], w: usize, h: usize) -> LabelMap {
    let mut is_its = vec![false; tree.nodes.len()];
    tree.leaves(node).into_iter().for_each(|leaf| is_its[leaf] = true);
    let labels = basins.iter().map(|b| u16::from(is_its[*b as usize])).collect();
    LabelMap { width: w as u32, height: h as u32, labels }
}
