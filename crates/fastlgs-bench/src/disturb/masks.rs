//! Disturbed masks.

use super::random_subset;
use anyhow::Result;
use fastlgs_core::mask_list::{Mask, RunLengths};
use fastlgs_core::rng::Rng;
use fastlgs_core::{MaskList, SceneFolder};
use glam::Vec2;

/// A change of the masks of all levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MaskChange {
    /// Erosion by this many pixels.
    Eroded(u32),
    /// A random fraction of the masks is split in two along a line.
    Split(f32),
    /// A random fraction of the masks is merged with an adjacent mask.
    Merged(f32),
    /// A random fraction of the masks is missing.
    Dropped(f32),
}

/// Changes the masks of all training views of a scene in place.
pub fn masks(scene: &SceneFolder, change: MaskChange, seed: u64) -> Result<()> {
    let mut rng = Rng::new(seed, "disturbed masks");
    for camera in scene.manifest()?.training(&scene.cameras()?) {
        changed_masks(&scene.masks(&camera)?, change, &mut rng)
            .save(&scene.masks_path(&camera.name))?;
    }
    Ok(())
}

/// Returns the changed masks. They may overlap, as the given ones. Empty masks are removed.
fn changed_masks(list: &MaskList, change: MaskChange, rng: &mut Rng) -> MaskList {
    let some = |share: f32, rng: &mut Rng| random_subset(list.masks.len(), share, rng, |_| true);
    let mut out = list.clone();
    match change {
        MaskChange::Eroded(pixels) => {
            for mask in &mut out.masks {
                mask.runs = Pixels::of(list, &mask.runs).eroded(pixels as isize).runs();
            }
        }
        MaskChange::Dropped(share) => {
            for own in some(share, rng) {
                out.masks[own].runs = RunLengths::default();
            }
        }
        MaskChange::Merged(share) => {
            for own in some(share, rng) {
                merge(&mut out, own, rng);
            }
        }
        MaskChange::Split(share) => {
            for own in some(share, rng) {
                split(&mut out, own, std::f32::consts::TAU * rng.uniform());
            }
        }
    }
    out.masks.retain(|mask| mask.runs.area() > 0);
    out
}

/// Moves a random adjacent mask of the same level into mask `own`, if there is one.
fn merge(list: &mut MaskList, own: usize, rng: &mut Rng) {
    let mut pixels = Pixels::of(list, &list.masks[own].runs);
    let around = pixels.grown();
    let level = list.masks[own].level;
    let is_adjacent = |other: &Mask| {
        let (mut touches, mut overlaps) = (false, false);
        for p in list.pixel_indices(other) {
            touches |= around[p];
            overlaps |= pixels.inside[p];
        }
        other.level == level && touches && !overlaps
    };
    let beside: Vec<usize> = (0..list.masks.len())
        .filter(|k| is_adjacent(&list.masks[*k]))
        .collect();
    if !beside.is_empty() {
        let other = beside[rng.below(beside.len())];
        list.pixel_indices(&list.masks[other])
            .for_each(|p| pixels.inside[p] = true);
        list.masks[other].runs = RunLengths::default();
        list.masks[own].runs = pixels.runs();
        list.masks[own].track = None;
    }
}

/// Splits mask `own` along a line through its centre, at a right angle to the direction `angle`
/// in radians. The second half is appended.
fn split(list: &mut MaskList, own: usize, angle: f32) {
    let mask = &list.masks[own];
    let pixels = Pixels::of(list, &mask.runs);
    let place = |p: usize| Vec2::new((p % pixels.w) as f32, (p / pixels.w) as f32);
    let centre = list.pixel_indices(mask).map(place).sum::<Vec2>() / mask.runs.area() as f32;
    let is_ahead = |p: usize| Vec2::from_angle(angle).dot(place(p) - centre) > 0.0;
    let half = |ahead: bool| Mask {
        runs: pixels.filtered(|p| is_ahead(p) == ahead).runs(),
        track: None,
        ..mask.clone()
    };
    let (behind, ahead) = (half(false), half(true));
    list.masks[own] = behind;
    list.masks.push(ahead);
}

/// A mask with one value a pixel.
struct Pixels {
    w: usize,
    h: usize,
    inside: Vec<bool>,
}

impl Pixels {
    fn of(list: &MaskList, runs: &RunLengths) -> Self {
        let (w, h) = (list.width as usize, list.height as usize);
        let mut inside = vec![false; w * h];
        runs.pixel_indices(list.width, list.height)
            .for_each(|p| inside[p] = true);
        Self { w, h, inside }
    }

    fn runs(&self) -> RunLengths {
        RunLengths::from_fn(self.w as u32, self.h as u32, |x, y| {
            self.inside[y as usize * self.w + x as usize]
        })
    }

    /// Returns the pixels that `keep` accepts by their index.
    fn filtered(&self, keep: impl Fn(usize) -> bool) -> Self {
        let inside = (0..self.w * self.h).map(|p| self.inside[p] && keep(p));
        Self {
            inside: inside.collect(),
            ..*self
        }
    }

    /// Returns the pixels whose [`Self::neighbours`] are all inside.
    fn eroded(&self, pixels: isize) -> Self {
        self.filtered(|p| self.neighbours(p, pixels).all(|q| self.inside[q]))
    }

    /// Returns for each pixel whether it or a neighbour is inside.
    fn grown(&self) -> Vec<bool> {
        (0..self.w * self.h)
            .map(|p| self.neighbours(p, 1).any(|q| self.inside[q]))
            .collect()
    }

    /// Returns the indices of the pixels in the same row or column, up to `pixels` away. At the
    /// image border, indices are clamped.
    fn neighbours(&self, place: usize, pixels: isize) -> impl Iterator<Item = usize> {
        let (w, h) = (self.w as isize, self.h as isize);
        let (x, y) = (place as isize % w, place as isize / w);
        let at = move |x: isize, y: isize| (y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize;
        (-pixels..=pixels).flat_map(move |d| [at(x + d, y), at(x, y + d)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Level;

    /// Whole masks of columns 2..4, 4..6 and 6..8 of eight, and a part mask of columns 2..6.
    fn list() -> MaskList {
        let columns = |from: u32, to: u32| {
            Mask::new(
                Level::Whole,
                RunLengths::from_fn(8, 4, |x, _| (from..to).contains(&x)),
            )
        };
        let both = Mask {
            level: Level::Part,
            ..columns(2, 6)
        };
        MaskList {
            masks: vec![columns(2, 4), columns(4, 6), columns(6, 8), both],
            ..MaskList::new(8, 4)
        }
    }

    fn areas(change: MaskChange) -> Vec<usize> {
        changed_masks(&list(), change, &mut Rng::new(0, "test"))
            .masks
            .iter()
            .map(|m| m.runs.area())
            .collect()
    }

    #[test]
    fn changed_masks_have_the_expected_areas() {
        assert_eq!(
            areas(MaskChange::Eroded(1)),
            [4, 8],
            "the image border protects the last mask, and the wide mask keeps its middle columns"
        );
        assert_eq!(areas(MaskChange::Dropped(0.5)).len(), 2);
        let split = areas(MaskChange::Split(1.0));
        assert_eq!((split.len(), split.iter().sum::<usize>()), (8, 40));
        let merged = areas(MaskChange::Merged(1.0));
        assert_eq!(
            merged,
            [24, 16],
            "the three whole masks become one; the part mask has no adjacent mask of its level"
        );
    }
}
