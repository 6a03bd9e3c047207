//! Id weights: the blending weight of each object id at each pixel of a rendered view.

use std::borrow::Cow;
use std::cmp::Reverse;

/// Number of ids that are kept per pixel.
pub const IDS_PER_PIXEL: usize = 4;

/// Blending weights (alpha x transmittance) of a view, summed by object id. Each pixel keeps the
/// [`IDS_PER_PIXEL`] largest.
#[derive(Clone, Debug, PartialEq)]
pub struct IdWeights {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Row-major packed pairs: id << 16 | weight, with weights 0 to 1 as 0 to 65,535. Unordered
    /// within a pixel. Id 0 means none.
    pub pixels: Vec<[u32; IDS_PER_PIXEL]>,
}

/// Packs an id and its weight, which is clamped to [0, 1].
pub fn pack(id: u16, weight: f32) -> u32 {
    u32::from(id) << 16 | (weight.clamp(0.0, 1.0) * 65_535.0 + 0.5) as u32
}

/// Unpacks the id and the weight (0 to 65,535) of [`pack`].
pub fn unpack(packed: u32) -> (u16, u32) {
    ((packed >> 16) as u16, packed & 0xffff)
}

impl IdWeights {
    /// Returns a mask of the pixels whose weight belongs mostly to the ids with `member[id]`. Ids
    /// beyond the list are not members.
    pub fn mask(&self, member: &[bool]) -> Vec<bool> {
        let own = |share: &(u16, u32)| member.get(usize::from(share.0)) == Some(&true);
        let most = |pixel: &[u32; IDS_PER_PIXEL]| {
            is_majority(
                pixel
                    .iter()
                    .map(|s| unpack(*s))
                    .filter(own)
                    .map(|s| s.1)
                    .sum(),
                pixel,
            )
        };
        self.pixels.iter().map(most).collect()
    }

    /// Returns, for each pixel in row-major order, the sets that have most of its weight, in
    /// descending order.
    ///
    /// `sets[id]` lists the sets that contain an id, in descending order. A pixel lists a set
    /// exactly if [`Self::mask`] of the set's ids is true there.
    pub fn majority_sets<'a, S: Copy + Ord>(
        &'a self,
        sets: &'a [Vec<S>],
    ) -> impl Iterator<Item = Cow<'a, [S]>> {
        let sets_of = |id: u16| sets.get(usize::from(id)).map_or(&[][..], Vec::as_slice);
        self.pixels.iter().map(move |pixel| {
            let parts = pixel.map(unpack);
            if let Some(dominant) = parts.iter().find(|s| is_majority(s.1, pixel)) {
                return Cow::Borrowed(sets_of(dominant.0));
            }
            let mut sums: Vec<(S, u32)> = Vec::new();
            for (set, weight) in parts
                .iter()
                .flat_map(|s| sets_of(s.0).iter().map(|set| (*set, s.1)))
            {
                match sums.iter_mut().find(|sum| sum.0 == set) {
                    Some(sum) => sum.1 += weight,
                    None => sums.push((set, weight)),
                }
            }
            sums.retain(|sum| is_majority(sum.1, pixel));
            sums.sort_unstable_by_key(|sum| Reverse(sum.0));
            Cow::Owned(sums.into_iter().map(|sum| sum.0).collect())
        })
    }
}

/// Returns whether `own` is more than half of a pixel's total weight, and at least the remaining
/// transmittance (1 minus the total). All weights are 0 to 65,535.
fn is_majority(own: u32, pixel: &[u32; IDS_PER_PIXEL]) -> bool {
    let all: u32 = pixel.iter().map(|s| unpack(*s).1).sum();
    2 * own > all && own + all.min(65_535) >= 65_535
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mask_sums_the_weights_of_member_ids() {
        let shares = |list: &[(u16, f32)]| -> [u32; IDS_PER_PIXEL] {
            std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1)))
        };
        let pixels = vec![
            shares(&[(1, 0.3), (2, 0.3), (3, 0.4)]),
            shares(&[(3, 0.2)]),
            shares(&[(0, 0.5), (7, 0.5)]),
        ];
        let shares = IdWeights {
            width: 3,
            height: 1,
            pixels,
        };
        // Ids 1 and 2 together outweigh id 3, which is the largest single one.
        assert_eq!(shares.mask(&[false, true, true]), [true, false, false]);
        assert_eq!(
            shares.mask(&[false, false, false, true]),
            [false, false, false]
        );
    }

    #[test]
    fn majority_sets_agree_with_mask() {
        let shares = |list: &[(u16, f32)]| -> [u32; IDS_PER_PIXEL] {
            std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1)))
        };
        // Sets 7 and 8 overlap; set 3 contains both.
        let sets: [Vec<u16>; 5] = [vec![], vec![7, 3], vec![8, 3], vec![8, 7, 3], vec![3]];
        let pixels = vec![
            shares(&[(1, 0.7), (2, 0.3)]),
            shares(&[(1, 0.4), (2, 0.4), (4, 0.2)]),
            shares(&[(3, 0.4), (2, 0.3), (0, 0.3)]),
            shares(&[(1, 0.3), (0, 0.5)]),
            shares(&[(1, 0.4)]),
            shares(&[(9, 1.0)]),
        ];
        let shares = IdWeights {
            width: 6,
            height: 1,
            pixels,
        };
        let found: Vec<Vec<u16>> = shares.majority_sets(&sets).map(Cow::into_owned).collect();
        assert_eq!(
            found,
            [vec![7, 3], vec![3], vec![8, 3], vec![], vec![], vec![]]
        );
        for set in [3, 7, 8] {
            let members: Vec<bool> = sets.iter().map(|of| of.contains(&set)).collect();
            assert_eq!(
                shares.mask(&members),
                found.iter().map(|f| f.contains(&set)).collect::<Vec<_>>(),
                "{set}"
            );
        }
    }
}
