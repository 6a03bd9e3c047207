//! COCO run lengths of a mask: alternating numbers of pixels outside and inside, column by column,
//! starting outside.

/// A mask as run lengths.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct RunLengths(Vec<u32>);

/// COCO text stores each count in groups of five bits, least significant group first. Bit 5 means
/// that another group follows. The last group is sign-extended. An offset of 48 makes each group a
/// printable character.
const BITS: u32 = 5;
const CONTINUE_BIT: i64 = 1 << BITS;
const ASCII_OFFSET: u8 = 48;

impl RunLengths {
    /// Creates the run lengths of the pixels (x, y) for which `member` returns true.
    pub fn from_fn(width: u32, height: u32, member: impl Fn(u32, u32) -> bool) -> Self {
        let column = |x: u32| (0..height).map(move |y| (x, y));
        Self::from_runs((0..width).flat_map(column).map(|(x, y)| (member(x, y), 1)))
    }

    /// Creates the run lengths of consecutive runs of pixels, column by column: whether they are
    /// inside, and their number. Neighbouring runs may both be inside or outside.
    pub fn from_runs(parts: impl Iterator<Item = (bool, u32)>) -> Self {
        let (mut runs, mut inside, mut length) = (Vec::new(), false, 0);
        for (is_member, count) in parts {
            if is_member != inside {
                runs.push(std::mem::take(&mut length));
                inside = !inside;
            }
            length += count;
        }
        runs.push(length);
        Self(runs)
    }

    /// Creates run lengths from counts; `None` if their sum is not `pixels`.
    pub fn from_counts(counts: Vec<u32>, pixels: u64) -> Option<Self> {
        (counts.iter().map(|c| u64::from(*c)).sum::<u64>() == pixels).then_some(Self(counts))
    }

    /// Decodes COCO text; `None` if it is damaged or the counts do not add up to `pixels`.
    pub fn from_text(text: &str, pixels: u64) -> Option<Self> {
        let mut counts: Vec<u32> = Vec::new();
        let mut bytes = text.bytes();
        while let Some(mut byte) = bytes.next() {
            let (mut value, mut shift) = (0i64, 0);
            loop {
                let bits = i64::from(byte.checked_sub(ASCII_OFFSET).filter(|b| *b < 64)?);
                value |= (bits & (CONTINUE_BIT - 1)) << shift;
                shift += BITS;
                if bits & CONTINUE_BIT == 0 {
                    if bits & (CONTINUE_BIT >> 1) != 0 {
                        value -= 1 << shift;
                    }
                    break;
                }
                // A count has at most 32 bits and a sign: seven groups.
                byte = bytes.next().filter(|_| shift <= 30)?;
            }
            // From index 3 on, the text stores the difference from the count two places earlier.
            let before = if counts.len() > 2 {
                counts[counts.len() - 2]
            } else {
                0
            };
            counts.push(u32::try_from(value + i64::from(before)).ok()?);
        }
        Self::from_counts(counts, pixels)
    }

    /// Encodes the run lengths as COCO text.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        for (k, &count) in self.0.iter().enumerate() {
            let mut value = i64::from(count) - if k > 2 { i64::from(self.0[k - 2]) } else { 0 };
            loop {
                let bits = value & (CONTINUE_BIT - 1);
                value >>= BITS;
                let last = if bits & (CONTINUE_BIT >> 1) == 0 {
                    value == 0
                } else {
                    value == -1
                };
                text.push(char::from(
                    ASCII_OFFSET + (bits | if last { 0 } else { CONTINUE_BIT }) as u8,
                ));
                if last {
                    break;
                }
            }
        }
        text
    }

    /// Returns the number of pixels inside the mask.
    pub fn area(&self) -> usize {
        self.0.iter().skip(1).step_by(2).map(|n| *n as usize).sum()
    }

    /// Yields the row-major indices of the mask's pixels, in column-major order.
    pub fn pixel_indices(&self, width: u32, height: u32) -> impl Iterator<Item = usize> {
        let mut start = 0;
        self.0.iter().enumerate().flat_map(move |(k, &length)| {
            let run = start..start + length;
            start = run.end;
            let run = if k % 2 == 1 { run } else { 0..0 };
            run.map(move |p| ((p % height) * width + p / height) as usize)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_go_down_the_columns() {
        // . # #
        // . . #
        let mask = RunLengths::from_fn(3, 2, |x, y| x == 2 || (x, y) == (1, 0));
        assert_eq!(mask.0, [2, 1, 1, 2]);
        assert_eq!(
            (mask.area(), mask.pixel_indices(3, 2).collect::<Vec<_>>()),
            (3, vec![1, 2, 5])
        );
        assert_eq!(RunLengths::from_fn(2, 1, |_, _| true).0, [0, 2]);
        assert_eq!(RunLengths::from_counts(vec![2, 1], 4), None);
    }

    #[test]
    fn text_round_trips_and_is_that_of_coco() {
        // Derived by hand: 6 -> "6"; 1 -> "1"; 40 -> group 8 with bit 5, then group 1; 4 - 1 ->
        // "3"; 0 - 40 -> "hN"; 9 - 4 -> "5".
        let mask = RunLengths(vec![6, 1, 40, 4, 0, 9]);
        assert_eq!(mask.to_text(), "61X13hN5");
        for runs in [
            vec![0, 100_000],
            vec![3, 2, 1, 70_000, 12, 1, 500, 0, 31, 32],
            vec![4_000_000_000],
        ] {
            let (mask, pixels) = (
                RunLengths(runs.clone()),
                runs.iter().map(|r| u64::from(*r)).sum(),
            );
            assert_eq!(RunLengths::from_text(&mask.to_text(), pixels), Some(mask));
        }
        for damaged in ["61X", "6 1", "é", "oooooooooo"] {
            assert_eq!(RunLengths::from_text(damaged, 60), None, "{damaged}");
        }
    }
}
