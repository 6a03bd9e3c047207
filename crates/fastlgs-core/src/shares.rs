//! Which objects the pixels of a rendered view show, and how much of each.

use std::borrow::Cow;
use std::cmp::Reverse;

/// Ids that a pixel keeps.
pub const KEPT: usize = 4;

/// Blending weights alpha * transmittance of a view, summed by object id: the heaviest [`KEPT`] of each pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Shares {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Row by row, in no order within a pixel: id << 16 | weight of 0 to 1 as 0 to 65,535. Id 0 is "no object".
    pub pixels: Vec<[u32; KEPT]>,
}

/// One id with its weight.
pub fn pack(id: u16, weight: f32) -> u32 {
    u32::from(id) << 16 | (weight.clamp(0.0, 1.0) * 65_535.0 + 0.5) as u32
}

/// Id and weight of [`pack`].
pub fn unpack(share: u32) -> (u16, u32) {
    ((share >> 16) as u16, share & 0xffff)
}

impl Shares {
    /// Whether the ids for which `member` holds (by id; unknown ids do not) have most of a pixel's weight.
    pub fn mask(&self, member: &[bool]) -> Vec<bool> {
        let own = |share: &(u16, u32)| member.get(usize::from(share.0)) == Some(&true);
        let most = |pixel: &[u32; KEPT]| is_most(pixel.iter().map(|s| unpack(*s)).filter(own).map(|s| s.1).sum(), pixel);
        self.pixels.iter().map(most).collect()
    }

    /// At each pixel the sets that have most of its weight, as each id's list in `sets` has them, which must fall; they fall too. [`Self::mask`] of
    /// the ids in a set is where this names it.
    pub fn held<'a, S: Copy + Ord>(&'a self, sets: &'a [Vec<S>]) -> impl Iterator<Item = Cow<'a, [S]>> {
        let of = |id: u16| sets.get(usize::from(id)).map_or(&[][..], Vec::as_slice);
        self.pixels.iter().map(move |pixel| {
            let parts = pixel.map(unpack);
            if let Some(alone) = parts.iter().find(|s| is_most(s.1, pixel)) {
                return Cow::Borrowed(of(alone.0));
            }
            let mut sums: Vec<(S, u32)> = Vec::new();
            for (set, weight) in parts.iter().flat_map(|s| of(s.0).iter().map(|set| (*set, s.1))) {
                match sums.iter_mut().find(|sum| sum.0 == set) {
                    Some(sum) => sum.1 += weight,
                    None => sums.push((set, weight)),
                }
            }
            sums.retain(|sum| is_most(sum.1, pixel));
            sums.sort_unstable_by_key(|sum| Reverse(sum.0));
            Cow::Owned(sums.into_iter().map(|sum| sum.0).collect())
        })
    }
}

/// Whether `own` is most of a pixel's weight, and no less than what passes through.
fn is_most(own: u32, pixel: &[u32; KEPT]) -> bool {
    let all: u32 = pixel.iter().map(|s| unpack(*s).1).sum();
    2 * own > all && own + all.min(65_535) >= 65_535
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_decide() {
        let shares = |list: &[(u16, f32)]| -> [u32; KEPT] { std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1))) };
        let pixels = vec![shares(&[(1, 0.3), (2, 0.3), (3, 0.4)]), shares(&[(3, 0.2)]), shares(&[(0, 0.5), (7, 0.5)])];
        let shares = Shares { width: 3, height: 1, pixels };
        // 1 and 2 together outweigh 3, which alone is the heaviest.
        assert_eq!(shares.mask(&[false, true, true]), [true, false, false]);
        assert_eq!(shares.mask(&[false, false, false, true]), [false, false, false]);
    }

    #[test]
    fn sets_that_overlap_are_found_where_they_have_most_of_the_weight() {
        let shares = |list: &[(u16, f32)]| -> [u32; KEPT] { std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1))) };
        // Set 7 overlaps 8, and both lie in 3.
        let sets: [Vec<u16>; 5] = [vec![], vec![7, 3], vec![8, 3], vec![8, 7, 3], vec![3]];
        let pixels = vec![
            shares(&[(1, 0.7), (2, 0.3)]),
            shares(&[(1, 0.4), (2, 0.4), (4, 0.2)]),
            shares(&[(3, 0.4), (2, 0.3), (0, 0.3)]),
            shares(&[(1, 0.3), (0, 0.5)]),
            shares(&[(1, 0.4)]),
            shares(&[(9, 1.0)]),
        ];
        let shares = Shares { width: 6, height: 1, pixels };
        let found: Vec<Vec<u16>> = shares.held(&sets).map(Cow::into_owned).collect();
        assert_eq!(found, [vec![7, 3], vec![3], vec![8, 3], vec![], vec![], vec![]]);
        for set in [3, 7, 8] {
            let members: Vec<bool> = sets.iter().map(|of| of.contains(&set)).collect();
            assert_eq!(shares.mask(&members), found.iter().map(|f| f.contains(&set)).collect::<Vec<_>>(), "{set}");
        }
    }
}
