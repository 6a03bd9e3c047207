//! Divides a photo into atoms: the pixels that lie in the same masks. Votes for atoms are votes for
//! all their masks.

use super::{MaskList, gaps};
use crate::LabelMap;
use std::collections::BTreeMap;

/// The atoms of a photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Atoms {
    /// Atom of each pixel; 0 for pixels in no mask.
    pub map: LabelMap,
    /// Masks of each atom.
    pub table: AtomTable,
}

/// Relations between the atoms and masks of a photo.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AtomTable {
    /// For each atom, the indices of its masks in the list, in ascending order.
    masks: Vec<Vec<u16>>,
    /// For each mask, its area in pixels; 0 for a mask that was left out.
    pub areas: Vec<u32>,
    /// For each mask, its track id, if any.
    pub tracks: Vec<Option<u32>>,
    /// Number of masks left out because their atoms would not fit in 16-bit labels.
    pub left_out: usize,
}

impl AtomTable {
    /// Returns the number of atoms, including atom 0, which lies in no mask.
    pub fn count(&self) -> usize {
        self.masks.len()
    }

    /// Returns the indices of the masks of an atom, in ascending order.
    pub fn masks(&self, atom: u16) -> &[u16] {
        &self.masks[usize::from(atom)]
    }
}

impl Atoms {
    /// Closes narrow gaps between masks: each pixel of a gap joins the nearest atom. The areas of
    /// that atom's masks grow accordingly.
    #[must_use]
    pub fn without_gaps(mut self) -> Self {
        let before = self.map.labels.clone();
        gaps::close(&mut self.map);
        for (atom, _) in self
            .map
            .labels
            .iter()
            .zip(before)
            .filter(|(atom, before)| *before != **atom)
        {
            self.table.masks[usize::from(*atom)]
                .iter()
                .for_each(|mask| self.table.areas[usize::from(*mask)] += 1);
        }
        self
    }
}

impl MaskList {
    /// Computes the atoms of these masks. Leaves out masks after the 65,535th, and masks that would
    /// create more atoms than 16-bit labels allow.
    pub fn atoms(&self) -> Atoms {
        const MAX_LABEL: usize = u16::MAX as usize;
        // For each atom, its masks and its number of pixels. Atom 0 lies in no mask; it exists even
        // if masks cover all pixels.
        let mut atoms: Vec<(Vec<u16>, u32)> = vec![(Vec::new(), self.width * self.height)];
        let mut at = vec![0u32; (self.width * self.height) as usize];
        let mut table = AtomTable {
            tracks: self.masks.iter().map(|m| m.track).collect(),
            ..AtomTable::default()
        };
        for (k, mask) in self.masks.iter().enumerate() {
            let mut common: BTreeMap<u32, u32> = BTreeMap::new();
            self.pixel_indices(mask)
                .for_each(|p| *common.entry(at[p]).or_default() += 1);
            // An atom that lies completely inside the mask is not divided.
            let is_contained =
                |atom: u32, pixels: u32| atom > 0 && pixels == atoms[atom as usize].1;
            let cut = common.iter().filter(|c| !is_contained(*c.0, *c.1)).count();
            if k >= MAX_LABEL || atoms.len() + cut > MAX_LABEL {
                table.areas.push(0);
                table.left_out += 1;
                continue;
            }
            let mut inside: BTreeMap<u32, u32> = BTreeMap::new();
            for (&atom, &pixels) in &common {
                let (masks, all) = &mut atoms[atom as usize];
                if atom > 0 && pixels == *all {
                    masks.push(k as u16);
                    continue;
                }
                *all -= pixels;
                let masks = masks.iter().copied().chain([k as u16]).collect();
                inside.insert(atom, atoms.len() as u32);
                atoms.push((masks, pixels));
            }
            for p in self.pixel_indices(mask) {
                at[p] = inside.get(&at[p]).copied().unwrap_or(at[p]);
            }
            table.areas.push(common.values().sum());
        }
        table.masks = atoms.into_iter().map(|a| a.0).collect();
        Atoms {
            map: LabelMap {
                width: self.width,
                height: self.height,
                labels: at.into_iter().map(|a| a as u16).collect(),
            },
            table,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Level, Mask, RunLengths};
    use super::*;

    fn list(masks: &[&str]) -> MaskList {
        let width = masks[0].len() as u32;
        let of = |bits: &&str| {
            Mask::new(
                Level::Whole,
                RunLengths::from_fn(width, 1, |x, _| bits.as_bytes()[x as usize] == b'#'),
            )
        };
        MaskList {
            width,
            height: 1,
            masks: masks.iter().map(of).collect(),
        }
    }

    #[test]
    fn masks_cut_each_other() {
        let atoms = list(&["####....", "..####..", "..##....", "........"]).atoms();
        let masks: Vec<&[u16]> = atoms
            .map
            .labels
            .iter()
            .map(|a| atoms.table.masks(*a))
            .collect();
        assert_eq!(
            masks,
            [&[0][..], &[0], &[0, 1, 2], &[0, 1, 2], &[1], &[1], &[], &[]]
        );
        assert_eq!(
            (atoms.table.areas, atoms.table.left_out),
            (vec![4, 4, 2, 0], 0)
        );
        assert_eq!(
            atoms.table.masks.len(),
            4,
            "a mask equal to an existing atom adds no atom"
        );
    }

    #[test]
    fn a_photo_that_is_one_mask_keeps_atom_0_for_no_mask() {
        let atoms = list(&["###"]).atoms();
        assert_eq!(
            (atoms.map.labels, atoms.table.masks),
            (vec![1; 3], vec![vec![], vec![0]])
        );
    }

    #[test]
    fn masks_that_exceed_16_bit_atoms_are_left_out() {
        let mut masks = MaskList::new(300, 300);
        masks.masks = (0..70_000u32)
            .map(|p| {
                Mask::new(
                    Level::Whole,
                    RunLengths::from_counts(vec![p, 1, 89_999 - p], 90_000).expect("whole"),
                )
            })
            .collect();
        let atoms = masks.atoms();
        assert_eq!(
            (atoms.table.left_out, atoms.map.max()),
            (70_000 - 65_534, 65_534)
        );
    }
}
