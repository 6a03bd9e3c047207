//! Which objects the pixels of a rendered view show, and how much of each.

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
    u32::from(id) << 16 | (weight * 65_535.0 + 0.5) as u32
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

    /// At each pixel the smallest of nested sets that has most of the weight, where the ids' own sets are `of` and `above` gives the next larger
    /// set, which must compare as greater. [`Self::mask`] of a set is where this finds it or one within it.
    pub fn smallest<'a, S: Copy + Ord>(
        &'a self,
        of: impl Fn(u16) -> Option<S> + 'a,
        above: impl Fn(S) -> Option<S> + 'a,
    ) -> impl Iterator<Item = Option<S>> + 'a {
        self.pixels.iter().map(move |pixel| {
            let mut sets: [Option<S>; KEPT] = pixel.map(|share| Some(unpack(share)).filter(|s| s.1 > 0).and_then(|s| of(s.0)));
            loop {
                let least = sets.iter().flatten().min().copied()?;
                let within = |k: &usize| sets[*k] == Some(least);
                if is_most((0..KEPT).filter(within).map(|k| unpack(pixel[k]).1).sum(), pixel) {
                    return Some(least);
                }
                sets.iter_mut().filter(|s| **s == Some(least)).for_each(|s| *s = above(least));
            }
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
    fn the_smallest_set_with_most_of_the_weight_is_found() {
        let shares = |list: &[(u16, f32)]| -> [u32; KEPT] { std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1))) };
        // 1 and 2 lie in 3, which lies in 5 with 4.
        let above = |set: u16| [0, 3, 3, 5, 5, 0][usize::from(set)];
        let above = |set: u16| Some(above(set)).filter(|s| *s > 0);
        let pixels = vec![
            shares(&[(1, 0.7), (2, 0.3)]),
            shares(&[(1, 0.4), (2, 0.4), (4, 0.2)]),
            shares(&[(4, 0.4), (1, 0.3), (0, 0.3)]),
            shares(&[(1, 0.3), (0, 0.5)]),
            shares(&[(1, 0.4)]),
        ];
        let shares = Shares { width: 5, height: 1, pixels };
        let found: Vec<Option<u16>> = shares.smallest(|id| Some(id).filter(|id| *id > 0), above).collect();
        assert_eq!(found, [Some(1), Some(3), Some(5), None, None]);
        let within = |set: u16| move |id: u16| std::iter::successors(Some(id), |id| above(*id)).any(|s| s == set);
        for set in 1..=5 {
            let members: Vec<bool> = (0..=5).map(within(set)).collect();
            assert_eq!(shares.mask(&members), found.iter().map(|f| f.is_some_and(within(set))).collect::<Vec<_>>(), "{set}");
        }
    }
}
