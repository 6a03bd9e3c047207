//! The masks of one photo. They may overlap, for example a cup, the cup with its saucer, and the
//! handle of the cup.

pub mod annotations;
mod atoms;
mod file;
mod gaps;
mod run_lengths;

use crate::undistort::Distortion;
use crate::{Camera, LabelMap};
pub use atoms::{AtomTable, Atoms};
pub use run_lengths::RunLengths;
use serde::{Deserialize, Serialize};

/// Size class of a mask.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// A whole object (the paper's *whole* level).
    #[default]
    Whole,
    /// A part of an object.
    Part,
    /// A part of a part.
    Subpart,
}

impl Level {
    /// All levels, coarse to fine.
    pub const ALL: [Self; 3] = [Self::Whole, Self::Part, Self::Subpart];

    /// Returns the name in files and options.
    pub fn name(self) -> &'static str {
        ["whole", "part", "subpart"][self as usize]
    }
}

/// One mask.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mask {
    /// Size class.
    pub level: Level,
    /// IoU with the true object, as the segmenter predicts it, 0 to 1; 1 if unknown.
    pub predicted_iou: f32,
    /// IoU between the masks of a higher and a lower threshold, 0 to 1; 1 if unknown.
    pub stability: f32,
    /// Id that a tracker gave the object, the same in all photos; `None` without tracker.
    pub track: Option<u32>,
    /// Pixels of the mask.
    pub runs: RunLengths,
}

impl Mask {
    /// Creates a mask with scores of 1 and no track id.
    pub fn new(level: Level, runs: RunLengths) -> Self {
        Self {
            level,
            predicted_iou: 1.0,
            stability: 1.0,
            track: None,
            runs,
        }
    }
}

/// All masks of a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MaskList {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Masks in the order in which they were found.
    pub masks: Vec<Mask>,
}

impl MaskList {
    /// Creates an empty list for photos of this size.
    pub fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            masks: Vec::new(),
        }
    }

    /// Appends the masks of a label map in ascending order of their labels. Returns these labels.
    pub fn add(&mut self, level: Level, map: &LabelMap) -> Vec<u16> {
        let boxes = map.boxes();
        let mut labels = Vec::new();
        for (label, [x0, y0, x1, y1]) in boxes
            .iter()
            .enumerate()
            .skip(1)
            .filter_map(|(l, b)| Some((l as u16, (*b)?)))
        {
            let inside = |x: u32, y: u32| {
                (x0..x1).contains(&x) && (y0..y1).contains(&y) && map.at(x, y) == label
            };
            self.masks.push(Mask::new(
                level,
                RunLengths::from_fn(map.width, map.height, inside),
            ));
            labels.push(label);
        }
        labels
    }

    /// Yields the row-major indices of a mask's pixels.
    pub fn pixel_indices(&self, mask: &Mask) -> impl Iterator<Item = usize> {
        mask.runs.pixel_indices(self.width, self.height)
    }

    /// Returns the number of masks of a level.
    pub fn count(&self, level: Level) -> usize {
        self.masks.iter().filter(|m| m.level == level).count()
    }

    /// Removes lens distortion: returns the masks as seen by the pinhole `camera` of the same size.
    /// Masks that become empty are removed.
    #[must_use]
    pub fn undistorted(&self, camera: &Camera, distortion: &Distortion) -> Self {
        let masks = self
            .redrawn(|map| map.undistorted(camera, distortion))
            .flatten()
            .collect();
        Self {
            masks,
            ..Self::new(self.width, self.height)
        }
    }

    /// Transforms each mask with `redraw`, which receives a map that is 1 inside the mask and 0
    /// elsewhere. Yields `None` for masks that become empty.
    pub fn redrawn(
        &self,
        redraw: impl Fn(LabelMap) -> LabelMap,
    ) -> impl Iterator<Item = Option<Mask>> {
        self.masks.iter().map(move |mask| {
            let mut map = LabelMap::new(self.width, self.height);
            self.pixel_indices(mask).for_each(|p| map.labels[p] = 1);
            let map = redraw(map);
            let runs = RunLengths::from_fn(map.width, map.height, |x, y| map.at(x, y) > 0);
            (runs.area() > 0).then(|| Mask {
                runs,
                ..mask.clone()
            })
        })
    }

    /// Returns the masks of a level as a label map. Labels 1, 2, ... are in descending order of
    /// area. Smaller masks cover larger ones. Masks after the 65,535th are dropped.
    pub fn painted(&self, level: Level) -> LabelMap {
        let mut order: Vec<(usize, &Mask)> = self
            .masks
            .iter()
            .filter(|m| m.level == level)
            .map(|m| (m.runs.area(), m))
            .collect();
        order.sort_by_key(|(area, _)| std::cmp::Reverse(*area));
        let mut map = LabelMap::new(self.width, self.height);
        for (label, (_, mask)) in (1..=u16::MAX).zip(order) {
            self.pixel_indices(mask).for_each(|p| map.labels[p] = label);
        }
        map
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(labels: &[u16]) -> LabelMap {
        LabelMap {
            width: 4,
            height: 1,
            labels: labels.to_vec(),
        }
    }

    #[test]
    fn smaller_masks_lie_on_top() {
        let mut list = MaskList::new(4, 1);
        list.add(Level::Whole, &map(&[0, 7, 7, 0]));
        list.add(Level::Whole, &map(&[1, 1, 1, 0]));
        list.add(Level::Part, &map(&[0, 0, 0, 2]));
        assert_eq!(list.painted(Level::Whole), map(&[1, 2, 2, 0]));
        assert_eq!(
            (
                list.count(Level::Whole),
                list.count(Level::Part),
                list.painted(Level::Part).max()
            ),
            (2, 1, 1)
        );
    }

    #[test]
    fn label_maps_become_lists() {
        let mut list = MaskList::new(4, 1);
        assert_eq!(list.add(Level::Whole, &map(&[9, 9, 3, 3])), [3, 9]);
        list.add(Level::Subpart, &map(&[5, 0, 0, 0]));
        let levels: Vec<Level> = list.masks.iter().map(|m| m.level).collect();
        assert_eq!(levels, [Level::Whole, Level::Whole, Level::Subpart]);
        assert_eq!(
            list.pixel_indices(&list.masks[0]).collect::<Vec<_>>(),
            [2, 3]
        );
    }
}
