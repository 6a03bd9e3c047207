//! Closes gaps between masks. Segmenters leave one or two uncovered pixels between adjacent
//! objects, although each pixel belongs to one of them.

use crate::LabelMap;
use crate::metrics::dilate;

/// Half side of the square that defines a gap, in pixels. Uncovered pixels are a gap where no
/// uncovered 5x5 square fits: gaps are at most 4 pixels wide.
const GAP_RADIUS: u32 = 2;

/// Gives each pixel of a gap (label 0) the nearest label. Wider uncovered areas keep label 0,
/// because no mask covers them.
pub(super) fn close(map: &mut LabelMap) {
    let (width, height) = (map.width as usize, map.height as usize);
    let covered: Vec<bool> = map.labels.iter().map(|label| *label > 0).collect();
    // Morphological opening of the uncovered pixels: erosion, then dilation.
    let dilate_gap = |mask: &[bool]| dilate(mask, map.width, map.height, [GAP_RADIUS; 2]);
    let wide = dilate_gap(
        &dilate_gap(&covered)
            .iter()
            .map(|near| !near)
            .collect::<Vec<_>>(),
    );
    let mut gaps: Vec<usize> = (0..covered.len())
        .filter(|&p| !covered[p] && !wide[p])
        .collect();
    // Each round extends all labels by one pixel into the gaps.
    for _ in 0..2 * GAP_RADIUS {
        let neighbour_label = |p: &usize| {
            let (x, y) = (p % width, p / width);
            let near = [
                (x > 0, p.wrapping_sub(1)),
                (x + 1 < width, p + 1),
                (y > 0, p.wrapping_sub(width)),
                (y + 1 < height, p + width),
            ];
            near.into_iter()
                .filter(|n| n.0)
                .map(|(_, q)| map.labels[q])
                .find(|label| *label > 0)
        };
        let found: Vec<(usize, u16)> = gaps
            .iter()
            .filter_map(|p| Some((*p, neighbour_label(p)?)))
            .collect();
        found
            .into_iter()
            .for_each(|(p, label)| map.labels[p] = label);
        gaps.retain(|p| map.labels[*p] == 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn narrow_gaps_are_split_and_wide_ones_stay_uncovered() {
        // Labels 1 and 2 with four uncovered columns between them, then eight uncovered columns.
        let column = |x: u32| match x {
            0..6 => 1,
            10..16 => 2,
            _ => 0,
        };
        let mut map = LabelMap {
            width: 24,
            height: 12,
            labels: (0..24 * 12).map(|p| column(p % 24)).collect(),
        };
        close(&mut map);
        let row: Vec<u16> = map.labels[6 * 24..][..24].to_vec();
        assert_eq!(row, [[1; 8].as_slice(), &[2; 8], &[0; 8]].concat());
        assert!(map.labels.chunks(24).all(|other| other == row));
    }
}
