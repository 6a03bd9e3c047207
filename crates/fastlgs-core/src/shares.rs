//! Which objects the pixels of a rendered view show, and how much of each.

use crate::LabelMap;

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
    /// The id with the largest weight at each pixel; 0 where nothing weighs as much as what passes through.
    pub fn winners(&self) -> LabelMap {
        let winner = |pixel: &[u32; KEPT]| {
            let total: u32 = pixel.iter().map(|s| unpack(*s).1).sum();
            let best = pixel.iter().map(|s| unpack(*s)).max_by_key(|&(id, w)| (w, std::cmp::Reverse(id)));
            best.filter(|&(_, w)| w + total.min(65_535) >= 65_535).map_or(0, |b| b.0)
        };
        LabelMap { width: self.width, height: self.height, labels: self.pixels.iter().map(winner).collect() }
    }

    /// Whether the ids for which `member` holds (by id; unknown ids do not) have most of a pixel's weight.
    pub fn mask(&self, member: &[bool]) -> Vec<bool> {
        let most = |pixel: &[u32; KEPT]| {
            let (mut own, mut all) = (0, 0);
            for (id, weight) in pixel.iter().map(|s| unpack(*s)) {
                own += if member.get(usize::from(id)) == Some(&true) { weight } else { 0 };
                all += weight;
            }
            2 * own > all && own + all.min(65_535) >= 65_535
        };
        self.pixels.iter().map(most).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_decide() {
        let shares = |list: &[(u16, f32)]| -> [u32; KEPT] { std::array::from_fn(|k| list.get(k).map_or(0, |s| pack(s.0, s.1))) };
        let pixels = vec![shares(&[(1, 0.3), (2, 0.3), (3, 0.4)]), shares(&[(3, 0.2)]), shares(&[(0, 0.5), (7, 0.5)])];
        let shares = Shares { width: 3, height: 1, pixels };
        assert_eq!(shares.winners().labels, [3, 0, 0]);
        // 1 and 2 together outweigh 3, which alone is the heaviest.
        assert_eq!(shares.mask(&[false, true, true]), [true, false, false]);
        assert_eq!(shares.mask(&[false, false, false, true]), [false, false, false]);
    }
}
