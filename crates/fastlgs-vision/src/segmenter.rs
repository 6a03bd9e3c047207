//! Object masks of photos.

use crate::edges::Hed;
use crate::regions::{Hierarchy, Node, watershed};
use crate::Result;
use fastlgs_core::{LabelMap, image_io};
use image::RgbImage;

/// Masks of one photo, coarse to fine.
pub struct Segmentation {
    /// Objects (the paper's *whole* level).
    pub whole: LabelMap,
    /// Their parts.
    pub part: LabelMap,
}

/// Finds masks.
pub trait Segmenter {
    /// Name recorded in the scene.
    fn name(&self) -> &'static str;
    /// Segments one photo; the label maps have its size.
    ///
    /// # Errors
    /// When inference fails.
    fn segment(&self, photo: &RgbImage) -> Result<Segmentation>;
}

/// Learned edges (HED) and colour, turned into a region hierarchy; its most lasting regions are the objects.
pub struct OfflineSegmenter {
    edges: Hed,
}

/// Longer side at which edges are found: HED was trained near this size.
const WORK_SIDE: u32 = 480;
/// Smallest mask as a share of the photo.
const MIN_AREA: f32 = 0.002;

impl OfflineSegmenter {
    /// Loads the edge detector.
    ///
    /// # Errors
    /// When it is not installed.
    pub fn load() -> Result<Self> {
        Ok(Self { edges: Hed::load()? })
    }
}

impl Segmenter for OfflineSegmenter {
    fn name(&self) -> &'static str {
        "offline"
    }

    fn segment(&self, photo: &RgbImage) -> Result<Segmentation> {
        let scale = (WORK_SIDE as f32 / photo.width().max(photo.height()) as f32).min(1.0);
        let size = |n: u32| ((n as f32 * scale).round() as u32).max(16);
        let small = image_io::resize(photo, size(photo.width()), size(photo.height()));
        let (w, h) = (small.width() as usize, small.height() as usize);
        let edges = self.edges.edges(&small)?;
        let (basins, count) = watershed(&edges, w, h);
        let colors: Vec<f32> = small.pixels().flat_map(|p| lab(p.0)).collect();
        let tree = Hierarchy::build(&basins, count, w, &edges, &colors, 3, dissimilarity);
        let total = (w * h) as f32;
        let lasting = |i: usize| lifetime_value(&tree, i, total);
        let whole_cut = tree.best_cut(lasting);
        let part_cut = tree.best_cut(|i| if tree.nodes[i].height < PART_HEIGHT { lasting(i) + tree.nodes[i].area / total } else { 0.0 });
        let paint = |cut: &[usize]| label_map(&tree, cut, &basins, w, h, total).resized(photo.width(), photo.height());
        Ok(Segmentation { whole: paint(&whole_cut), part: paint(&part_cut) })
    }
}

/// Dissimilarity above which regions are no longer parts of one thing.
const PART_HEIGHT: f32 = 0.25;

/// Mean border edge and colour difference; small regions merge early, so that no crumbs are left.
fn dissimilarity(edge: f32, a: &Node, b: &Node) -> f32 {
    let difference: f32 = (0..3).map(|k| (a.feature[k] / a.area - b.feature[k] / b.area).powi(2)).sum::<f32>().sqrt();
    let color = (difference / 40.0).min(1.0);
    let small = a.area.min(b.area);
    let crumbs = small / (small + 150.0);
    (0.65 * edge + 0.35 * color) * crumbs
}

/// How much a region speaks for being an object: area times the span of dissimilarity over which it stands.
fn lifetime_value(tree: &Hierarchy, i: usize, total: f32) -> f32 {
    let node = &tree.nodes[i];
    let end = node.parent.map_or(node.height, |p| tree.nodes[p].height);
    let share = node.area / total;
    if share > 0.6 { 0.0 } else { share.sqrt() * (end - node.height).max(0.0) * share.sqrt() }
}

/// Paints the regions of a cut, largest first; tiny ones are left unlabelled.
fn label_map(tree: &Hierarchy, cut: &[usize], basins: &[u32], w: usize, h: usize, total: f32) -> LabelMap {
    let mut regions: Vec<usize> = cut.iter().copied().filter(|&i| tree.nodes[i].area >= MIN_AREA * total).collect();
    regions.sort_by(|&a, &b| tree.nodes[b].area.total_cmp(&tree.nodes[a].area).then(a.cmp(&b)));
    let mut label_of = vec![0u16; basins.iter().max().map_or(0, |b| *b as usize + 1)];
    for (k, &region) in regions.iter().enumerate().take(usize::from(u16::MAX)) {
        for leaf in tree.leaves(region) {
            label_of[leaf] = k as u16 + 1;
        }
    }
    let mut map = LabelMap::new(w as u32, h as u32);
    map.labels.iter_mut().zip(basins).for_each(|(l, b)| *l = label_of[*b as usize]);
    map
}

/// sRGB to CIE Lab (D65).
fn lab(rgb: [u8; 3]) -> [f32; 3] {
    let linear = rgb.map(|v| {
        let v = f32::from(v) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    });
    let [r, g, b] = linear;
    let f = |t: f32| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 };
    let x = f((0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505);
    let y = f(0.2126 * r + 0.7152 * g + 0.0722 * b);
    let z = f((0.0193 * r + 0.1192 * g + 0.9505 * b) / 1.089);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}
