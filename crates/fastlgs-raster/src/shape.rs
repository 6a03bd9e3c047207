//! How the kernels divide their work among invocations.

/// How the kernels divide their work; `shaders/shared/lane.wgsl` and `chunks.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Sixteen invocations for each 8x8 tile, two tiles for each workgroup: for hardware adapters.
    Lanes,
    /// One invocation for each tile: for software adapters, whose invocations are vector lanes.
    Wide,
}

impl Shape {
    /// All shapes. Every adapter can run each of them.
    pub const ALL: [Self; 2] = [Self::Lanes, Self::Wide];

    /// Flag of the shader permutation.
    pub(crate) fn flag(self) -> Option<&'static str> {
        match self {
            Shape::Lanes => None,
            Shape::Wide => Some("WIDE"),
        }
    }

    /// Returns (chunks, workgroups) in which `n` items are sorted and summed.
    pub fn chunks(self, n: u32) -> (u32, u32) {
        // On a software adapter, one invocation processes one chunk. SERIAL chunks occupy all
        // threads, and their totals are quick to sum.
        const SERIAL: u32 = 256;
        const SHARED: u32 = 2048;
        if self == Shape::Wide {
            return (SERIAL, SERIAL / 64);
        }
        let chunks = n.div_ceil(SHARED).max(1);
        (chunks, chunks)
    }

    /// Invocations that write the tiles of one Gaussian; `shaders/emit.wgsl`.
    pub fn writers(self) -> u32 {
        if self == Shape::Wide { 1 } else { 8 }
    }

    /// Length of the runs of gradient slots that `shaders/fold_slots.wgsl` sums first. A software
    /// adapter has too few invocations to gain from it.
    pub fn fold(self) -> u32 {
        if self == Shape::Wide { 1 } else { 32 }
    }

    /// Workgroups that blend `tiles` tiles.
    pub fn groups(self, tiles: u32) -> u32 {
        tiles.div_ceil(match self {
            Shape::Lanes => 2,
            Shape::Wide => 8,
        })
    }
}
